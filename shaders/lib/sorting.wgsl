// Radix sort, 8 bits a pass, stable: how keys are shared out. `sort_count` and both kinds of `sort_scatter` have to agree.

const DIGITS: u32 = 256u;
const SORT_BLOCK: u32 = 2048u;

// Mirrored by gpu/types.rs.
struct SortPass {
    shift: u32,
    padding_0: u32,
    padding_1: u32,
    padding_2: u32,
}
