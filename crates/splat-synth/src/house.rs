//! Two rooms and the door between them: walked in a figure of eight, twice through the door in a round.
//!
//! x points east, y north, z up; the wall with the door stands at x = 0. Metres.

use glam::{DVec3, Vec2, Vec3};

use crate::clutter::{ornament, plant};
use crate::corridor::MOTIFS;
use crate::furniture::{oak, shelf, sideboard, sofa, walnut};
use crate::light::{Lamp, Light};
use crate::lighting::lit;
use crate::noise::{hash, pick};
use crate::paint::{Painting, palette, rgb};
use crate::props::Props;
use crate::scene::Scene;
use crate::textures::Paint;

/// Of both rooms together.
const HALF_X: f64 = 3.7;
const HALF_Y: f64 = 1.9;
const HEIGHT: f64 = 2.5;
/// Of the wall between them, and the opening in it.
const THICKNESS: f64 = 0.12;
const DOOR: [f64; 2] = [0.95, 2.05];

pub(crate) fn scene() -> Scene {
    let mut props = Props::new();
    shell(&mut props);
    partition(&mut props);
    for (side, y, facing) in [(0, -HALF_Y, 90.0), (1, HALF_Y, -90.0)] {
        for (room, x) in [(0, -0.5 * HALF_X), (1, 0.5 * HALF_X)] {
            hangings(&mut props, [x, y], facing, 2 * side + room);
        }
    }
    for (room, x, facing) in [(4, -HALF_X, 0.0), (5, HALF_X, 180.0)] {
        hangings(&mut props, [x, 0.0], facing, room);
    }
    shelf(props.at(DVec3::new(-2.0, HALF_Y - 0.16, 0.0), 0.0));
    sideboard(props.at(DVec3::new(-HALF_X + 0.24, -0.1, 0.0), 90.0));
    plant(props.at(DVec3::new(-0.5, 1.5, 0.0), 20.0), 1.3, 60, 11);
    plant(props.at(DVec3::new(3.25, -1.45, 0.0), 0.0), 1.4, 60, 12);
    sofa(props.at(DVec3::new(HALF_X - 0.48, 0.35, 0.0), -90.0));
    for (x, id) in [(-1.55, 21), (1.55, 22)] {
        stool(&mut props, x, id);
    }
    // Boxes along the walls, one of them 30 cm wide and low.
    for (x, y, size, id) in [
        (-3.2, -1.5, [0.6, 0.5, 0.7], 31),
        (-0.6, -1.6, [0.5, 0.4, 0.5], 32),
        (0.55, 1.6, [0.4, 0.4, 0.9], 33),
        (2.2, 1.65, [0.8, 0.35, 0.75], 34),
        (1.9, -1.65, [0.3, 0.3, 0.3], 35),
    ] {
        let paint = Paint::Fabric {
            first: palette(id),
            second: rgb(0xD8_CCB0),
            width: 0.06,
        };
        props
            .at(DVec3::ZERO, 0.0)
            .block([x, y, 0.5 * size[2]], size, paint);
        ornament(&mut props, DVec3::new(x, y, size[2]), id);
    }
    lit(props, light())
}

fn light() -> Light {
    let lamp = |x: f64| Lamp {
        centre: DVec3::new(x, 0.0, HEIGHT - 0.05),
        half_u: DVec3::X * 0.45,
        half_v: DVec3::Y * -0.3,
        colour: Vec3::new(1.1, 1.0, 0.88) * 3.6,
    };
    Light {
        lamps: vec![lamp(-1.9), lamp(1.9)],
        sun: None,
        sky: Vec3::splat(0.6),
        bounce: Vec3::new(1.02, 1.0, 0.96) * 0.85,
        reach: 0.5,
        texel: 0.08,
    }
}

/// Each room has a floor and walls of its own.
fn shell(props: &mut Props) {
    let floors = [
        Paint::Parquet {
            light: rgb(0xC8_9A62),
            dark: rgb(0x8A_5C36),
        },
        Paint::Tiles {
            first: rgb(0xB8_B09C),
            second: rgb(0x8C_7A68),
            size: 0.2,
        },
    ];
    let walls = [
        Paint::Wallpaper {
            ground: rgb(0xD5_D2BC),
            first: rgb(0x4E_7350),
            second: rgb(0xC2_6A58),
        },
        Paint::Bricks {
            brick: rgb(0xA9_5A42),
            mortar: rgb(0xB8_AE9E),
            size: Vec2::new(0.215, 0.072),
        },
    ];
    for (room, side) in [(0, -1.0), (1, 1.0)] {
        let x = side * 0.5 * HALF_X;
        let (floor, wall) = (floors[room], walls[room]);
        props.flat([x, 0.0, 0.0], 1.0, [HALF_X, 2.0 * HALF_Y], floor);
        props.flat(
            [x, 0.0, HEIGHT],
            -1.0,
            [HALF_X, 2.0 * HALF_Y],
            Paint::Ceiling,
        );
        let middle = 0.5 * HEIGHT;
        props.sheet([x, -HALF_Y, middle], 90.0, [HALF_X, HEIGHT], wall);
        props.sheet([x, HALF_Y, middle], -90.0, [HALF_X, HEIGHT], wall);
        let inward = if side < 0.0 { 0.0 } else { 180.0 };
        props.sheet(
            [side * HALF_X, 0.0, middle],
            inward,
            [2.0 * HALF_Y, HEIGHT],
            wall,
        );
    }
}

/// The wall between the rooms, with jambs and a lintel.
fn partition(props: &mut Props) {
    let [wide, high] = DOOR;
    let paint = Paint::Planks {
        light: rgb(0xB4_8A5C),
        dark: rgb(0x7E_5634),
        size: Vec2::new(0.9, 0.11),
    };
    let length = HALF_Y - 0.5 * wide;
    for side in [-1.0, 1.0] {
        let y = side * (HALF_Y - 0.5 * length);
        props.block([0.0, y, 0.5 * HEIGHT], [THICKNESS, length, HEIGHT], paint);
        let jamb = side * (0.5 * wide + 0.02);
        props.block(
            [0.0, jamb, 0.5 * high],
            [THICKNESS + 0.06, 0.06, high],
            walnut(),
        );
        for facing in [0.0, 180.0] {
            let x = if facing > 0.0 { -0.5 } else { 0.5 } * THICKNESS;
            let motif = [
                Painting::Landscape,
                Painting::Map,
                Painting::Chart,
                Painting::Circles,
            ];
            let ix = usize::from(side > 0.0) + 2 * usize::from(facing > 0.0);
            let motif = Paint::Painting(motif[ix]);
            props.framed([x, 0.95 * side, 1.5], facing, [0.5, 0.65], oak(), motif);
        }
    }
    let above = HEIGHT - high;
    props.block(
        [0.0, 0.0, high + 0.5 * above],
        [THICKNESS, wide, above],
        paint,
    );
}

/// Paintings along a wall, no two alike.
fn hangings(props: &mut Props, [x, y]: [f64; 2], facing: f64, wall: u32) {
    let is_side = x.abs() < HALF_X - 0.1;
    for n in 0..4u32 {
        let id = hash(wall * 101 + n * 7 + 3);
        let along = -1.2 + 0.8 * f64::from(n);
        let (x, y) = if is_side {
            (x + along, y)
        } else {
            (x, y + along)
        };
        let size = [
            0.34 + 0.2 * f64::from(pick(id, 1)),
            0.36 + 0.24 * f64::from(pick(id, 2)),
        ];
        let z = 1.55 + 0.25 * f64::from(pick(id, 3));
        let frame = if pick(id, 4) < 0.5 { oak() } else { walnut() };
        let motif = Paint::Painting(MOTIFS[((n + 2 * wall) % 9) as usize]);
        props.framed([x, y, z], facing, size, frame, motif);
    }
}

/// In the middle of each round.
fn stool(props: &mut Props, x: f64, id: u32) {
    props.at(DVec3::ZERO, 0.0);
    props.tube(
        [x, 0.0, 0.22],
        0.44,
        [0.16, 0.2],
        Paint::Wood(rgb(0x9A_6A3C)),
    );
    props.tube(
        [x, 0.0, 0.46],
        0.05,
        [0.22, 0.22],
        Paint::Rug {
            first: palette(id),
            second: rgb(0xE0_D0A8),
        },
    );
    ornament(props, DVec3::new(x, 0.0, 0.485), id);
}
