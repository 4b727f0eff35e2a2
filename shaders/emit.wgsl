// emit: visible splats in order of depth -> one instance per tile that each touches.
// After instance_args. One thread per visible splat.

#import step
#import camera
#import shape
#import projected

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read> depth_order: array<u32>;
@group(0) @binding(3) var<storage, read> first_instances: array<u32>;
@group(0) @binding(4) var<storage, read_write> projected: array<Projected>;
@group(0) @binding(5) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> tile_values: array<u32>;
@group(0) @binding(7) var<storage, read_write> owners: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let rank = flat(group, groups) * 256u + lane;
    if rank >= camera.n_visible {
        return;
    }
    let visible_ix = depth_order[rank];
    let splat = projected[visible_ix];
    var at = first_instances[rank];
    let end = first_instances[rank + 1u];
    projected[visible_ix].first_instance = at;
    let size_px = vec2<f32>(f32(step.width_px), f32(step.height_px));
    let tiles = tiles_of(splat.center_px, splat.extent_px, size_px);
    for (var y = tiles.y; y < tiles.w; y += 1u) {
        for (var x = tiles.x; x < tiles.z; x += 1u) {
            if at < end && touches(splat, vec2<u32>(x, y)) {
                tile_keys[at] = y * step.n_tiles_x + x;
                tile_values[at] = at;
                owners[at] = visible_ix;
                at += 1u;
            }
        }
    }
    // The count is project's; should a compiler round this test otherwise, the rest goes to a tile that is no tile.
    for (; at < end; at += 1u) {
        tile_keys[at] = step.n_tiles_x * step.n_tiles_y;
        tile_values[at] = at;
        owners[at] = visible_ix;
    }
}
