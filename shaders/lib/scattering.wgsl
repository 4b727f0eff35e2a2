// What both kinds of `sort_scatter` bind, and where the keys with each digit begin.

#import flat
#import sorting

@group(0) @binding(0) var<uniform> sort_pass: SortPass;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read> length: array<u32>;
// By digit, then block: keys with that digit in the blocks before.
@group(0) @binding(4) var<storage, read> offsets: array<u32>;
// Keys with each digit.
@group(0) @binding(5) var<storage, read> totals: array<u32>;
@group(0) @binding(6) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> sorted_values: array<u32>;

const CHUNK: u32 = 8u;
const CHUNKS: u32 = DIGITS / CHUNK;

var<workgroup> digit_starts: array<u32, DIGITS>;
var<workgroup> chunk_sums: array<u32, CHUNKS>;

// By `n_threads` threads of the workgroup; a workgroupBarrier follows its last write.
fn find_digit_starts(lane: u32, n_threads: u32) {
    for (var chunk = lane; chunk < CHUNKS; chunk += n_threads) {
        var sum = 0u;
        for (var digit = CHUNK * chunk; digit < CHUNK * (chunk + 1u); digit += 1u) {
            sum += totals[digit];
        }
        chunk_sums[chunk] = sum;
    }
    workgroupBarrier();
    for (var chunk = lane; chunk < CHUNKS; chunk += n_threads) {
        var start = 0u;
        for (var other = 0u; other < chunk; other += 1u) {
            start += chunk_sums[other];
        }
        for (var digit = CHUNK * chunk; digit < CHUNK * (chunk + 1u); digit += 1u) {
            digit_starts[digit] = start;
            start += totals[digit];
        }
    }
    workgroupBarrier();
}
