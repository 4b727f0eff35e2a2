// scan_blocks: sums of blocks -> the sum of all blocks before each.
// After scan_sums. One workgroup.

#import scanning

@group(0) @binding(0) var<storage, read> length: array<u32>;
@group(0) @binding(1) var<storage, read_write> block_sums: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n_blocks = (length[0] + SCAN_BLOCK - 1u) / SCAN_BLOCK;
    let share = (n_blocks + SCAN_THREADS - 1u) / SCAN_THREADS;
    let first = lane * share;
    let end = min(first + share, n_blocks);
    var sum = 0u;
    for (var i = first; i < end; i += 1u) {
        sum += block_sums[i];
    }
    var before = sum_before(lane, sum);
    for (var i = first; i < end; i += 1u) {
        let own = block_sums[i];
        block_sums[i] = before;
        before += own;
    }
}
