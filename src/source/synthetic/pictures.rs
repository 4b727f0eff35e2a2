//! Paintings, posters, pages, book spines, signs and the view from a window.

use glam::{IVec2, Vec2};

use super::glyphs::{column_ink, line_ink};
use super::noise::{edge, fractal, hash, hash2, nearest_point, pick, stroke, value_noise};
use super::textures::{Picture, Rgb, Spot, flat, hue, mix, palette, rgb};

pub(super) fn picture(kind: Picture, spot: &Spot) -> Rgb {
    // Drawn on a sheet of unit height, so that a motif fills whatever frame it is given.
    let scale = spot.half.y;
    let at = spot.uv / scale;
    let footprint = spot.footprint / scale;
    let motif = match kind {
        Picture::Blocks => blocks(at, spot.half / scale, spot.seed, footprint),
        Picture::Landscape => landscape(at, spot.seed, footprint),
        Picture::Circles => circles(at, spot.half / scale, spot.seed, footprint),
        Picture::Page => page(at, spot.half / scale, spot.seed, footprint),
        Picture::Glass => glass(at, spot.seed, footprint),
        Picture::Contours => contours(at, spot.seed, footprint),
        Picture::Chart => chart(at, spot.half / scale, spot.seed, footprint),
        Picture::Triangles => triangles(at, spot.seed, footprint),
        Picture::Clock => clock(at, spot.seed, footprint),
        Picture::Map => map(at, spot.seed, footprint),
    };
    // Canvas and brush.
    let grain = fractal(spot.uv * 120.0, spot.seed ^ 91, 2, spot.footprint * 120.0);
    motif * (1.0 + 0.16 * grain)
}

/// Rectangles in rectangles with black bars between.
fn blocks(at: Vec2, half: Vec2, seed: u32, footprint: f32) -> Rgb {
    let (mut low, mut high, mut id) = (-half, half, seed);
    let mut bar = 0.0_f32;
    for level in 0..6u32 {
        let size = high - low;
        let cut = 0.3 + 0.4 * pick(id, level);
        let upright = size.x > size.y;
        let (x, from, length) = if upright { (at.x, low.x, size.x) } else { (at.y, low.y, size.y) };
        let place = from + cut * length;
        bar = bar.max(stroke(x - place, 0.016, footprint));
        let after = x > place;
        match (upright, after) {
            (true, true) => low.x = place,
            (true, false) => high.x = place,
            (false, true) => low.y = place,
            (false, false) => high.y = place,
        }
        id = hash(id ^ (level * 2 + u32::from(after) + 1));
    }
    let paint = if pick(id, 9) < 0.4 { rgb(0xE8_E2D2) } else { palette(id >> 5) };
    let brush = 1.0 + 0.25 * fractal(at * Vec2::new(5.0, 30.0), id, 3, footprint * 30.0);
    mix(paint * brush, rgb(0x12_1214), bar)
}

/// Sky, sun, ranges of hills one behind the other, trees on the nearest.
fn landscape(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let dusk = hue(0.02 + 0.1 * pick(seed, 1), 0.6, 0.95);
    let night = hue(0.55 + 0.15 * pick(seed, 2), 0.6, 0.6);
    let clouds = fractal(at * Vec2::new(2.0, 7.0), seed, 5, footprint * 7.0);
    let mut colour = mix(dusk, night, (0.5 * at.y + 0.5 + 0.7 * clouds).clamp(0.0, 1.0));
    let sun = Vec2::new(pick(seed, 3) - 0.5, 0.25 + 0.3 * pick(seed, 4));
    colour = mix(colour, rgb(0xFF_E9A8), edge(at.distance(sun), 0.16, footprint));
    for n in 0..5u32 {
        let depth = n as f32 / 4.0;
        let ridge = 0.25 - 0.27 * n as f32
            + (0.35 - 0.1 * depth) * fractal(Vec2::new(at.x * (1.3 + depth), 7.0 * n as f32), seed ^ (n + 50), 6, footprint);
        let ground = mix(night, hue(0.25 + 0.12 * pick(seed, n + 5), 0.7, 0.35), depth);
        let field = nearest_point(at * (4.0 + 9.0 * depth), seed ^ (n + 70));
        let tilled = 1.0 + 0.5 * fractal(at * 22.0, seed ^ (n + 60), 4, footprint * 22.0);
        let patch = 0.55 + 0.9 * pick(field.id, 1);
        colour = mix(colour, ground * tilled * patch, edge(at.y, ridge, footprint));
    }
    colour
}

fn circles(at: Vec2, half: Vec2, seed: u32, footprint: f32) -> Rgb {
    let mut colour = mix(rgb(0xEC_E1C6), palette(seed >> 3), 0.3 + 0.3 * fractal(at * 2.0, seed, 4, footprint * 2.0));
    for n in 0..22u32 {
        let id = hash(seed ^ (n * 37 + 5));
        let centre = Vec2::new(2.0 * pick(id, 1) - 1.0, 2.0 * pick(id, 2) - 1.0) * half;
        let radius = 0.06 + 0.4 * pick(id, 3) * pick(id, 3);
        let distance = at.distance(centre);
        if distance > radius + footprint {
            continue;
        }
        let body = palette(id >> 6) * (1.0 + 0.35 * fractal(at * 16.0, id, 3, footprint * 16.0));
        colour = mix(colour, body, edge(distance, radius, footprint) * (0.6 + 0.4 * pick(id, 4)));
        colour = mix(colour, palette(id >> 11), edge(distance, radius * 0.55, footprint));
        colour = mix(colour, palette(id >> 15), edge(distance, radius * 0.22, footprint));
        colour = mix(colour, rgb(0x16_1616), stroke(distance - radius * 0.8, 0.008, footprint));
    }
    for n in 0..9u32 {
        let id = hash(seed ^ (n * 91 + 13));
        let across = Vec2::from_angle(6.3 * pick(id, 1)).dot(at) - (pick(id, 2) - 0.5);
        colour = mix(colour, rgb(0x16_1616), stroke(across, 0.004 + 0.008 * pick(id, 3), footprint));
    }
    colour
}

/// A printed page: headline, picture, columns.
fn page(at: Vec2, half: Vec2, seed: u32, footprint: f32) -> Rgb {
    const HEADS: [&str; 6] = ["ROBOT NEWS", "GOOD MAPS", "DAILY RAY", "NIGHT TRAIN", "OPEN HOUSE", "BLUE HOUR"];
    let tint = if pick(seed, 1) < 0.5 { rgb(0xF2_EDDF) } else { mix(rgb(0xF2_EDDF), palette(seed >> 4), 0.55) };
    let paper = tint * (1.0 + 0.06 * fractal(at * 5.0, seed, 3, footprint * 5.0));
    let ink = rgb(0x18_181C);
    let head = HEADS[(seed % 6) as usize];
    let width_fit = 2.0 * half.x * 0.85 / (head.len() as f32 * 6.0 / 7.0);
    let headline = line_ink(head, at - Vec2::new(0.0, 0.78), width_fit.min(0.22), footprint);
    let mut colour = mix(paper, ink, headline);
    let inset = Vec2::new(0.0, 0.28);
    let room = Vec2::new(0.82 * half.x, 0.32) - (at - inset).abs();
    if room.min_element() > 0.0 {
        let own = hash(seed ^ 7);
        return match own % 3 {
            0 => landscape((at - inset) / 0.35, own, footprint / 0.35),
            1 => glass((at - inset) / 0.35, own, footprint / 0.35),
            _ => circles((at - inset) / 0.35, half / 0.35, own, footprint / 0.35),
        };
    }
    if at.y < -0.1 && at.y > -0.9 {
        let column = if at.x < 0.0 { -0.45 * half.x } else { 0.45 * half.x };
        let place = Vec2::new(at.x - column, at.y);
        let words = column_ink(place, 0.37 * half.x, 0.075, seed ^ u32::from(at.x < 0.0), footprint);
        colour = mix(colour, ink, words);
    }
    colour
}

/// Leaded glass.
fn glass(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let piece = nearest_point(at * 3.1, seed);
    let shade = fractal(at * 9.0 + 20.0 * pick(piece.id, 4), piece.id, 4, footprint * 9.0);
    let fill = hue(pick(piece.id, 3), 0.35 + 0.4 * pick(piece.id, 5), 0.5 + 0.45 * pick(piece.id, 6)) * (1.0 + 0.7 * shade);
    mix(fill, rgb(0x15_1512), stroke(piece.border, 0.045, footprint * 3.1))
}

/// Height lines of a noise landscape between two inks.
fn contours(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let height = 4.5 * fractal(at * 1.1, seed, 4, footprint);
    let level = (height * 1.6).floor();
    let layer = palette((level as i32 as u32).wrapping_mul(5).wrapping_add(seed >> 4));
    let inside = height * 1.6 - level;
    let line = stroke(inside - 0.5, 0.46, footprint * 6.0);
    let dots = nearest_point(at * 13.0, seed ^ 2);
    let dotted = mix(layer, rgb(0xF4_F0E2), 0.8 * edge(dots.distance, 0.24 * pick(dots.id, 1), footprint * 13.0));
    mix(rgb(0x1A_1A22), dotted, line)
}

/// Axes, grid, bars and a curve with a legend.
fn chart(at: Vec2, half: Vec2, seed: u32, footprint: f32) -> Rgb {
    let paper = rgb(0xEE_F0EE);
    let grid = stroke((at.x * 6.0).rem_euclid(1.0) - 0.5, 0.02, footprint * 6.0)
        .max(stroke((at.y * 6.0).rem_euclid(1.0) - 0.5, 0.02, footprint * 6.0));
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
    colour = mix(colour, rgb(0xB0_2A30), stroke(at.y - curve, 0.018, footprint));
    let words = column_ink(at - Vec2::new(0.0, 0.7), 0.6 * half.x, 0.09, seed, footprint);
    let in_legend = at.y > 0.62 && at.y < 0.9;
    mix(colour, rgb(0x20_2024), if in_legend { words } else { 0.0 })
}

fn triangles(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let scale = 3.4;
    let skewed = Vec2::new(at.x - 0.577 * at.y, 1.155 * at.y) * scale;
    let cell = skewed.floor();
    let local = skewed - cell;
    let upper = local.x + local.y > 1.0;
    let id = hash2(cell.as_ivec2(), seed ^ u32::from(upper));
    let depth = if upper { (2.0 - local.x - local.y).min(1.0 - local.x.max(local.y)) } else { local.x.min(local.y) };
    let rim = edge(0.03, depth.min((local.x + local.y - 1.0).abs()), footprint * scale);
    let fill = palette(id >> 4) * (0.75 + 0.5 * pick(id, 3));
    let brush = 1.0 + 0.3 * fractal(at * Vec2::new(40.0, 9.0), id, 3, footprint * 40.0);
    mix(rgb(0xF0_EAD8), fill * brush, rim)
}

fn clock(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let radius = at.length();
    let angle = at.x.atan2(at.y);
    let twelfth = (angle * 12.0 / std::f32::consts::TAU + 0.5).rem_euclid(1.0) - 0.5;
    let minute = (angle * 60.0 / std::f32::consts::TAU + 0.5).rem_euclid(1.0) - 0.5;
    let face = rgb(0xEE_E8D8) * (1.0 + 0.1 * fractal(at * 6.0, seed, 3, footprint * 6.0));
    let ink = rgb(0x1C_1A18);
    let hour_mark = stroke(twelfth, 0.07, footprint * 2.5) * stroke(radius - 0.74, 0.09, footprint);
    let minute_mark = stroke(minute, 0.12, footprint * 10.0) * stroke(radius - 0.86, 0.03, footprint);
    let hand = |at_angle: f32, length: f32, width: f32| {
        let turned = Vec2::from_angle(at_angle).rotate(at);
        stroke(turned.x, width, footprint) * stroke(turned.y - 0.45 * length, 0.5 * length, footprint)
    };
    let hands = hand(1.1, 0.5, 0.035).max(hand(4.4, 0.75, 0.022)).max(edge(radius, 0.06, footprint));
    let printed = mix(face, ink, hour_mark.max(minute_mark).max(hands));
    mix(rgb(0x6A_2E22), printed, edge(radius, 0.93, footprint))
}

/// Streets, blocks, a river and a park.
fn map(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let bent = at + 0.18 * Vec2::new(value_noise(at * 1.5, seed), value_noise(at * 1.5, seed ^ 1));
    let district = nearest_point(bent * 5.5, seed ^ 2);
    let quarter = nearest_point(bent * 1.7, seed ^ 3);
    let land = if pick(district.id, 3) < 0.16 { rgb(0xA8_C98C) } else { mix(rgb(0xE6_DDC8), palette(district.id >> 6), 0.25) };
    let houses = nearest_point(bent * 24.0, seed ^ 4);
    let mut colour = mix(land, rgb(0x9C_8F82), 0.7 * edge(houses.distance, 0.3 * pick(houses.id, 1), footprint * 24.0));
    colour = mix(colour, rgb(0xFA_FAF6), stroke(district.border, 0.05, footprint * 5.5));
    colour = mix(colour, rgb(0xE8_A24A), stroke(quarter.border, 0.028, footprint * 1.7));
    let river = at.y - 0.5 * value_noise(Vec2::new(at.x * 1.2, 3.3), seed ^ 5);
    mix(colour, rgb(0x7F_B0D0), stroke(river, 0.06, footprint))
}

/// Back of a book; u across, v up. Title along the spine, bands, a printer's mark.
pub(super) fn spine(colour: Rgb, spot: &Spot) -> Rgb {
    let Spot { uv, half, footprint, seed, face } = *spot;
    if face >= 4 {
        let leaves = fractal(uv * Vec2::new(400.0, 3.0), seed, 2, footprint * 400.0);
        return rgb(0xE4_DBC4) * (0.85 + 0.3 * leaves);
    }
    let cloth = flat(colour, spot) * (1.0 + 0.2 * fractal(uv * 140.0, seed, 2, footprint * 140.0));
    let ink = if pick(seed, 1) < 0.5 { rgb(0xE8_C870) } else { mix(rgb(0xF4_F0E6), palette(seed >> 9), 0.3) };
    let at = uv.y / half.y;
    let mut marked = 0.0_f32;
    for n in 0..4u32 {
        let place = 1.9 * pick(seed, 10 + n) - 0.95;
        marked = marked.max(stroke(at - place, 0.012 + 0.03 * pick(seed, 20 + n), footprint / half.y));
    }
    let label = stroke(at - 0.15, 0.5, footprint / half.y) * if pick(seed, 2) < 0.4 { 1.0 } else { 0.0 };
    let body = mix(mix(cloth, ink, marked), palette(seed >> 13), label);
    let along = Vec2::new(-uv.y + 0.15 * half.y, uv.x);
    let height = (1.1 * half.x).min(0.022);
    let n = ((1.0 * half.y / height) as usize).clamp(3, 12);
    const TITLES: [&str; 8] = [
        "THE LONG WALK", "ATLAS OF DUST", "SEVEN RIVERS", "LIGHT AND LENS", "NORTH BY SEA", "OLD MACHINES", "GARDEN YEAR",
        "COLD HARBOUR",
    ];
    let title = TITLES[(seed >> 17) as usize % 8];
    let words = line_ink(&title[..n.min(title.len())], along, height, footprint);
    let written = mix(body, if label > 0.5 { rgb(0x18_1818) } else { ink }, words);
    // The back is round: it darkens to its sides.
    written * (1.0 - 0.35 * (uv.x / half.x).powi(4))
}

pub(super) fn label(ground: Rgb, ink: Rgb, text: &str, spot: &Spot) -> Rgb {
    let Spot { uv, half, footprint, .. } = *spot;
    let height = (1.2 * half.y).min(2.0 * half.x * 0.9 / (text.len() as f32 * 6.0 / 7.0));
    let rim = (half - uv.abs()).min_element() - 0.08 * half.y;
    let frame = stroke(rim, 0.02 * half.y, footprint);
    mix(flat(ground, spot), ink, line_ink(text, uv, height, footprint).max(frame))
}

/// What lies outside a window: sky, roofs, trees, all shining.
pub(super) fn view(spot: &Spot) -> Rgb {
    let Spot { uv, footprint, seed, .. } = *spot;
    let clouds = fractal(uv * Vec2::new(1.4, 3.0), seed, 5, footprint * 3.0);
    let mut colour = mix(rgb(0xA8_CBEA), rgb(0xF4_F6F8), (0.5 + clouds).clamp(0.0, 1.0));
    let house = (uv.x / 0.45).floor();
    let id = hash2(IVec2::new(house as i32, 1), seed);
    let roof = -0.1 + 0.25 * pick(id, 1) - 0.3 * ((uv.x / 0.45 - house) - 0.5).abs();
    let wall = palette(id >> 4) * 0.7 + Rgb::splat(0.2);
    let openings = Vec2::new((uv.x * 11.0).rem_euclid(1.0) - 0.5, (uv.y * 8.0).rem_euclid(1.0) - 0.5).abs();
    let lit = edge(0.0, 0.25 - openings.max_element(), footprint * 11.0);
    colour = mix(colour, mix(wall, rgb(0x38_4450), lit), edge(uv.y, roof, footprint));
    let tree_top = -0.25 + 0.3 * fractal(Vec2::new(uv.x * 2.2, 0.0), seed ^ 2, 5, footprint);
    let foliage = nearest_point(uv * 22.0, seed ^ 3);
    let leaves = mix(rgb(0x3C_5E24), rgb(0x9C_B850), pick(foliage.id, 1));
    mix(colour, leaves, edge(uv.y, tree_top, footprint)) * 1.1
}
