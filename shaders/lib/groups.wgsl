// Indirect dispatches of a step: x, y, z of each, four words apart. Mirrored by splat/wgpu/types.rs.

const ARGS_VISIBLE: u32 = 0u;
const ARGS_SORT_VISIBLE: u32 = 4u;
const ARGS_INSTANCES: u32 = 8u;
const ARGS_SORT_INSTANCES: u32 = 12u;
const MAX_GROUPS_X: u32 = 65535u;

// Writes the size of a dispatch over n items to `args`.
fn write_args(at: u32, n: u32, per_group: u32) {
    let groups = (n + per_group - 1u) / per_group;
    args[at] = min(groups, MAX_GROUPS_X);
    args[at + 1u] = (groups + MAX_GROUPS_X - 1u) / MAX_GROUPS_X;
    args[at + 2u] = 1u;
}
