// sort_scatter: keys with values -> the same in order of one digit, equal digits as they were.
// After sort_rows. One workgroup per block. For adapters without subgroups of a known size; see
// sort_scatter_subgroups.

#import scattering

const SORT_THREADS: u32 = 32u;
// Neighbouring keys that one thread takes, in order.
const KEYS_PER_THREAD: u32 = SORT_BLOCK / SORT_THREADS;
// Per digit, half a word per thread: a block has fewer than 65,536 keys.
const WORDS: u32 = SORT_THREADS / 2u;
var<workgroup> ranks: array<atomic<u32>, 4096>;

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let n = length[0];
    let block = flat(group, groups);
    let n_blocks = (n + SORT_BLOCK - 1u) / SORT_BLOCK;
    for (var word = lane; word < DIGITS * WORDS; word += SORT_THREADS) {
        atomicStore(&ranks[word], 0u);
    }
    find_digit_starts(lane, SORT_THREADS);
    let first = block * SORT_BLOCK + lane * KEYS_PER_THREAD;
    let end = min(first + KEYS_PER_THREAD, n);
    let half = (lane % 2u) * 16u;
    for (var i = first; i < end; i += 1u) {
        let digit = (keys[i] >> sort_pass.shift) & 255u;
        atomicAdd(&ranks[digit * WORDS + lane / 2u], 1u << half);
    }
    workgroupBarrier();
    // Counts become the number of equal digits in the threads before.
    for (var digit = lane; digit < DIGITS; digit += SORT_THREADS) {
        var sum = 0u;
        for (var word = 0u; word < WORDS; word += 1u) {
            let counts = atomicLoad(&ranks[digit * WORDS + word]);
            let low = counts & 65535u;
            atomicStore(&ranks[digit * WORDS + word], sum | ((sum + low) << 16u));
            sum += low + (counts >> 16u);
        }
    }
    workgroupBarrier();
    for (var i = first; i < end; i += 1u) {
        let key = keys[i];
        let digit = (key >> sort_pass.shift) & 255u;
        let before = atomicAdd(&ranks[digit * WORDS + lane / 2u], 1u << half);
        let place = digit_starts[digit] + offsets[digit * n_blocks + block] + ((before >> half) & 65535u);
        sorted_keys[place] = key;
        sorted_values[place] = values[i];
    }
}
