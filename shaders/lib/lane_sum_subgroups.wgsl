// Sums over the lanes of a tile of an instance's three parts, each kept by the shader's `keep`; the workgroup is several
// subgroups of SUBGROUP lanes in order. Each leaves its own sums in workgroup memory; once ROUND instances lie there they
// are added up, in the order of the subgroups, so that one wait serves all of them.

#import subgroup_sums

const ROUND: u32 = 8u;
const SUBGROUPS: u32 = LANES / SUBGROUP;

var<workgroup> subgroup_sums: array<vec4<f32>, 3u * ROUND * SUBGROUPS>;

// For the instance at `place` of those from `begin` on.
fn store_sums(begin: u32, place: u32, lane: u32, geometry: vec4<f32>, conic: vec4<f32>, color: vec4<f32>) {
    let sums = subgroup_sums_of(geometry, conic, color);
    let slot = (place - begin) % ROUND;
    if lane % SUBGROUP == 0u {
        let at = 3u * (slot * SUBGROUPS + lane / SUBGROUP);
        subgroup_sums[at] = sums.geometry;
        subgroup_sums[at + 1u] = sums.conic;
        subgroup_sums[at + 2u] = sums.color;
    }
    if slot == ROUND - 1u {
        keep_round(place - slot, ROUND, lane);
    }
}

// For those that are left when no instance follows.
fn finish_sums(begin: u32, end: u32, lane: u32) {
    let n = (end - begin) % ROUND;
    if n > 0u {
        keep_round(end - n, n, lane);
    }
}

fn keep_round(first: u32, n: u32, lane: u32) {
    workgroupBarrier();
    for (var at = lane; at < 3u * n; at += LANES) {
        let slot = at / 3u;
        let part = at % 3u;
        var sum = vec4<f32>(0.0);
        for (var subgroup = 0u; subgroup < SUBGROUPS; subgroup += 1u) {
            sum += subgroup_sums[3u * (slot * SUBGROUPS + subgroup) + part];
        }
        keep(first + slot, part, sum);
    }
    workgroupBarrier();
}
