// tile_counts: visible splats in order of depth -> how many tiles each touches.
// After the sort by depth. One thread per visible splat.

#import step
#import camera
#import shape
#import projected

@group(0) @binding(0) var<storage, read> camera: Camera;
@group(0) @binding(1) var<storage, read> depth_order: array<u32>;
@group(0) @binding(2) var<storage, read> projected: array<Projected>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let rank = flat(group, groups) * 256u + lane;
    if rank < camera.n_visible {
        counts[rank] = projected[depth_order[rank]].n_tiles;
    }
}
