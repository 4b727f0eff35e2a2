// visible_args: number of visible splats -> sizes of the dispatches over them.
// After the scan of cull's counts. One thread.

#import step
#import camera
#import sorting
#import groups

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> block_offsets: array<u32>;
@group(0) @binding(2) var<storage, read_write> camera: Camera;
@group(0) @binding(3) var<storage, read_write> n_visible: array<u32>;
@group(0) @binding(4) var<storage, read_write> args: array<u32>;

@compute @workgroup_size(1)
fn main() {
    let n_blocks = (step.n_splats + 255u) / 256u;
    let n = select(block_offsets[n_blocks], 0u, camera.is_full != 0u);
    camera.n_visible = n;
    n_visible[0] = n;
    write_args(ARGS_VISIBLE, n, 256u);
    write_args(ARGS_SORT_VISIBLE, n, SORT_BLOCK);
}
