// One pass of MCMC moves (Kheradmand et al. 2024): what the host says of it. Mirrored by splat/wgpu/types.rs.
// The arithmetic is that of src/splat/mcmc.rs.

struct Moves {
    n_splats: u32,
    // Places to fill behind the last splat; 0: the places of the dead are filled.
    n_added: u32,
    seed: u32,
    // Third word of the hash: which draw it is for.
    kind: u32,
    weight_bits: u32,
    active_steps: u32,
    n_steps: u32,
    sh_stored: u32,
    min_opacity: f32,
    // What copies keep: 1 the sums over the image, 0 what a line gathers.
    by_image: u32,
    // 1: moments count as old as their splat, though they were cleared.
    keeps_age: u32,
    padding_1: u32,
}

const NOBODY: u32 = 0xffffffffu;
