// sort_count: keys -> how many of each digit there are in each block of 2,048.
// First stage of a pass of the radix sort; sort_rows follows. One workgroup per block, one thread
// per digit.

#import flat
#import sorting

@group(0) @binding(0) var<uniform> sort_pass: SortPass;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> length: array<u32>;
// By digit, then block.
@group(0) @binding(3) var<storage, read_write> table: array<u32>;

var<workgroup> counts: array<atomic<u32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let n = length[0];
    let block = flat(group, groups);
    let n_blocks = (n + SORT_BLOCK - 1u) / SORT_BLOCK;
    atomicStore(&counts[lane], 0u);
    workgroupBarrier();
    let end = min((block + 1u) * SORT_BLOCK, n);
    for (var i = block * SORT_BLOCK + lane; i < end; i += DIGITS) {
        atomicAdd(&counts[(keys[i] >> sort_pass.shift) & 255u], 1u);
    }
    workgroupBarrier();
    if block >= n_blocks {
        return;
    }
    table[lane * n_blocks + block] = atomicLoad(&counts[lane]);
}
