//! Furniture of the room, each piece in its own frame with the floor at z = 0.

use glam::{DMat3, DVec3, Vec2, Vec3};

use crate::clutter::ornament;
use crate::noise::{hash, pick};
use crate::paint::{Painting, hue, palette, rgb};
use crate::props::Props;
use crate::textures::Paint;

pub(crate) fn oak() -> Paint {
    Paint::Wood(rgb(0xB5_8850))
}

pub(crate) fn walnut() -> Paint {
    Paint::Wood(rgb(0x7A_5236))
}

pub(crate) fn table(props: &mut Props) {
    props.at(DVec3::ZERO, 0.0);
    let top = Paint::Planks {
        light: rgb(0xC0_8A52),
        dark: rgb(0x86_5630),
        size: Vec2::new(1.5, 0.15),
    };
    props.block([0.0, 0.0, 0.725], [1.5, 0.86, 0.04], top);
    props.block([0.0, 0.0, 0.67], [1.3, 0.68, 0.07], walnut());
    for (x, y) in [(-0.66, -0.35), (0.66, -0.35), (-0.66, 0.35), (0.66, 0.35)] {
        props.tube([x, y, 0.355], 0.7, [0.025, 0.04], walnut());
    }
    // Pendant lamp over it.
    props.tube(
        [0.0, 0.0, 2.4],
        0.6,
        [0.008, 0.008],
        Paint::Flat(rgb(0x22_2222)),
    );
    let shade = Paint::Fabric {
        first: rgb(0xD8_A24A),
        second: rgb(0x9C_4A2A),
        width: 0.05,
    };
    props.tube([0.0, 0.0, 2.0], 0.24, [0.3, 0.12], shade);
    props.ball(
        [0.0, 0.0, 1.9],
        [0.06, 0.06, 0.06],
        Paint::Glow(Vec3::new(1.5, 1.3, 0.95)),
    );
}

pub(crate) fn chair(props: &mut Props) {
    // Seen from the chair the table lies along -y.
    let seat = Paint::Fabric {
        first: rgb(0x7A_3A34),
        second: rgb(0xC8_B890),
        width: 0.04,
    };
    props.block([0.0, 0.0, 0.46], [0.42, 0.42, 0.05], seat);
    for (x, y) in [(-0.18, -0.18), (0.18, -0.18)] {
        props.tube([x, y, 0.86 - 0.43], 0.86, [0.018, 0.016], oak());
    }
    for (x, y) in [(-0.18, 0.18), (0.18, 0.18)] {
        props.tube([x, y, 0.22], 0.44, [0.016, 0.02], oak());
    }
    for n in 0..3 {
        props.block(
            [0.0, -0.18, 0.6 + 0.12 * f64::from(n)],
            [0.36, 0.018, 0.07],
            oak(),
        );
    }
}

/// Six boards with books of all sizes and a few other things between them; the front looks along -y.
pub(crate) fn shelf(props: &mut Props) {
    const WIDTH: f64 = 2.5;
    const TALL: f64 = 2.2;
    const DEEP: f64 = 0.3;
    props.block([0.0, 0.14, 0.5 * TALL], [WIDTH, 0.02, TALL], walnut());
    for x in [-0.5 * WIDTH, 0.0, 0.5 * WIDTH] {
        props.block([x, 0.0, 0.5 * TALL], [0.03, DEEP, TALL], walnut());
    }
    for n in 0..7 {
        props.block(
            [0.0, 0.0, 0.08 + 0.35 * f64::from(n)],
            [WIDTH, DEEP, 0.025],
            walnut(),
        );
    }
    for row in 0..6u32 {
        for side in 0..2u32 {
            let base = 0.093 + 0.35 * f64::from(row);
            let start = -0.5 * WIDTH + 0.5 * WIDTH * f64::from(side) + 0.03;
            let mut x = start;
            let mut n = 0;
            while x < start + 0.5 * WIDTH - 0.12 {
                let id = hash(row * 211 + side * 101 + n * 17 + 9);
                n += 1;
                if pick(id, 9) < 0.05 {
                    ornament(props, DVec3::new(x + 0.07, -0.04, base), id);
                    x += 0.16;
                    continue;
                }
                let thick = 0.018 + 0.034 * f64::from(pick(id, 1));
                let tall = 0.17 + 0.13 * f64::from(pick(id, 2));
                let deep = 0.14 + 0.08 * f64::from(pick(id, 3));
                let lean = if pick(id, 4) < 0.12 { 0.12 } else { 0.0 };
                let centre = [
                    x + 0.5 * thick + lean * 0.1,
                    -0.13 + 0.5 * deep,
                    base + 0.5 * tall,
                ];
                // Cloth and paper bindings: browns, reds, greens, blues, cream, few bright ones.
                let cloth = if pick(id, 5) < 0.75 {
                    palette(id >> 11) * (0.5 + 0.6 * pick(id, 6))
                } else {
                    hue(pick(id, 7), 0.6, 0.6)
                };
                let turn = DMat3::from_rotation_y(-lean);
                props.turned_block(centre, [thick, deep, tall], turn, Paint::Spine(cloth));
                x += thick + 0.002 + lean * 0.35;
            }
        }
    }
    for (x, size, colour) in [
        (-0.9, 0.3, 0x8A_6A48),
        (-0.45, 0.24, 0x5A_7A7A),
        (0.7, 0.34, 0xA8_5A40),
    ] {
        let weave = Paint::Fabric {
            first: rgb(colour),
            second: rgb(0xD8_C8A0),
            width: 0.03,
        };
        props.block([x, 0.0, TALL + 0.09], [size, 0.26, 0.16], weave);
    }
}

/// Faces along -y of its own frame.
pub(crate) fn sofa(props: &mut Props) {
    let cloth = Paint::Fabric {
        first: rgb(0x3E_5A6A),
        second: rgb(0x86_A0A0),
        width: 0.06,
    };
    props.block([0.0, 0.0, 0.22], [2.1, 0.86, 0.3], cloth);
    props.block([0.0, 0.36, 0.55], [2.1, 0.2, 0.6], cloth);
    for x in [-0.98, 0.98] {
        props.block([x, -0.03, 0.4], [0.2, 0.84, 0.5], cloth);
    }
    for x in [-0.45, 0.45] {
        props.block([x, -0.08, 0.42], [0.86, 0.64, 0.14], cloth);
    }
    for (n, x) in [(0u32, -0.68), (1, -0.3), (2, 0.35), (3, 0.72)] {
        let turn = DMat3::from_rotation_z(0.3 * f64::from(pick(n, 3)) - 0.15)
            * DMat3::from_rotation_x(0.35);
        let cover = match n {
            0 => Paint::Rug {
                first: rgb(0xB8_4A30),
                second: rgb(0xE8_D8B0),
            },
            1 => Paint::Wallpaper {
                ground: rgb(0xE8_DCC0),
                first: rgb(0x3A_6A5A),
                second: rgb(0xD0_8A30),
            },
            2 => Paint::Fabric {
                first: rgb(0xD8_B048),
                second: rgb(0x4A_3A5A),
                width: 0.05,
            },
            _ => Paint::Painting(Painting::Triangles),
        };
        props.turned_block([x, 0.16, 0.68], [0.42, 0.13, 0.4], turn, cover);
    }
    props.block(
        [0.5, -0.1, 0.495],
        [0.6, 0.66, 0.015],
        Paint::Rug {
            first: rgb(0x2E_5A6E),
            second: rgb(0xE4_D2A8),
        },
    );
    for (x, y) in [(-0.95, -0.35), (0.95, -0.35), (-0.95, 0.35), (0.95, 0.35)] {
        props.tube([x, y, 0.04], 0.08, [0.02, 0.03], walnut());
    }
}

pub(crate) fn sideboard(props: &mut Props) {
    let chest = Paint::Drawers {
        wood: rgb(0xB0_7C4A),
        rows: 2,
        columns: 4,
    };
    props.block([0.0, 0.0, 0.46], [2.1, 0.44, 0.72], chest);
    props.block([0.0, 0.0, 0.84], [2.16, 0.48, 0.035], oak());
    for x in [-0.95, 0.95] {
        props.block([x, 0.0, 0.05], [0.06, 0.36, 0.1], walnut());
    }
    // Radio, records, candles, more books.
    let front = Paint::Fabric {
        first: rgb(0x5A_4632),
        second: rgb(0xC0_A878),
        width: 0.02,
    };
    props.block([-0.55, -0.02, 0.98], [0.42, 0.2, 0.25], walnut());
    props.sheet([-0.6, -0.125, 0.98], -90.0, [0.24, 0.19], front);
    props.sheet(
        [-0.41, -0.125, 0.98],
        -90.0,
        [0.09, 0.09],
        Paint::Painting(Painting::Clock),
    );
    for n in 0..12u32 {
        let id = hash(n + 900);
        let tall = 0.2 + 0.1 * f64::from(pick(id, 1));
        let centre = [-0.2 + 0.042 * f64::from(n), 0.03, 0.857 + 0.5 * tall];
        props.block(
            centre,
            [0.038, 0.18, tall],
            Paint::Spine(hue(pick(id, 2), 0.6, 0.3 + 0.5 * pick(id, 3))),
        );
    }
    for (x, tall) in [(0.45, 0.22), (0.53, 0.15), (0.6, 0.28)] {
        props.tube(
            [x, -0.08, 0.857 + 0.5 * tall],
            tall,
            [0.028, 0.026],
            Paint::Fruit(rgb(0xE6_D8B8)),
        );
    }
}
