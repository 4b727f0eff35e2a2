// Dispatches are split over x and y, since one dimension ends at 65,535 groups.
fn flat(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}
