//! Paintings, posters and the view from a window. What is printed is in `prints.rs`.

use glam::{IVec2, Vec2};

use crate::glyphs::{column_ink, line_ink};
use crate::noise::{edge, fractal, hash, hash2, nearest_point, pick, stroke};
use crate::paint::{Painting, Rgb, Spot, hue, mix, palette, rgb};
use crate::prints;

pub(crate) fn painting(kind: Painting, spot: &Spot) -> Rgb {
    // Drawn on a sheet of unit height, so that a motif fills whatever frame it is given.
    let scale = spot.half.y;
    let at = spot.uv / scale;
    let footprint = spot.footprint / scale;
    let motif = match kind {
        Painting::Blocks => blocks(at, spot.half / scale, spot.seed, footprint),
        Painting::Landscape => landscape(at, spot.seed, footprint),
        Painting::Circles => circles(at, spot.half / scale, spot.seed, footprint),
        Painting::Page => page(at, spot.half / scale, spot.seed, footprint),
        Painting::Glass => glass(at, spot.seed, footprint),
        Painting::Contours => contours(at, spot.seed, footprint),
        Painting::Chart => prints::chart(at, spot.half / scale, spot.seed, footprint),
        Painting::Triangles => triangles(at, spot.seed, footprint),
        Painting::Clock => prints::clock(at, spot.seed, footprint),
        Painting::Map => prints::map(at, spot.seed, footprint),
    };
    // Canvas and brush.
    let grain = fractal(spot.uv * 120.0, spot.seed ^ 91, 2, spot.footprint * 120.0);
    motif * (1.0 + 0.16 * grain)
}

/// Five colours that go together, each painting its own; `n` chooses among them.
fn ink(seed: u32, n: u32) -> Rgb {
    let n = n % 5;
    let base = pick(seed, 41);
    let spread = 0.04 + 0.2 * pick(seed, 42);
    let light = 0.25 + 0.7 * pick(seed, 50 + n);
    let strong = 0.25 + 0.65 * pick(seed, 60 + n);
    // The fourth is the complement, the fifth a dark or a light without colour.
    match n {
        3 => hue(base + 0.5, strong, light),
        4 => Rgb::splat(if pick(seed, 43) < 0.5 { 0.03 } else { 0.75 }),
        _ => hue(base + spread * n as f32, strong, light),
    }
}

/// Rectangles in rectangles with black bars between.
fn blocks(at: Vec2, half: Vec2, seed: u32, footprint: f32) -> Rgb {
    let (mut low, mut high, mut id) = (-half, half, seed);
    let mut bar = 0.0_f32;
    for level in 0..6u32 {
        let size = high - low;
        let cut = 0.3 + 0.4 * pick(id, level);
        let upright = size.x > size.y;
        let (x, from, length) = if upright {
            (at.x, low.x, size.x)
        } else {
            (at.y, low.y, size.y)
        };
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
    let paint = if pick(id, 9) < 0.35 {
        rgb(0xE8_E2D2)
    } else {
        ink(seed, id >> 5)
    };
    let brush = 1.0 + 0.25 * fractal(at * Vec2::new(5.0, 30.0), id, 3, footprint * 30.0);
    mix(paint * brush, rgb(0x12_1214), bar)
}

/// Sky, sun, ranges of hills one behind the other, trees on the nearest.
fn landscape(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let dusk = hue(0.95 + 0.25 * pick(seed, 1), 0.3 + 0.5 * pick(seed, 6), 0.95);
    let night = hue(
        0.45 + 0.4 * pick(seed, 2),
        0.3 + 0.5 * pick(seed, 7),
        0.35 + 0.5 * pick(seed, 8),
    );
    let clouds = fractal(at * Vec2::new(2.0, 7.0), seed, 5, footprint * 7.0);
    let mut colour = mix(
        dusk,
        night,
        (0.5 * at.y + 0.5 + 0.7 * clouds).clamp(0.0, 1.0),
    );
    let sun = Vec2::new(pick(seed, 3) - 0.5, 0.25 + 0.3 * pick(seed, 4));
    colour = mix(
        colour,
        rgb(0xFF_E9A8),
        edge(at.distance(sun), 0.16, footprint),
    );
    for n in 0..5u32 {
        let depth = n as f32 / 4.0;
        let ridge = 0.25 - 0.27 * n as f32
            + (0.35 - 0.1 * depth)
                * fractal(
                    Vec2::new(at.x * (1.3 + depth), 7.0 * n as f32),
                    seed ^ (n + 50),
                    6,
                    footprint,
                );
        let ground = mix(night, hue(0.08 + 0.3 * pick(seed, n + 15), 0.7, 0.4), depth);
        let field = nearest_point(at * (4.0 + 9.0 * depth), seed ^ (n + 70));
        let tilled = 1.0 + 0.5 * fractal(at * 22.0, seed ^ (n + 60), 4, footprint * 22.0);
        let patch = 0.55 + 0.9 * pick(field.id, 1);
        colour = mix(
            colour,
            ground * tilled * patch,
            edge(at.y, ridge, footprint),
        );
    }
    colour
}

fn circles(at: Vec2, half: Vec2, seed: u32, footprint: f32) -> Rgb {
    let mut colour = mix(
        mix(rgb(0xEC_E1C6), ink(seed, 2), 0.6),
        ink(seed, 1),
        0.3 + 0.3 * fractal(at * 2.0, seed, 4, footprint * 2.0),
    );
    for n in 0..22u32 {
        let id = hash(seed ^ (n * 37 + 5));
        let centre = Vec2::new(2.0 * pick(id, 1) - 1.0, 2.0 * pick(id, 2) - 1.0) * half;
        let radius = 0.06 + 0.4 * pick(id, 3) * pick(id, 3);
        let distance = at.distance(centre);
        if distance > radius + footprint {
            continue;
        }
        let body = ink(seed, id >> 6) * (1.0 + 0.35 * fractal(at * 16.0, id, 3, footprint * 16.0));
        colour = mix(
            colour,
            body,
            edge(distance, radius, footprint) * (0.6 + 0.4 * pick(id, 4)),
        );
        colour = mix(
            colour,
            ink(seed, id >> 11),
            edge(distance, radius * 0.55, footprint),
        );
        colour = mix(
            colour,
            ink(seed, id >> 15),
            edge(distance, radius * 0.22, footprint),
        );
        colour = mix(
            colour,
            rgb(0x16_1616),
            stroke(distance - radius * 0.8, 0.008, footprint),
        );
    }
    for n in 0..9u32 {
        let id = hash(seed ^ (n * 91 + 13));
        let across = Vec2::from_angle(6.3 * pick(id, 1)).dot(at) - (pick(id, 2) - 0.5);
        colour = mix(
            colour,
            rgb(0x16_1616),
            stroke(across, 0.004 + 0.008 * pick(id, 3), footprint),
        );
    }
    colour
}

/// A printed page: headline, painting, columns.
fn page(at: Vec2, half: Vec2, seed: u32, footprint: f32) -> Rgb {
    const HEADS: [&str; 6] = [
        "ROBOT UPDATES",
        "GOOD MAPS",
        "DAILY RAY",
        "NIGHT TRAIN",
        "OPEN HOUSE",
        "BLUE HOUR",
    ];
    let tint = if pick(seed, 1) < 0.5 {
        rgb(0xF2_EDDF)
    } else {
        mix(rgb(0xF2_EDDF), palette(seed >> 4), 0.55)
    };
    let paper = tint * (1.0 + 0.06 * fractal(at * 5.0, seed, 3, footprint * 5.0));
    let ink = rgb(0x18_181C);
    let head = HEADS[(seed % 6) as usize];
    let width_fit = 2.0 * half.x * 0.85 / (head.len() as f32 * 6.0 / 7.0);
    let headline = line_ink(
        head,
        at - Vec2::new(0.0, 0.78),
        width_fit.min(0.22),
        footprint,
    );
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
        let column = if at.x < 0.0 {
            -0.45 * half.x
        } else {
            0.45 * half.x
        };
        let place = Vec2::new(at.x - column, at.y);
        let words = column_ink(
            place,
            0.37 * half.x,
            0.075,
            seed ^ u32::from(at.x < 0.0),
            footprint,
        );
        colour = mix(colour, ink, words);
    }
    colour
}

/// Leaded glass.
fn glass(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let piece = nearest_point(at * 3.1, seed);
    let shade = fractal(
        at * 9.0 + 20.0 * pick(piece.id, 4),
        piece.id,
        4,
        footprint * 9.0,
    );
    let fill = hue(
        0.35 * pick(piece.id, 3) + pick(seed, 40),
        0.35 + 0.4 * pick(piece.id, 5),
        0.5 + 0.45 * pick(piece.id, 6),
    ) * (1.0 + 0.7 * shade);
    mix(
        fill,
        rgb(0x15_1512),
        stroke(piece.border, 0.045, footprint * 3.1),
    )
}

/// Height lines of a noise landscape between two inks.
fn contours(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let height = 4.5 * fractal(at * 1.1, seed, 4, footprint);
    let level = (height * 1.6).floor();
    let layer = ink(seed, hash(level as i32 as u32) >> 3);
    let inside = height * 1.6 - level;
    let line = stroke(inside - 0.5, 0.46, footprint * 6.0);
    let dots = nearest_point(at * 13.0, seed ^ 2);
    let dotted = mix(
        layer,
        rgb(0xF4_F0E2),
        0.8 * edge(dots.distance, 0.24 * pick(dots.id, 1), footprint * 13.0),
    );
    mix(rgb(0x1A_1A22), dotted, line)
}

fn triangles(at: Vec2, seed: u32, footprint: f32) -> Rgb {
    let scale = 3.4;
    let skewed = Vec2::new(at.x - 0.577 * at.y, 1.155 * at.y) * scale;
    let cell = skewed.floor();
    let local = skewed - cell;
    let upper = local.x + local.y > 1.0;
    let id = hash2(cell.as_ivec2(), seed ^ u32::from(upper));
    let depth = if upper {
        (2.0 - local.x - local.y).min(1.0 - local.x.max(local.y))
    } else {
        local.x.min(local.y)
    };
    let rim = edge(
        0.03,
        depth.min((local.x + local.y - 1.0).abs()),
        footprint * scale,
    );
    let fill = ink(seed, id >> 4) * (0.75 + 0.5 * pick(id, 3));
    let brush = 1.0 + 0.3 * fractal(at * Vec2::new(40.0, 9.0), id, 3, footprint * 40.0);
    mix(rgb(0xF0_EAD8), fill * brush, rim)
}

/// What lies outside a window: sky, roofs, trees, all shining and paler than the room, as a camera sees it.
pub(crate) fn view(spot: &Spot) -> Rgb {
    let Spot {
        uv,
        footprint,
        seed,
        ..
    } = *spot;
    let clouds = fractal(uv * Vec2::new(1.4, 3.0), seed, 5, footprint * 3.0);
    let mut colour = mix(
        rgb(0xB8_D6F0),
        rgb(0xFF_FFFF),
        (0.55 + clouds).clamp(0.0, 1.0),
    ) * 1.3;
    let house = (uv.x / 0.45).floor();
    let id = hash2(IVec2::new(house as i32, 1), seed);
    let roof = -0.05 + 0.25 * pick(id, 1) - 0.3 * ((uv.x / 0.45 - house) - 0.5).abs();
    let wall = mix(palette(id >> 4), Rgb::splat(0.8), 0.55)
        * (1.0 + 0.2 * fractal(uv * 30.0, id, 3, footprint * 30.0));
    let openings = Vec2::new(
        (uv.x * 11.0).rem_euclid(1.0) - 0.5,
        (uv.y * 8.0).rem_euclid(1.0) - 0.5,
    )
    .abs();
    let lit = edge(0.0, 0.25 - openings.max_element(), footprint * 11.0);
    colour = mix(
        colour,
        mix(wall, rgb(0x68_7480), lit),
        edge(uv.y, roof, footprint),
    );
    let tree_top = -0.2 + 0.5 * fractal(Vec2::new(uv.x * 2.2, 0.0), seed ^ 2, 6, footprint);
    let clumps = fractal(uv * 6.0, seed ^ 3, 6, footprint * 6.0);
    let foliage = nearest_point(uv * 34.0, seed ^ 4);
    let leaves = mix(
        rgb(0x5C_7A44),
        rgb(0xC4_D890),
        (0.5 + clumps + 0.3 * pick(foliage.id, 1) - 0.15).clamp(0.0, 1.0),
    );
    mix(colour, leaves * 1.1, edge(uv.y, tree_top, 2.0 * footprint))
}
