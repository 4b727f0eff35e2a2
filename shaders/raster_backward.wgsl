// raster_backward: gradients of the pixels -> gradient of each instance's 2D Gaussian.
// After photo_gradient. One workgroup per tile. Each instance has its own slot: no atomics, and sums in a fixed order.
// Equations: docs/GRADIENTS.md, raster_backward.

#import tile_backward

// Three vec4 an instance, see `gather`.
@group(0) @binding(7) var<storage, read_write> slots: array<vec4<f32>>;

fn keep(instance: u32, part: u32, sum: vec4<f32>) {
    slots[3u * instance + part] = sum;
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = flat(group, groups);
    if tile >= step.n_tiles_x * step.n_tiles_y {
        return;
    }
    walk_back(tile, lane);
    for (var k = end_of(tile) + lane; k < tile_ranges[tile].y; k += LANES) {
        for (var part = 0u; part < 3u; part += 1u) {
            keep(k, part, vec4<f32>(0.0));
        }
    }
}
