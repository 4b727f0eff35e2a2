// instance_args: number of instances -> sizes of the dispatches over them, or the mark that there is no room.
// After the scan of tile_counts. One thread.

#import step
#import camera
#import sorting
#import groups

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> first_instances: array<u32>;
@group(0) @binding(2) var<storage, read_write> camera: Camera;
@group(0) @binding(3) var<storage, read_write> n_instances: array<u32>;
@group(0) @binding(4) var<storage, read_write> args: array<u32>;

@compute @workgroup_size(1)
fn main() {
    var n = first_instances[camera.n_visible];
    if camera.is_full == 0u {
        camera.n_wanted = n;
    }
    if n > step.max_instances {
        camera.is_full = 1u;
    }
    if camera.is_full == 0u {
        camera.n_done += 1u;
    } else {
        n = 0u;
        camera.n_visible = 0u;
        args[ARGS_VISIBLE] = 0u;
    }
    camera.n_instances = n;
    n_instances[0] = n;
    write_args(ARGS_INSTANCES, n, 256u);
    write_args(ARGS_SORT_INSTANCES, n, SORT_BLOCK);
}
