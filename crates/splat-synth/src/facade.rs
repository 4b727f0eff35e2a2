//! The street: a house front with shops below, walked past sideways.
//!
//! The front lies at y = 0 and looks along -y; the camera walks at y about -7.8. Metres.

use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};

use crate::geometry::Shape;
use crate::light::Light;
use crate::lighting::lit;
use crate::noise::{hash, pick};
use crate::paint::{Painting, hue, palette, rgb};
use crate::props::Props;
use crate::scene::Scene;
use crate::street::{street_things, tree};
use crate::textures::Paint;

pub(crate) fn scene() -> Scene {
    let mut props = Props::new();
    ground(&mut props);
    house_fronts(&mut props);
    shops(&mut props);
    street_things(&mut props);
    for (x, seed) in [(-5.6, 3), (3.4, 5)] {
        tree(props.at(DVec3::new(x, -2.6, 0.0), 0.0), seed);
    }
    let light = Light {
        lamps: Vec::new(),
        sun: Some((
            DVec3::new(-0.5, -0.75, 0.72).normalize(),
            Vec3::new(1.1, 1.0, 0.84) * 0.8,
        )),
        sky: Vec3::new(0.62, 0.72, 0.9) * 0.75,
        bounce: Vec3::splat(0.55),
        reach: 0.5,
        texel: 0.16,
    };
    lit(props, light)
}

fn ground(props: &mut Props) {
    props.flat([0.0, -9.0, 0.0], 1.0, [60.0, 12.0], Paint::Asphalt);
    let slabs = Paint::Bricks {
        brick: rgb(0x9A_948A),
        mortar: rgb(0x5A_564E),
        size: Vec2::new(0.6, 0.4),
    };
    props.block([0.0, -1.5, 0.06], [60.0, 3.0, 0.12], slabs);
    let kerb = Paint::Bricks {
        brick: rgb(0xB0_ACA4),
        mortar: rgb(0x50_4C48),
        size: Vec2::new(0.9, 0.4),
    };
    props.block([0.0, -3.06, 0.065], [60.0, 0.14, 0.135], kerb);
    props.flat(
        [-1.0, -4.2, 0.004],
        1.0,
        [24.0, 0.12],
        Paint::Flat(rgb(0xD8_D6CC)),
    );
    props.tube(
        [1.2, -3.9, 0.004],
        0.008,
        [0.35, 0.35],
        Paint::Tiles {
            first: rgb(0x44_4240),
            second: rgb(0x5A_5650),
            size: 0.09,
        },
    );
}

/// Five houses, each with its own material and windows.
fn house_fronts(props: &mut Props) {
    let materials = [
        Paint::Plaster(rgb(0xD8_B078)),
        Paint::Bricks {
            brick: rgb(0x9C_4E38),
            mortar: rgb(0xC4_B8A4),
            size: Vec2::new(0.24, 0.08),
        },
        Paint::Plaster(rgb(0x9A_B4B8)),
        Paint::Bricks {
            brick: rgb(0xC0_A070),
            mortar: rgb(0x8A_8070),
            size: Vec2::new(0.3, 0.12),
        },
        Paint::Plaster(rgb(0xC4_8A7A)),
    ];
    let mut left = -14.0;
    for (n, paint) in materials.into_iter().enumerate() {
        let n = n as u32;
        let width = [5.4, 5.0, 6.2, 5.2, 6.0][n as usize];
        let height = [8.6, 9.6, 7.8, 9.2, 8.2][n as usize];
        let setback = [0.0, -0.12, 0.06, -0.2, 0.0][n as usize];
        let middle = left + 0.5 * width;
        props.block(
            [middle, 0.5 + setback, 0.5 * height],
            [width, 1.0, height],
            paint,
        );
        let stone = Paint::Terrazzo {
            ground: rgb(0xC8_C0B0),
            size: 0.05,
        };
        props.block([middle, -0.06 + setback, 3.15], [width, 0.16, 0.22], stone);
        props.block(
            [middle, -0.12 + setback, height - 0.15],
            [width + 0.1, 0.34, 0.3],
            stone,
        );
        let n_windows = if width > 5.5 { 4 } else { 3 };
        for floor in 0..2u32 {
            for column in 0..n_windows {
                let x = left + width * (f64::from(column) + 0.5) / f64::from(n_windows);
                let z = 4.45 + 2.5 * f64::from(floor);
                window(
                    props.at(DVec3::new(x, setback, z), 0.0),
                    n * 31 + floor * 7 + column,
                );
            }
        }
        props.at(DVec3::ZERO, 0.0);
        props.tube(
            [left + 0.12, -0.1 + setback, 0.5 * height],
            height,
            [0.055, 0.055],
            Paint::Metal(rgb(0x8A_8E90)),
        );
        left += width;
    }
}

/// Glass in its frame with sill, lintel, shutters or flowers.
fn window(props: &mut Props, id: u32) {
    let id = hash(id);
    let tall = 1.5 + 0.2 * f64::from(pick(id, 1));
    props.block([0.0, 0.0, 0.0], [0.95, 0.06, tall], Paint::Pane);
    let stone = Paint::Flat(rgb(0xD0_C8B8));
    props.block([0.0, -0.06, -0.5 * tall - 0.05], [1.2, 0.22, 0.09], stone);
    props.block([0.0, -0.03, 0.5 * tall + 0.09], [1.15, 0.12, 0.18], stone);
    if pick(id, 2) < 0.6 {
        let wood = Paint::Planks {
            light: palette(id >> 5),
            dark: palette(id >> 5) * 0.6,
            size: Vec2::new(2.0, 0.07),
        };
        for side in [-1.0, 1.0] {
            props.block([side * 0.72, -0.035, 0.0], [0.4, 0.05, tall], wood);
        }
    }
    if pick(id, 3) < 0.55 {
        props.block(
            [0.0, -0.2, -0.5 * tall + 0.07],
            [0.9, 0.2, 0.16],
            Paint::Flat(rgb(0x8A_4A32)),
        );
        for n in 0..26u32 {
            let own = hash(id ^ (n + 7));
            let centre = DVec3::new(
                0.9 * f64::from(pick(own, 1)) - 0.45,
                -0.2 - 0.12 * f64::from(pick(own, 2)),
                -0.5 * tall + 0.12 + 0.22 * f64::from(pick(own, 3)),
            );
            let turn =
                DMat3::from_rotation_z(6.0 * f64::from(pick(own, 4))) * DMat3::from_rotation_x(1.2);
            let petal = if n.is_multiple_of(2) {
                hue(0.28, 0.6, 0.5)
            } else {
                hue(0.9 + 0.2 * pick(id, 5), 0.75, 0.9)
            };
            let half = DVec2::splat(0.04 + 0.03 * f64::from(pick(own, 6)));
            props.add(
                Shape::Sheet { half, round: true },
                centre,
                turn,
                Paint::Leaf(petal),
            );
        }
    }
}

/// Six shops, and posters on the wall above.
fn shops(props: &mut Props) {
    let names = [
        "BAKERY",
        "BOOKS 42",
        "CAFE LUNA",
        "BIKES",
        "FLOWERS",
        "RECORDS",
    ];
    for (n, name) in names.into_iter().enumerate() {
        shop(props, n as u32, name);
    }
    props.at(DVec3::ZERO, 0.0);
    for n in 0..9u32 {
        let id = hash(n + 60);
        let motif = [
            Painting::Page,
            Painting::Triangles,
            Painting::Landscape,
            Painting::Circles,
            Painting::Map,
        ][n as usize % 5];
        let x = -12.0 + 2.9 * f64::from(n);
        props.sheet(
            [x, -0.27, 3.75 + 0.3 * f64::from(pick(id, 1))],
            -90.0,
            [0.3, 0.42],
            Paint::Painting(motif),
        );
    }
}

/// One shop front: sign, glass with posters, door, awning.
fn shop(props: &mut Props, n: u32, name: &'static str) {
    let x = -11.6 + 4.5 * f64::from(n);
    let colour = palette(n * 3 + 1);
    props.at(DVec3::new(x, -0.14, 0.0), 0.0);
    props.block(
        [0.0, 0.0, 2.66],
        [3.4, 0.14, 0.52],
        Paint::Flat(colour * 0.7),
    );
    props.sheet(
        [0.0, -0.08, 2.66],
        -90.0,
        [3.2, 0.46],
        Paint::Label {
            ground: colour,
            ink: rgb(0xF4_ECD4),
            text: name,
        },
    );
    props.block([-0.55, 0.05, 1.35], [2.1, 0.1, 2.0], Paint::Pane);
    props.block(
        [-0.55, 0.0, 0.22],
        [2.2, 0.2, 0.3],
        Paint::Tiles {
            first: colour,
            second: rgb(0xD8_D0C0),
            size: 0.12,
        },
    );
    for side in 0..4 {
        let motif = [
            Painting::Page,
            Painting::Blocks,
            Painting::Chart,
            Painting::Circles,
        ][side];
        let at = -1.3 + 0.5 * side as f64;
        props.sheet(
            [at, -0.012, 1.0 + 0.45 * f64::from(pick(n, side as u32))],
            -90.0,
            [0.36, 0.48],
            Paint::Painting(motif),
        );
    }
    props.block(
        [1.15, 0.05, 1.2],
        [0.95, 0.1, 2.2],
        Paint::Panelled(palette(n * 5 + 2)),
    );
    props.block(
        [0.0, 0.05, 1.3],
        [0.12, 0.24, 2.4],
        Paint::Wood(rgb(0x6A_4A30)),
    );
    let awning = Paint::Fabric {
        first: palette(n * 7),
        second: rgb(0xE8_E2D4),
        width: 0.14,
    };
    if n.is_multiple_of(2) {
        props.turned_block(
            [-0.3, -0.55, 2.28],
            [2.9, 1.0, 0.03],
            DMat3::from_rotation_x(0.35),
            awning,
        );
    }
    let hanging = Paint::Label {
        ground: rgb(0xE6_DCC0),
        ink: rgb(0x30_2418),
        text: ["TEA", "ART", "OPEN", "24H", "SALE", "NEW"][n as usize],
    };
    props.at(DVec3::new(x + 1.9, -0.5, 3.6), 24.0);
    props.block([0.0, 0.0, 0.0], [0.62, 0.05, 0.42], hanging);
}
