// scan_apply: numbers and the sums before their blocks -> the sum before each number, and the total behind the last.
// After scan_blocks. One workgroup per block.

#import flat
#import scanning

@group(0) @binding(0) var<storage, read> numbers: array<u32>;
@group(0) @binding(1) var<storage, read> length: array<u32>;
@group(0) @binding(2) var<storage, read> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums_before: array<u32>;

// Read and written side by side, added up by threads of neighbours.
var<workgroup> block_numbers: array<u32, SCAN_BLOCK>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = flat(group, groups);
    let n = length[0];
    let begin = block * SCAN_BLOCK;
    let end = min(begin + SCAN_BLOCK, n);
    for (var k = lane; k < SCAN_BLOCK; k += SCAN_THREADS) {
        var number = 0u;
        if begin + k < n {
            number = numbers[begin + k];
        }
        block_numbers[k] = number;
    }
    workgroupBarrier();
    let first = lane * SCAN_PER_THREAD;
    var sum = 0u;
    for (var k = first; k < first + SCAN_PER_THREAD; k += 1u) {
        sum += block_numbers[k];
    }
    var before = block_sums[min(block, (n + SCAN_BLOCK - 1u) / SCAN_BLOCK)] + sum_before(lane, sum);
    for (var k = first; k < first + SCAN_PER_THREAD; k += 1u) {
        let number = block_numbers[k];
        block_numbers[k] = before;
        before += number;
        if begin + k + 1u == n {
            sums_before[n] = before;
        }
    }
    workgroupBarrier();
    for (var k = lane; begin + k < end; k += SCAN_THREADS) {
        sums_before[begin + k] = block_numbers[k];
    }
    // An empty list still has a total.
    if n == 0u && block == 0u && lane == 0u {
        sums_before[0] = 0u;
    }
}
