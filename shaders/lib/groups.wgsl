// Indirect dispatches of a step: x, y, z of each, four words apart. Mirrored by gpu/types.rs.

const ARGS_VISIBLE: u32 = 0u;
const ARGS_SORT_VISIBLE: u32 = 4u;
const ARGS_INSTANCES: u32 = 8u;
const ARGS_SORT_INSTANCES: u32 = 12u;
const MAX_GROUPS_X: u32 = 65535u;

fn groups_for(n: u32, per_group: u32) -> vec2<u32> {
    let groups = (n + per_group - 1u) / per_group;
    let rows = (groups + MAX_GROUPS_X - 1u) / MAX_GROUPS_X;
    return vec2<u32>(min(groups, MAX_GROUPS_X), rows);
}
