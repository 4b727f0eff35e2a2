// sort_scatter_subgroups: keys with values -> the same in order of one digit, equal digits as they were.
// After sort_rows. One workgroup per block; each of its 8 subgroups takes a run of neighbouring keys,
// SUBGROUP of them at a time. Lanes with the same digit find each other by ballots, one a bit; the first of them counts
// for all (the "match" of onesweep, Adinets and Merrill 2022).

#import scattering

const SUBGROUPS: u32 = 8u;
const THREADS: u32 = SUBGROUPS * SUBGROUP;
const RUN: u32 = SORT_BLOCK / SUBGROUPS;

// Keys of a subgroup with each digit, so far; then where its next one goes.
var<workgroup> places: array<atomic<u32>, 2048>;

// The lanes of the subgroup whose digit is this lane's.
fn lanes_with(digit: u32, is_key: bool) -> u32 {
    var same = subgroupBallot(is_key).x;
    for (var bit = 0u; bit < 8u; bit += 1u) {
        let is_set = ((digit >> bit) & 1u) == 1u;
        let lanes = subgroupBallot(is_set).x;
        same &= select(~lanes, lanes, is_set);
    }
    return same;
}

@compute @workgroup_size(8u * SUBGROUP)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let n = length[0];
    let block = flat(group, groups);
    let n_blocks = (n + SORT_BLOCK - 1u) / SORT_BLOCK;
    for (var place = lane; place < SUBGROUPS * DIGITS; place += THREADS) {
        atomicStore(&places[place], 0u);
    }
    find_digit_starts(lane, THREADS);
    let subgroup = lane / SUBGROUP;
    let own = lane % SUBGROUP;
    let first = block * SORT_BLOCK + subgroup * RUN;
    for (var i = 0u; i < RUN; i += SUBGROUP) {
        let at = first + i + own;
        let is_key = at < n;
        let digit = (keys[min(at, n - 1u)] >> sort_pass.shift) & 255u;
        let same = lanes_with(digit, is_key);
        if is_key && (same & ((1u << own) - 1u)) == 0u {
            atomicAdd(&places[subgroup * DIGITS + digit], countOneBits(same));
        }
    }
    workgroupBarrier();
    if block < n_blocks {
        for (var digit = lane; digit < DIGITS; digit += THREADS) {
            var place = digit_starts[digit] + offsets[digit * n_blocks + block];
            for (var other = 0u; other < SUBGROUPS; other += 1u) {
                let n_keys = atomicExchange(&places[other * DIGITS + digit], place);
                place += n_keys;
            }
        }
    }
    workgroupBarrier();
    for (var i = 0u; i < RUN; i += SUBGROUP) {
        let at = first + i + own;
        let is_key = at < n;
        let key = keys[min(at, n - 1u)];
        let digit = (key >> sort_pass.shift) & 255u;
        let same = lanes_with(digit, is_key);
        let before = same & ((1u << own) - 1u);
        var place = 0u;
        if is_key && before == 0u {
            place = atomicAdd(&places[subgroup * DIGITS + digit], countOneBits(same));
        }
        // Lanes beyond the last key ask their own lane.
        let leader = select(own, firstTrailingBit(same), is_key);
        place = subgroupShuffle(place, leader) + countOneBits(before);
        if is_key {
            sorted_keys[place] = key;
            sorted_values[place] = values[at];
        }
    }
}
