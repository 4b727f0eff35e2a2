// gather: slots of a visible splat's instances -> their sum, in order of tiles.
// After raster_backward. One thread per visible splat.

#import step
#import camera
#import shape
#import projected

@group(0) @binding(0) var<storage, read> camera: Camera;
@group(0) @binding(1) var<storage, read> projected: array<Projected>;
@group(0) @binding(2) var<storage, read> places: array<u32>;
@group(0) @binding(3) var<storage, read> slots: array<vec4<f32>>;
// Sums over pixels: v_sigma, v_sigma dx, v_sigma dy, depth; v_sigma dx^2, dx dy, dy^2; r, g, b.
@group(0) @binding(4) var<storage, read_write> splat_sums: array<vec4<f32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let visible_ix = flat(group, groups) * 256u + lane;
    if visible_ix >= camera.n_visible {
        return;
    }
    let first = projected[visible_ix].first_instance;
    let end = first + projected[visible_ix].n_tiles;
    var geometry = vec4<f32>(0.0);
    var squares = vec4<f32>(0.0);
    var color = vec4<f32>(0.0);
    for (var emitted = first; emitted < end; emitted += 1u) {
        let slot = 3u * places[emitted];
        geometry += slots[slot];
        squares += slots[slot + 1u];
        color += slots[slot + 2u];
    }
    splat_sums[3u * visible_ix] = geometry;
    splat_sums[3u * visible_ix + 1u] = squares;
    splat_sums[3u * visible_ix + 2u] = color;
}
