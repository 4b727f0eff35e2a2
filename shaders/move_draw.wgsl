// move_draw: places to fill -> the splat that each becomes a copy of.
// After the scans of weights and of the dead. One thread per splat, or per place behind the last.

#import step
#import moves
#import random

@group(0) @binding(0) var<uniform> moves: Moves;
// Sums of the weights before each splat, the total behind the last.
@group(0) @binding(1) var<storage, read> starts: array<u32>;
@group(0) @binding(2) var<storage, read> dead: array<u32>;
@group(0) @binding(3) var<storage, read> dead_before: array<u32>;
@group(0) @binding(4) var<storage, read_write> sources: array<u32>;
@group(0) @binding(5) var<storage, read_write> shares: array<atomic<u32>>;

// Upper 32 bits of the product.
fn product_high(a: u32, b: u32) -> u32 {
    let low = (a & 0xffffu) * (b & 0xffffu);
    let middle_1 = (a >> 16u) * (b & 0xffffu) + (low >> 16u);
    let middle_2 = (a & 0xffffu) * (b >> 16u) + (middle_1 & 0xffffu);
    return (a >> 16u) * (b >> 16u) + (middle_1 >> 16u) + (middle_2 >> 16u);
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let thread = flat(group, groups) * 256u + lane;
    var draw = thread;
    if moves.n_added == 0u {
        if thread >= moves.n_splats {
            return;
        }
        sources[thread] = NOBODY;
        if dead[thread] == 0u {
            return;
        }
        draw = dead_before[thread];
    } else if thread >= moves.n_added {
        return;
    }
    let total = starts[moves.n_splats];
    sources[thread] = NOBODY;
    if total == 0u {
        return;
    }
    let wanted = product_high(hash3(moves.seed, draw, moves.kind).x, total);
    // The last splat that starts at or below.
    var low = 0u;
    var high = moves.n_splats;
    while high - low > 1u {
        let middle = (low + high) / 2u;
        if starts[middle] <= wanted {
            low = middle;
        } else {
            high = middle;
        }
    }
    sources[thread] = low;
    atomicAdd(&shares[low], 1u);
}
