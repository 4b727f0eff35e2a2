// mvs_winner: sums over the paths -> the plane with the lowest, and what the host needs to place it between planes.
// After mvs_paths. One thread per pixel.

#import sweep

@group(0) @binding(0) var<uniform> sweep: Sweep;
@group(0) @binding(1) var<storage, read> costs: array<u32>;
@group(0) @binding(2) var<storage, read> sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> dips: array<Dip>;

// More than any sum: eight paths of at most 255 + 90 each.
const NO_SUM: u32 = 65535u;

fn sum_of(pixel: u32, plane: u32) -> u32 {
    let word = sums[2u * pixel * sweep.n_words + plane / 2u];
    return (word >> (16u * (plane % 2u))) & 65535u;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let pixel = flat(group, groups) * 64u + lane;
    if pixel >= sweep.width_px * sweep.height_px {
        return;
    }
    var plane = 0u;
    var lowest = NO_SUM;
    for (var other = 0u; other < sweep.n_planes; other += 1u) {
        let sum = sum_of(pixel, other);
        // Of equal sums the first, as on the host.
        if sum < lowest {
            lowest = sum;
            plane = other;
        }
    }
    var second = NO_SUM;
    for (var other = 0u; other < sweep.n_planes; other += 1u) {
        if other + 1u < plane || other > plane + 1u {
            second = min(second, sum_of(pixel, other));
        }
    }
    let before = sum_of(pixel, max(plane, 1u) - 1u);
    let after = sum_of(pixel, min(plane + 1u, sweep.n_planes - 1u));
    let cost = (costs[pixel * sweep.n_words + plane / 4u] >> (8u * (plane % 4u))) & 255u;
    dips[pixel] = Dip(plane, cost, before | (lowest << 16u), after | (second << 16u));
}
