// Alpha of one splat at one pixel: `raster` and `raster_backward` have to agree.
// A workgroup is one tile; pixel i of a lane is pixel i * LANES + lane of the tile, row by row. The host sets LANES and
// PIXELS = 256 / LANES, and repeats the text of the pixel loops, so that all pixels of a lane stay in registers.

// A pixel stops before its transmittance falls to this (Kerbl et al. 2023, as the next).
const MIN_TRANSMITTANCE: f32 = 1e-4;
// A splat never hides all behind it: what it hides gets no gradient.
const MAX_ALPHA: f32 = 0.99;
// Rounding must not cut a visible pixel.
const REACH_SLACK: f32 = 0.05;
const LOG2_E: f32 = 1.4426950408889634;
// Splats between two looks at whether all pixels have stopped.
const SPLATS_PER_LOOK: u32 = 8u;

struct Ellipse {
    // From the centre of the tile's first pixel to the splat's centre.
    center: vec2<f32>,
    // -log2 e times the conic: exponent of two = half_a dx^2 + b dx dy + half_c dy^2.
    half_a: f32,
    b: f32,
    half_c: f32,
    opacity: f32,
    // Rows further from the centre see nothing of it, px.
    reach: f32,
}

fn ellipse_of(splat: Projected, corner: vec2<f32>) -> Ellipse {
    return Ellipse(
        splat.center_px - corner - 0.5,
        -0.5 * LOG2_E * splat.conic_a,
        -LOG2_E * splat.conic_b,
        -0.5 * LOG2_E * splat.conic_c,
        splat.opacity,
        splat.extent_px.y + REACH_SLACK,
    );
}

fn pixel_in_tile(i: u32, lane: u32) -> vec2<f32> {
    let p = i * LANES + lane;
    return vec2<f32>(f32(p % TILE_PX), f32(p / TILE_PX));
}

// Alpha before its upper bound; 0 where it is too faint to count.
fn raw_alpha(e: Ellipse, d: vec2<f32>) -> f32 {
    let exponent = (e.half_a * d.x + e.b * d.y) * d.x + e.half_c * d.y * d.y;
    let alpha = e.opacity * exp2(exponent);
    // Rounding may take the exponent of a needle above 0, where the Gaussian has no value.
    return select(0.0, alpha, alpha >= MIN_ALPHA && exponent <= 0.0);
}
