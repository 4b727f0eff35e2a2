//! Printed things: charts, maps, dials, book spines and signs.

use glam::{IVec2, Vec2};

use crate::glyphs::{column_ink, line_ink};
use crate::noise::{edge, fractal, hash2, nearest_point, pick, stroke, value_noise};
use crate::paint::{Rgb, Spot, flat, mix, palette, rgb};

/// Axes, grid, bars and a curve with a legend.
pub(crate) fn chart(at: Vec2, half: Vec2, seed: u32, footprint: f32) -> Rgb {
    let paper = rgb(0xEE_F0EE);
    let grid = stroke((at.x * 6.0).rem_euclid(1.0) - 0.5, 0.02, footprint * 6.0).max(stroke(
        (at.y * 6.0).rem_euclid(1.0) - 0.5,
        0.02,
        footprint * 6.0,
    ));
    let mut colour = mix(paper, rgb(0x9A_B0BC), 0.7 * grid);
    let bar_width = 0.16;
    let bar = (at.x / bar_width).floor();
    let id = hash2(IVec2::new(bar as i32, 3), seed);
    let in_bar = at.x - (bar + 0.5) * bar_width;
    let top = -0.8 + 1.2 * pick(id, 1);
    if at.x.abs() < 0.85 * half.x && at.y > -0.8 && at.y < top && in_bar.abs() < 0.055 {
        colour = palette(id >> 5) * (0.9 + 0.2 * fractal(at * 25.0, id, 2, footprint * 25.0));
    }
    let curve = 0.2 + 0.5 * fractal(Vec2::new(at.x * 2.5, 0.0), seed ^ 4, 5, footprint);
    colour = mix(
        colour,
        rgb(0xB0_2A30),
        stroke(at.y - curve, 0.018, footprint),
    );
    let words = column_ink(
        at - Vec2::new(0.0, 0.7),
        0.6 * half.x,
        0.09,
        seed,
        footprint,
    );
    let in_legend = at.y > 0.62 && at.y < 0.9;
    mix(colour, rgb(0x20_2024), if in_legend { words } else { 0.0 })
}

pub(crate) fn clock(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let radius = at.length();
    let angle = at.x.atan2(at.y);
    let twelfth = (angle * 12.0 / std::f32::consts::TAU + 0.5).rem_euclid(1.0) - 0.5;
    let minute = (angle * 60.0 / std::f32::consts::TAU + 0.5).rem_euclid(1.0) - 0.5;
    let face = rgb(0xEE_E8D8) * (1.0 + 0.1 * fractal(at * 6.0, seed, 3, footprint * 6.0));
    let ink = rgb(0x1C_1A18);
    let hour_mark = stroke(twelfth, 0.07, footprint * 2.5) * stroke(radius - 0.74, 0.09, footprint);
    let minute_mark =
        stroke(minute, 0.12, footprint * 10.0) * stroke(radius - 0.86, 0.03, footprint);
    let hand = |at_angle: f32, length: f32, width: f32| {
        let turned = Vec2::from_angle(at_angle).rotate(at);
        stroke(turned.x, width, footprint)
            * stroke(turned.y - 0.45 * length, 0.5 * length, footprint)
    };
    let hands = hand(1.1, 0.5, 0.035)
        .max(hand(4.4, 0.75, 0.022))
        .max(edge(radius, 0.06, footprint));
    let printed = mix(face, ink, hour_mark.max(minute_mark).max(hands));
    mix(rgb(0x6A_2E22), printed, edge(radius, 0.93, footprint))
}

/// Streets, blocks, a river and a park.
pub(crate) fn map(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let distorted =
        at + 0.18 * Vec2::new(value_noise(at * 1.5, seed), value_noise(at * 1.5, seed ^ 1));
    let district = nearest_point(distorted * 5.5, seed ^ 2);
    let quarter = nearest_point(distorted * 1.7, seed ^ 3);
    let land = if pick(district.id, 3) < 0.16 {
        rgb(0xA8_C98C)
    } else {
        mix(rgb(0xE6_DDC8), palette(district.id >> 6), 0.25)
    };
    let houses = nearest_point(distorted * 24.0, seed ^ 4);
    let mut colour = mix(
        land,
        rgb(0x9C_8F82),
        0.7 * edge(houses.distance, 0.3 * pick(houses.id, 1), footprint * 24.0),
    );
    colour = mix(
        colour,
        rgb(0xFA_FAF6),
        stroke(district.border, 0.05, footprint * 5.5),
    );
    colour = mix(
        colour,
        rgb(0xE8_A24A),
        stroke(quarter.border, 0.028, footprint * 1.7),
    );
    let river = at.y - 0.5 * value_noise(Vec2::new(at.x * 1.2, 3.3), seed ^ 5);
    mix(colour, rgb(0x7F_B0D0), stroke(river, 0.06, footprint))
}

/// Back of a book; u across, v up. Title along the spine, bands, a printer's mark.
pub(crate) fn spine(colour: Rgb, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        half,
        footprint,
        seed,
        face,
    } = *spot;
    if face >= 4 {
        let leaves = fractal(uv * Vec2::new(400.0, 3.0), seed, 2, footprint * 400.0);
        return rgb(0xE4_DBC4) * (0.85 + 0.3 * leaves);
    }
    let cloth = flat(colour, spot) * (1.0 + 0.2 * fractal(uv * 140.0, seed, 2, footprint * 140.0));
    let ink = if pick(seed, 1) < 0.5 {
        rgb(0xE8_C870)
    } else {
        mix(rgb(0xF4_F0E6), palette(seed >> 9), 0.3)
    };
    let at = uv.y / half.y;
    let mut marked = 0.0_f32;
    for n in 0..4u32 {
        let place = 1.9 * pick(seed, 10 + n) - 0.95;
        marked = marked.max(stroke(
            at - place,
            0.012 + 0.03 * pick(seed, 20 + n),
            footprint / half.y,
        ));
    }
    let label =
        stroke(at - 0.15, 0.5, footprint / half.y) * if pick(seed, 2) < 0.4 { 1.0 } else { 0.0 };
    let body = mix(mix(cloth, ink, marked), palette(seed >> 13), label);
    let along = Vec2::new(-uv.y + 0.15 * half.y, uv.x);
    let height = (1.1 * half.x).min(0.022);
    let n = ((1.0 * half.y / height) as usize).clamp(3, 12);
    const TITLES: [&str; 8] = [
        "THE LONG WALK",
        "ATLAS OF DUST",
        "SEVEN RIVERS",
        "LIGHT AND LENS",
        "NORTH BY SEA",
        "OLD MACHINES",
        "GARDEN YEAR",
        "COLD HARBOUR",
    ];
    let title = TITLES[(seed >> 17) as usize % 8];
    let words = line_ink(&title[..n.min(title.len())], along, height, footprint);
    let written = mix(body, if label > 0.5 { rgb(0x18_1818) } else { ink }, words);
    // The back is round: it darkens to its sides.
    written * (1.0 - 0.35 * (uv.x / half.x).powi(4))
}

pub(crate) fn label(ground: Rgb, ink: Rgb, text: &str, spot: &Spot) -> Rgb {
    let Spot {
        uv,
        half,
        footprint,
        ..
    } = *spot;
    let height = (1.2 * half.y).min(2.0 * half.x * 0.9 / (text.len() as f32 * 6.0 / 7.0));
    let rim = (half - uv.abs()).min_element() - 0.08 * half.y;
    let frame = stroke(rim, 0.02 * half.y, footprint);
    mix(
        flat(ground, spot),
        ink,
        line_ink(text, uv, height, footprint).max(frame),
    )
}
