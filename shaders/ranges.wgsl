// ranges: instances in order of tile and depth -> where each tile begins and ends, and the splat of each place.
// After the sort by tile. One thread per instance.

#import step
#import camera

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read> tile_keys: array<u32>;
@group(0) @binding(3) var<storage, read> tile_values: array<u32>;
@group(0) @binding(4) var<storage, read> owners: array<u32>;
// Visible splat at each place.
@group(0) @binding(5) var<storage, read_write> instances: array<u32>;
// Place of each emitted instance.
@group(0) @binding(6) var<storage, read_write> places: array<u32>;
// Begin and end of each tile; the host clears them.
@group(0) @binding(7) var<storage, read_write> tile_ranges: array<vec2<u32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let place = flat(group, groups) * 256u + lane;
    if place >= camera.n_instances {
        return;
    }
    let emitted = tile_values[place];
    instances[place] = owners[emitted];
    places[emitted] = place;
    let tile = tile_keys[place];
    let n_tiles = step.n_tiles_x * step.n_tiles_y;
    if tile >= n_tiles {
        return;
    }
    if place == 0u || tile_keys[place - 1u] != tile {
        tile_ranges[tile].x = place;
    }
    if place + 1u == camera.n_instances || tile_keys[place + 1u] != tile {
        tile_ranges[tile].y = place + 1u;
    }
}
