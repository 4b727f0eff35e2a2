// Plane sweep and semi-global matching: what one sweep has to know, and how costs lie in memory. Mirrored by
// geometry/mvs/gpu_types.rs. The constants come from the host, which matches with the same ones on the CPU (geometry/mvs).

#import flat

struct Sweep {
    width_px: u32,
    height_px: u32,
    n_planes: u32,
    // Words of a pixel in `costs`: four planes each, as bytes. `sums` has twice as many, two planes each.
    n_words: u32,
    n_sources: u32,
    // Penalty for a step of one plane.
    small_step: u32,
    noise_variance: f32,
    unseen_zncc: f32,
    // Of a score, what the pixel itself says; and the difference of luma from which it says no.
    own_share: f32,
    most_off: f32,
    padding_0: u32,
    padding_1: u32,
}

// From reference pixels to pixels of one source, homogeneous: start of the plane + x * step_x + y * step_y.
struct Warp {
    step_x: vec4<f32>,
    step_y: vec4<f32>,
    width_px: u32,
    height_px: u32,
    // Of its pixels in `luma`.
    first: u32,
    // Of the reference's pixels in `luma`, in the light of this source.
    shown: u32,
}

// The lowest sum of a pixel, with its neighbours and the lowest sum beyond them: two halves of 16 bits a word.
struct Dip {
    plane: u32,
    cost: u32,
    before_at: u32,
    after_second: u32,
}

const MAX_SWEEP_PLANES: u32 = 512u;
