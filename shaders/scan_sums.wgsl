// scan_sums: numbers -> the sum of each block of 2,048.
// First stage of a prefix sum. One workgroup per block.

#import flat
#import scanning

@group(0) @binding(0) var<storage, read> numbers: array<u32>;
@group(0) @binding(1) var<storage, read> length: array<u32>;
@group(0) @binding(2) var<storage, read_write> block_sums: array<u32>;

var<workgroup> total: atomic<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = flat(group, groups);
    if lane == 0u {
        atomicStore(&total, 0u);
    }
    workgroupBarrier();
    let end = min((block + 1u) * SCAN_BLOCK, length[0]);
    var sum = 0u;
    for (var i = block * SCAN_BLOCK + lane; i < end; i += SCAN_THREADS) {
        sum += numbers[i];
    }
    atomicAdd(&total, sum);
    workgroupBarrier();
    if lane == 0u && block * SCAN_BLOCK < length[0] {
        block_sums[block] = atomicLoad(&total);
    }
}
