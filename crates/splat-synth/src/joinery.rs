//! Wood and what is made of it: boards, parquet, drawers, doors.

use glam::{IVec2, Vec2};

use crate::noise::{edge, fractal, hash, hash2, nearest_point, pick, stroke, unit, value_noise};
use crate::paint::{Rgb, Spot, flat, mix, rgb};
use crate::surfaces::within;

/// Grain along u with knots; `uv` is the place within the piece of wood.
pub(crate) fn wood(colour: Rgb, uv: Vec2, spot: &Spot) -> Rgb {
    let Spot {
        footprint, seed, ..
    } = *spot;
    let knot = nearest_point(uv * Vec2::new(1.6, 6.0), seed ^ 11);
    let pull = (-knot.offset.length_squared() * 18.0).exp();
    let distorted = uv
        + Vec2::new(0.0, 0.02 * value_noise(uv * Vec2::new(2.0, 7.0), seed))
        + 0.035 * pull * knot.offset.signum();
    let rings = fractal(
        distorted * Vec2::new(4.0, 75.0),
        seed ^ 12,
        3,
        footprint * 75.0,
    );
    let fibres = fractal(
        distorted * Vec2::new(25.0, 330.0),
        seed ^ 13,
        2,
        footprint * 330.0,
    );
    let mut shade = 1.0 + 0.38 * rings + 0.2 * fibres;
    if pick(knot.id, 3) < 0.45 {
        let scaled = knot.offset * Vec2::new(1.0 / 1.6, 1.0 / 6.0);
        shade *= 1.0 - 0.6 * edge(scaled.length(), 0.008 + 0.012 * pick(knot.id, 4), footprint);
    }
    colour * shade
}

pub(crate) fn planks(light: Rgb, dark: Rgb, size: Vec2, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let row = (uv.y / size.y).floor();
    let shift = unit(hash(row as i32 as u32 ^ seed));
    let column = (uv.x / size.x + shift).floor();
    let local = Vec2::new(
        uv.x / size.x + shift - column - 0.5,
        uv.y / size.y - row - 0.5,
    ) * size;
    let id = hash2(IVec2::new(column as i32, row as i32), seed);
    let own = Spot { seed: id, ..*spot };
    let board = wood(
        mix(light, dark, pick(id, 1)),
        local + Vec2::new(3.0 * pick(id, 2), 0.0),
        &own,
    );
    let seam = within(local, size, 0.0022, footprint);
    let nail_at = Vec2::new(
        local.x.abs() - (0.5 * size.x - 0.035),
        local.y.abs() - 0.28 * size.y,
    );
    let nail = edge(nail_at.length(), 0.0045, footprint);
    mix(dark * 0.15, board * (1.0 - 0.7 * nail), seam)
}

pub(crate) fn parquet(light: Rgb, dark: Rgb, spot: &Spot) -> Rgb {
    const SQUARE: f32 = 0.36;
    const N_STRIPS: f32 = 4.0;
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let cell = (uv / SQUARE).floor();
    let mut local = uv - (cell + 0.5) * SQUARE;
    if (cell.x + cell.y).rem_euclid(2.0) > 0.5 {
        local = local.perp();
    }
    let width = SQUARE / N_STRIPS;
    let strip = (local.y / width).floor();
    let in_strip = Vec2::new(local.x, local.y - (strip + 0.5) * width);
    let id = hash2(
        cell.as_ivec2(),
        seed ^ (strip as i32 as u32).wrapping_mul(977),
    );
    let own = Spot { seed: id, ..*spot };
    let board = wood(
        mix(light, dark, pick(id, 1)) * (0.8 + 0.4 * pick(id, 2)),
        in_strip,
        &own,
    );
    let worn = 1.0 + 0.15 * fractal(uv * 1.7, seed ^ 3, 3, footprint * 1.7);
    mix(
        dark * 0.12,
        board * worn,
        within(in_strip, Vec2::new(SQUARE, width), 0.0014, footprint),
    )
}

/// Front of a chest: drawers with gaps, shadows and knobs.
pub(crate) fn drawers(colour: Rgb, rows: u8, columns: u8, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        half,
        footprint,
        seed,
        face,
    } = *spot;
    if face >= 4 {
        return wood(colour, uv, spot);
    }
    let size = 2.0 * half / Vec2::new(f32::from(columns), f32::from(rows));
    let cell = ((uv + half) / size).floor();
    let local = uv + half - (cell + 0.5) * size;
    let id = hash2(cell.as_ivec2(), seed);
    let front = wood(
        colour * (0.8 + 0.4 * pick(id, 1)),
        local + pick(id, 2),
        &Spot { seed: id, ..*spot },
    );
    let shade = 1.0 - 0.35 * stroke(local.y + 0.5 * size.y - 0.03, 0.006, footprint);
    let knob = edge(local.length(), 0.018, footprint);
    let ring = edge(local.length(), 0.026, footprint);
    let fitted = mix(front * shade, rgb(0x2A_2018), ring);
    mix(
        colour * 0.12,
        mix(fitted, rgb(0xC9_A55C), knob),
        within(local, size, 0.006, footprint),
    )
}

/// A door: frame, four panels with light and shadow edges, handle, keyhole.
pub(crate) fn panelled(colour: Rgb, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        half,
        footprint,
        seed,
        ..
    } = *spot;
    let cell = Vec2::new(
        (uv.x >= 0.0) as u8 as f32,
        (uv.y >= 0.1 * half.y) as u8 as f32,
    );
    let low = Vec2::new(
        if cell.x > 0.5 { 0.0 } else { -half.x },
        if cell.y > 0.5 { 0.1 * half.y } else { -half.y },
    );
    let high = Vec2::new(
        if cell.x > 0.5 { half.x } else { 0.0 },
        if cell.y > 0.5 { half.y } else { 0.1 * half.y },
    );
    let size = high - low;
    let local = uv - 0.5 * (low + high);
    let inner = within(local, size, 0.075, footprint);
    let outer = within(local, size, 0.055, footprint);
    let lit = if local.y / size.y > local.x / size.x {
        0.55
    } else {
        1.35
    };
    let streak = fractal(uv * Vec2::new(70.0, 5.0), seed, 3, footprint * 70.0);
    let base = flat(colour, spot) * (1.0 + 0.25 * streak);
    let body = mix(mix(base, base * lit, outer), base * 0.9, inner);
    let at_handle = uv - Vec2::new(0.82 * half.x, 0.0);
    let plate = stroke(at_handle.x, 0.02, footprint) * stroke(at_handle.y, 0.09, footprint);
    let lever =
        stroke(at_handle.x + 0.05, 0.06, footprint) * stroke(at_handle.y - 0.03, 0.011, footprint);
    let hole = edge(
        (at_handle + Vec2::new(0.0, 0.05)).length(),
        0.007,
        footprint,
    );
    let metalled = mix(mix(body, rgb(0x77_6A50), plate), rgb(0xD8_CDA8), lever);
    mix(metalled, rgb(0x10_0D0A), hole)
}
