// raster_backward_atomic: gradients of the pixels -> sum over tiles of the gradient of each splat's 2D Gaussian.
// In place of raster_backward and gather where the adapter adds floats atomically: no slots, but sums in any order.
// Equations: docs/GRADIENTS.md, raster_backward.

#import tile_backward

// As `gather` leaves them; zero before.
@group(0) @binding(7) var<storage, read_write> splat_sums: array<atomic<f32>>;

fn keep(instance: u32, part: u32, sum: vec4<f32>) {
    let at = 12u * instances[instance] + 4u * part;
    atomicAdd(&splat_sums[at], sum.x);
    atomicAdd(&splat_sums[at + 1u], sum.y);
    atomicAdd(&splat_sums[at + 2u], sum.z);
    // Only the first part has a fourth number.
    if part == 0u {
        atomicAdd(&splat_sums[at + 3u], sum.w);
    }
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = flat(group, groups);
    if tile >= step.n_tiles_x * step.n_tiles_y {
        return;
    }
    walk_back(tile, lane);
}
