//! Materials that buildings are made of: plaster, brick, tiles, stone, metal, glass. Wood is in `joinery.rs`.

use glam::{IVec2, Vec2, Vec3};

use crate::noise::{
    edge, fractal, hash, hash2, nearest_point, pick, stroke, unit, value_noise, visible,
};
use crate::paint::{Rgb, Spot, flat, mix, palette, rgb};

pub(crate) fn plaster(colour: Rgb, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let broad = fractal(uv * 1.3, seed, 3, footprint * 1.3);
    // Trowel marks run in arcs: warp the place before asking the noise.
    let bend = Vec2::new(
        value_noise(uv * 3.0, seed ^ 3),
        value_noise(uv * 3.0, seed ^ 4),
    ) * 0.12;
    let marks = fractal(
        (uv + bend) * Vec2::new(18.0, 42.0),
        seed ^ 5,
        3,
        footprint * 42.0,
    );
    let grain = fractal(uv * 160.0, seed ^ 6, 2, footprint * 160.0);
    let mut shade = 1.0 + 0.10 * broad + 0.22 * marks + 0.12 * grain;
    let pit = nearest_point(uv * 16.0, seed ^ 7);
    let radius = 0.05 + 0.14 * pick(pit.id, 3);
    if pick(pit.id, 5) < 0.65 {
        shade *= 1.0 - 0.45 * edge(pit.distance, radius, footprint * 16.0) * pick(pit.id, 4);
    }
    let crack = nearest_point(uv * 1.7 + bend * 2.0, seed ^ 8);
    let cracked = edge(0.1, value_noise(uv * 0.9, seed ^ 9), 0.2);
    shade *= 1.0 - 0.4 * cracked * stroke(crack.border, 0.004, footprint * 1.7);
    colour * shade
}

/// Position in the cell of a running bond: cell, place within it in [-0.5, 0.5] of its size in metres.
fn bond(uv: Vec2, size: Vec2) -> (IVec2, Vec2) {
    let row = (uv.y / size.y).floor();
    // Every row starts elsewhere, and not at the same half brick: real walls drift too.
    let shift = 0.5 * row.rem_euclid(2.0) + 0.13 * unit(hash(row as i32 as u32));
    let column = (uv.x / size.x + shift).floor();
    let local = Vec2::new(
        uv.x / size.x + shift - column - 0.5,
        uv.y / size.y - row - 0.5,
    ) * size;
    (IVec2::new(column as i32, row as i32), local)
}

/// How much of a sample lies on a block of this size with gaps of `gap` metres around it.
pub(crate) fn within(local: Vec2, size: Vec2, gap: f32, footprint: f32) -> f32 {
    let room = 0.5 * size - Vec2::splat(gap) - local.abs();
    edge(0.0, room.min_element(), footprint)
}

pub(crate) fn bricks(brick: Rgb, mortar: Rgb, size: Vec2, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let wobble = 0.004
        * Vec2::new(
            value_noise(uv * 14.0, seed),
            value_noise(uv * 14.0, seed ^ 1),
        );
    let (cell, local) = bond(uv + wobble, size);
    let id = hash2(cell, seed);
    let rough = fractal(uv * 40.0, seed ^ 2, 4, footprint * 40.0);
    let tint = Vec3::new(1.0, 0.92 + 0.16 * pick(id, 3), 0.88 + 0.24 * pick(id, 4));
    let burnt = if pick(id, 5) < 0.12 { 0.45 } else { 1.0 };
    let stone = brick * tint * burnt * (0.62 + 0.75 * pick(id, 2)) * (1.0 + 0.4 * rough);
    let joint = mortar * (1.0 + 0.25 * fractal(uv * 120.0, seed ^ 6, 3, footprint * 120.0));
    mix(joint, stone, within(local, size, 0.0055, footprint))
}

pub(crate) fn tiles(first: Rgb, second: Rgb, size: f32, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let cell = (uv / size).floor();
    let local = uv - (cell + 0.5) * size;
    let id = hash2(cell.as_ivec2(), seed);
    let base = if pick(id, 1) < 0.7 { first } else { second };
    let cloud = fractal(uv * 30.0 + 50.0 * pick(id, 2), id, 3, footprint * 30.0);
    let mut face = base * (0.85 + 0.3 * pick(id, 3)) * (1.0 + 0.22 * cloud);
    // One tile in four carries an ornament, each its own.
    if pick(id, 4) < 0.25 {
        let turned = Vec2::from_angle(6.3 * pick(id, 5)).rotate(local / size);
        let n_petals = 3.0 + (5.0 * pick(id, 6)).floor();
        let radius = 0.2 + 0.13 * (turned.y.atan2(turned.x) * n_petals).cos();
        face = mix(
            face,
            palette(id >> 9),
            0.8 * edge(turned.length(), radius, footprint / size),
        );
        face = mix(
            face,
            palette(id >> 13),
            edge(turned.length(), 0.07, footprint / size),
        );
    }
    let speck = nearest_point(uv * 45.0, seed ^ 2);
    face *= 1.0 - 0.35 * edge(speck.distance, 0.25 * pick(speck.id, 3), footprint * 45.0);
    let grout = rgb(0xA8_A296) * (1.0 + 0.3 * fractal(uv * 70.0, seed ^ 4, 2, footprint * 70.0));
    mix(
        grout,
        face,
        within(local, Vec2::splat(size), 0.003, footprint),
    )
}

pub(crate) fn terrazzo(ground: Rgb, size: f32, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let mut colour = ground * (1.0 + 0.1 * fractal(uv * 25.0, seed, 3, footprint * 25.0));
    for (layer, scale) in [(1u32, 1.0 / size), (2, 2.7 / size)] {
        let chip = nearest_point(uv * scale, seed ^ layer);
        if pick(chip.id, 3) < 0.55 {
            let angle = chip.offset.y.atan2(chip.offset.x);
            let radius = (0.18 + 0.2 * pick(chip.id, 4))
                * (1.0 + 0.25 * (angle * 3.0 + 9.0 * pick(chip.id, 5)).sin());
            let stone =
                mix(palette(chip.id >> 7), Rgb::splat(0.5), 0.35) * (0.4 + 0.9 * pick(chip.id, 6));
            let shown = visible(0.5, footprint * scale);
            colour = mix(
                colour,
                stone,
                shown * edge(chip.distance, radius, footprint * scale),
            );
        }
    }
    colour
}

pub(crate) fn metal(colour: Rgb, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let brushed = fractal(uv * Vec2::new(12.0, 260.0), seed, 2, footprint * 260.0);
    flat(colour, spot) * (1.0 + 0.2 * brushed)
}

pub(crate) fn asphalt(spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let patch = nearest_point(uv * 0.5, seed);
    let grain = fractal(uv * 55.0, seed ^ 1, 3, footprint * 55.0);
    let broad = fractal(uv * 0.8, seed ^ 2, 4, footprint * 0.8);
    let pebble = nearest_point(uv * 18.0, seed ^ 3);
    let light = 0.7
        * edge(pebble.distance, 0.28 * pick(pebble.id, 2), footprint * 18.0)
        * pick(pebble.id, 4);
    let tone = 0.11 * (0.8 + 0.4 * pick(patch.id, 1)) * (1.0 + 0.45 * grain + 0.3 * broad + light);
    let seam = 1.0 - 0.6 * stroke(patch.border, 0.008, footprint * 0.5);
    Rgb::new(1.0, 0.98, 0.95) * tone * seam
}

/// Mineral fibre panels with worm holes.
pub(crate) fn ceiling(spot: &Spot) -> Rgb {
    const PANEL: f32 = 0.6;
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let cell = (uv / PANEL).floor();
    let local = uv - (cell + 0.5) * PANEL;
    let id = hash2(cell.as_ivec2(), seed);
    let hole = nearest_point(uv * 24.0, seed ^ 1);
    let angle = 6.3 * pick(hole.id, 3);
    let stretched = Vec2::from_angle(angle).rotate(hole.offset) * Vec2::new(0.5, 1.4);
    let dark = 0.65
        * edge(
            stretched.length(),
            0.05 + 0.16 * pick(hole.id, 4),
            footprint * 24.0,
        );
    let stain = edge(0.55, fractal(uv * 1.1, seed ^ 2, 4, footprint), 0.15) * 0.4;
    let panel = rgb(0xD9_D6CC) * (0.92 + 0.12 * pick(id, 1)) * (1.0 - dark);
    let stained = mix(panel, rgb(0xA8_8B5E), stain);
    mix(
        rgb(0xF0_EFEA),
        stained,
        within(local, Vec2::splat(PANEL), 0.012, footprint),
    )
}

pub(crate) fn bark(spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let ridge = fractal(uv * Vec2::new(26.0, 7.0), seed, 4, footprint * 26.0);
    let scale = nearest_point(uv * Vec2::new(20.0, 8.0), seed ^ 1);
    let gap = 1.0 - 0.7 * stroke(scale.border, 0.06, footprint * 20.0);
    rgb(0x6B_5540) * (1.0 + 0.6 * ridge) * gap
}

/// Glass of a facade: a dim room with curtains and things on the sill, sky in the upper part, glazing bars.
pub(crate) fn pane(spot: &Spot) -> Rgb {
    let Spot {
        uv,
        half,
        footprint,
        seed,
        ..
    } = *spot;
    let at = uv / half;
    let inside = rgb(0x1B_2430) * (1.0 + 0.7 * fractal(uv * 5.0, seed, 4, footprint * 5.0));
    let sky = mix(
        rgb(0x5C_7894),
        rgb(0x8F_A9BF),
        0.5 + fractal(uv * 3.0, seed ^ 1, 4, footprint * 3.0),
    );
    let mut colour = mix(
        inside,
        sky,
        0.55 * edge(0.1 + 0.5 * pick(seed, 2), at.y + 0.3 * at.x, 0.3),
    );
    let drawn = 0.25 + 0.6 * pick(seed, 3);
    let cloth = palette(seed >> 5);
    let folds = 0.7 + 0.5 * value_noise(Vec2::new(uv.x * 28.0, uv.y * 1.5), seed ^ 4);
    let lace = 0.8 + 0.4 * fractal(uv * 60.0, seed ^ 5, 2, footprint * 60.0);
    colour = mix(
        colour,
        cloth * folds * lace * 0.6,
        edge(1.0 - drawn * 0.5, at.x.abs(), footprint / half.x),
    );
    for n in 0..4u32 {
        let id = hash(seed ^ (n + 31));
        let centre = Vec2::new(1.4 * pick(id, 1) - 0.7, -0.95) * half;
        let size = Vec2::new(0.04 + 0.06 * pick(id, 2), 0.1 + 0.2 * pick(id, 3));
        let inside_thing = size - (uv - centre - Vec2::new(0.0, 0.5 * size.y)).abs();
        let thing =
            palette(id >> 6) * (0.4 + 0.4 * fractal(uv * 40.0, id, 3, footprint * 40.0).abs());
        colour = mix(
            colour,
            thing,
            edge(0.0, inside_thing.min_element(), footprint),
        );
    }
    let bar = stroke(uv.x, 0.02, footprint).max(stroke(uv.y - 0.35 * half.y, 0.018, footprint));
    let frame = 1.0 - within(uv, 2.0 * half, 0.045, footprint);
    mix(colour, flat(rgb(0xD8_D4C8), spot), bar.max(frame))
}
