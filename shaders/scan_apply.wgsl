// scan_apply: numbers and the sums before their blocks -> the sum before each number, and the total behind the last.
// After scan_blocks. One workgroup per block.

#import flat
#import scanning

@group(0) @binding(0) var<storage, read> numbers: array<u32>;
@group(0) @binding(1) var<storage, read> length: array<u32>;
@group(0) @binding(2) var<storage, read> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums_before: array<u32>;

var<workgroup> partial: array<u32, 64>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = flat(group, groups);
    let n = length[0];
    let first = block * SCAN_BLOCK + lane * SCAN_PER_THREAD;
    let end = min(first + SCAN_PER_THREAD, n);
    var sum = 0u;
    for (var i = first; i < end; i += 1u) {
        sum += numbers[i];
    }
    partial[lane] = sum;
    workgroupBarrier();
    // An empty list still has a total: group 0 writes it.
    if first >= n {
        if n == 0u && block == 0u && lane == 0u {
            sums_before[0] = 0u;
        }
        return;
    }
    var before = block_sums[block];
    for (var thread = 0u; thread < lane; thread += 1u) {
        before += partial[thread];
    }
    for (var i = first; i < end; i += 1u) {
        sums_before[i] = before;
        before += numbers[i];
    }
    if end == n {
        sums_before[n] = before;
    }
}
