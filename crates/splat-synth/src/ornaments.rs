//! Woven, printed and grown things: wallpaper, fabric, rugs, leaves, fruit.

use glam::{IVec2, Vec2};

use crate::noise::{edge, fractal, hash2, nearest_point, pick, stroke, value_noise, visible};
use crate::paint::{Rgb, Spot, mix, palette, rgb};

/// A meadow: each cell holds one sprig of its own shape, small buds between.
pub(crate) fn wallpaper([ground, first, second]: [Rgb; 3], spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let paper = 1.0 + 0.1 * fractal(uv * 9.0, seed, 4, footprint * 9.0);
    let weave = 1.0 + 0.08 * fractal(uv * 150.0, seed ^ 1, 2, footprint * 150.0);
    let mut colour = ground * paper * weave;
    let small = nearest_point(uv * 15.0, seed ^ 2);
    if pick(small.id, 3) < 0.7 {
        let bud = edge(
            small.distance,
            0.08 + 0.16 * pick(small.id, 4),
            footprint * 15.0,
        );
        let tint = mix(second, palette(small.id >> 8), 0.5);
        colour = mix(colour, tint, bud * visible(0.35, footprint * 15.0));
    }
    for (layer, scale) in [(3u32, 6.0_f32), (4, 3.4)] {
        let sprig = nearest_point(uv * scale, seed ^ layer);
        let own = Vec2::from_angle(6.3 * pick(sprig.id, 3)).rotate(sprig.offset);
        colour = sprig_over(colour, own, sprig.id, [first, second], footprint * scale);
    }
    colour
}

/// Stem, leaves on both sides and a flower at the end, within a circle of radius 0.5.
fn sprig_over(under: Rgb, at: Vec2, id: u32, [first, second]: [Rgb; 2], footprint: f32) -> Rgb {
    if at.length_squared() > 0.25 {
        return under;
    }
    let mut colour = under;
    let bow = 0.08 * (at.y * 5.0 + 6.0 * pick(id, 11)).sin();
    let green = mix(first, palette(id >> 4), 0.15) * (0.7 + 0.6 * pick(id, 12));
    let stem = stroke(at.x - bow, 0.012, footprint) * stroke(at.y, 0.4, footprint);
    colour = mix(colour, green * 0.7, stem);
    for n in 0..6u32 {
        let side = if n % 2 == 0 { 1.0 } else { -1.0 };
        let foot = Vec2::new(bow, -0.34 + 0.11 * n as f32);
        let lean = side * (0.7 + 0.5 * pick(id, 20 + n));
        let in_leaf = Vec2::from_angle(-lean).rotate(at - foot) * Vec2::new(side, 1.0);
        let length = 0.09 + 0.09 * pick(id, 30 + n);
        let along = in_leaf.x / length;
        if (0.0..1.0).contains(&along) {
            let half_width = 0.3 * length * (along * (1.0 - along) * 4.0).sqrt();
            let leaf = edge(in_leaf.y.abs(), half_width, footprint);
            let vein = 0.3 * stroke(in_leaf.y, 0.006, footprint);
            colour = mix(
                colour,
                green * (0.8 + 0.5 * pick(id, 40 + n)) * (1.0 + vein),
                leaf,
            );
        }
    }
    let from_flower = at - Vec2::new(0.0, 0.34);
    let n_petals = 4.0 + (4.0 * pick(id, 5)).floor();
    let petals = 0.08 + 0.045 * (from_flower.y.atan2(from_flower.x) * n_petals).cos();
    let bloom = mix(second, palette(id >> 10), 0.5);
    colour = mix(colour, bloom, edge(from_flower.length(), petals, footprint));
    mix(
        colour,
        rgb(0xF0_D060),
        edge(from_flower.length(), 0.03, footprint),
    )
}

/// Stripes and checks of uneven width over a weave.
pub(crate) fn fabric(first: Rgb, second: Rgb, width: f32, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let scaled = uv / width;
    let cell = scaled.floor();
    let local = scaled - cell;
    let along = pick(hash2(IVec2::new(cell.x as i32, 0), seed), 1);
    let across = pick(hash2(IVec2::new(0, cell.y as i32), seed), 2);
    let share = if along < 0.4 { 0.75 } else { 0.1 } * 0.5 + if across < 0.35 { 0.5 } else { 0.0 };
    let mut colour = mix(first, second, share);
    let id = hash2(cell.as_ivec2(), seed ^ 1);
    let thread = stroke(local.x - 0.5, 0.06, footprint / width).max(stroke(
        local.y - 0.5,
        0.06,
        footprint / width,
    ));
    colour = mix(
        colour,
        palette((seed >> 3) + u32::from(along < 0.4)),
        0.6 * thread,
    );
    // Stitched spots, so that the checks do not all look alike.
    if pick(id, 2) < 0.55 {
        let at = local - Vec2::new(0.25 + 0.5 * pick(id, 3), 0.25 + 0.5 * pick(id, 4));
        let dot = edge(at.length(), 0.08 + 0.2 * pick(id, 5), footprint / width);
        colour = mix(
            colour,
            mix(second, palette(id >> 8), 0.6),
            dot * visible(0.4, footprint / width),
        );
    }
    let weave = fractal(uv * 220.0, seed ^ 2, 2, footprint * 220.0);
    let crease = fractal(uv * 7.0, seed ^ 3, 3, footprint * 7.0);
    colour * (1.0 + 0.25 * weave + 0.18 * crease)
}

/// Knotted field of stepped diamonds inside two borders.
pub(crate) fn rug(first: Rgb, second: Rgb, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        half,
        footprint,
        seed,
        ..
    } = *spot;
    const KNOT: f32 = 0.012;
    // The weaver's hand: rows are not quite straight.
    let hand = 0.006 * Vec2::new(value_noise(uv * 5.0, seed), value_noise(uv * 5.0, seed ^ 1));
    let on_grid = ((uv + hand) / KNOT).floor() * KNOT;
    let to_rim = (half - on_grid.abs()).min_element();
    let (cell_size, band) = match to_rim {
        d if d < 0.05 => (0.05, 0),
        d if d < 0.17 => (0.12, 1),
        d if d < 0.23 => (0.06, 2),
        d if d < 0.40 => (0.17, 3),
        _ => (0.34, 4),
    };
    let cell = (on_grid / cell_size).floor();
    let local = on_grid / cell_size - cell - 0.5;
    let id = hash2(cell.as_ivec2(), seed ^ band);
    let diamond = local.x.abs() + local.y.abs();
    let ground = match band {
        0 | 2 => second,
        1 | 3 => mix(first, rgb(0x20_1C28), 0.6),
        _ => first,
    };
    let rings = [
        palette(id >> 3),
        palette(id >> 7),
        mix(second, palette(id >> 11), 0.4),
        palette(id >> 15),
    ];
    let mut colour = ground;
    for (n, ring) in rings.iter().enumerate() {
        let radius = 0.5 - 0.12 * n as f32 - 0.06 * pick(id, n as u32);
        if diamond < radius {
            colour = *ring;
        }
    }
    let speck = pick(hash2((on_grid / KNOT).round().as_ivec2(), seed ^ 9), 1);
    let pile = fractal(uv * 130.0, seed ^ 3, 2, footprint * 130.0);
    let worn = fractal(uv * 2.5, seed ^ 4, 4, footprint * 2.5);
    let knotted = 1.0 + 0.5 * (speck - 0.5) * visible(KNOT, footprint);
    colour * knotted * (1.0 + 0.3 * pile + 0.2 * worn)
}

pub(crate) fn leaf(colour: Rgb, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        half,
        footprint,
        seed,
        ..
    } = *spot;
    let middle = stroke(uv.y, 0.0025, footprint);
    let slant = uv.x - 1.2 * uv.y.abs();
    let spacing = 0.17 * half.x;
    let veins = stroke(slant.rem_euclid(spacing) - 0.5 * spacing, 0.0012, footprint)
        * visible(spacing, footprint);
    let mottled = fractal(uv * 40.0, seed, 3, footprint * 40.0);
    let base = colour * (0.7 + 0.6 * pick(seed, 3)) * (1.0 + 0.3 * mottled);
    mix(base, rgb(0xC8_D890), 0.6 * middle.max(0.7 * veins))
}

pub(crate) fn fruit(colour: Rgb, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let blush = fractal(uv * 14.0, seed, 3, footprint * 14.0);
    let dot = nearest_point(uv * 90.0, seed ^ 1);
    let speck = 0.4 * edge(dot.distance, 0.2, footprint * 90.0);
    mix(colour, rgb(0xE0_B040), (0.4 + blush).clamp(0.0, 1.0) * 0.5) * (1.0 + speck)
}
