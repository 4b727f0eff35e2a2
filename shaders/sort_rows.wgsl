// sort_rows: table of sort_count -> sum of the blocks before in each row, and the sum of the row: of one digit.
// After sort_count. One workgroup per digit.

#import sorting

@group(0) @binding(0) var<storage, read> table: array<u32>;
@group(0) @binding(1) var<storage, read> length: array<u32>;
// By digit, then block.
@group(0) @binding(2) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(3) var<storage, read_write> totals: array<u32>;

const ROW_THREADS: u32 = 32u;

var<workgroup> shares: array<u32, ROW_THREADS>;

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let n_blocks = (length[0] + SORT_BLOCK - 1u) / SORT_BLOCK;
    let row = group.x * n_blocks;
    let share = (n_blocks + ROW_THREADS - 1u) / ROW_THREADS;
    let first = min(lane * share, n_blocks);
    let end = min(first + share, n_blocks);
    var sum = 0u;
    for (var block = first; block < end; block += 1u) {
        sum += table[row + block];
    }
    shares[lane] = sum;
    workgroupBarrier();
    var before = 0u;
    for (var other = 0u; other < lane; other += 1u) {
        before += shares[other];
    }
    if lane == ROW_THREADS - 1u {
        totals[group.x] = before + sum;
    }
    for (var block = first; block < end; block += 1u) {
        offsets[row + block] = before;
        before += table[row + block];
    }
}
