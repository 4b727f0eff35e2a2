// Where the keys with each digit begin, from the number of keys with each; the shader binds them as `totals`.

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
