// SSIM's window (Wang et al. 2004): 11 x 11 Gaussian of sigma 1.5 px, images count as 0 beyond their edges.

const REACH: i32 = 5;
// Normalised.
const WINDOW = array<f32, 11>(
    0.00102838, 0.007598758, 0.036000773, 0.10936069, 0.21300554, 0.26601172,
    0.21300554, 0.10936069, 0.036000773, 0.007598758, 0.00102838,
);
// Stabilisers for values of range 1.
const C1: f32 = 1e-4;
const C2: f32 = 9e-4;
// Neighbouring pixels along the blur that one thread makes; they share most of what they load.
const RUN: u32 = 4u;

// The run of a thread along a row: x of its first pixel, and y, which may lie below the image.
fn run_of_row(thread: u32) -> vec2<u32> {
    let runs = (step.width_px + RUN - 1u) / RUN;
    return vec2<u32>(thread % runs * RUN, thread / runs);
}

// The run of a thread along a column: x, and y of its first pixel, which may lie below the image.
fn run_of_column(thread: u32) -> vec2<u32> {
    return vec2<u32>(thread % step.width_px, thread / step.width_px * RUN);
}
