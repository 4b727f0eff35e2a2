// One visible splat on the image. Mirrored by splat/wgpu/types.rs.

struct Projected {
    center_px: vec2<f32>,
    // z in the camera, map units.
    depth: f32,
    // 0: broken, drawn nowhere and never updated.
    opacity: f32,
    // Upper triangle a, b, c of the inverse 2D covariance.
    conic_a: f32,
    conic_b: f32,
    conic_c: f32,
    splat_ix: u32,
    // Exactly 0 where spherical harmonics went below black.
    red: f32,
    green: f32,
    blue: f32,
    // ln(opacity / MIN_ALPHA): exponents above it are invisible.
    cut: f32,
    extent_px: vec2<f32>,
    n_tiles: u32,
    first_instance: u32,
}

// Slack of the exact test in units of the exponent: rounding must not cut a visible pixel.
const CUT_SLACK: f32 = 0.05;

// Whether the ellipse of alpha = MIN_ALPHA reaches a pixel centre's bounds in the tile: minimum of the convex
// exponent over the rectangle (the corner test of StopThePop, Radl et al. 2024, made exact).
fn touches(splat: Projected, tile: vec2<u32>) -> bool {
    let side = f32(TILE_PX) - 1.0;
    let low = vec2<f32>(tile * TILE_PX) + 0.5 - splat.center_px;
    let high = low + side;
    let near = min(max(vec2<f32>(0.0), low), high);
    let on_vertical = vec2<f32>(near.x, min(max(-splat.conic_b * near.x / splat.conic_c, low.y), high.y));
    let on_horizontal = vec2<f32>(min(max(-splat.conic_b * near.y / splat.conic_a, low.x), high.x), near.y);
    return min(exponent_at(splat, on_vertical), exponent_at(splat, on_horizontal)) <= splat.cut + CUT_SLACK;
}

fn exponent_at(splat: Projected, d: vec2<f32>) -> f32 {
    return 0.5 * (splat.conic_a * d.x * d.x + splat.conic_c * d.y * d.y) + splat.conic_b * d.x * d.y;
}
