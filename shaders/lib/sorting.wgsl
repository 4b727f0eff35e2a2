// Radix sort, 8 bits a pass, stable: how keys are shared out. `sort_count` and `sort_scatter` have to agree.

const DIGITS: u32 = 256u;
const SORT_THREADS: u32 = 32u;
// Neighbouring keys that one thread takes, in order.
const KEYS_PER_THREAD: u32 = 64u;
const SORT_BLOCK: u32 = SORT_THREADS * KEYS_PER_THREAD;

// Mirrored by gpu/types.rs.
struct SortPass {
    shift: u32,
    padding_0: u32,
    padding_1: u32,
    padding_2: u32,
}
