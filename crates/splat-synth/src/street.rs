//! What stands on the pavement between the camera and the houses, so that near and far move differently.

use glam::{DMat3, DVec2, DVec3, Vec2};

use crate::clutter::plant;
use crate::geometry::Shape;
use crate::noise::{hash, pick};
use crate::paint::{Painting, hue, rgb};
use crate::props::Props;
use crate::textures::Paint;

/// Things between the camera and the houses, so that near and far move differently.
pub(crate) fn street_things(props: &mut Props) {
    lamps_and_bollards(props);
    bench_and_plants(props);
    market_stall(props);
    boards(props);
}

fn iron() -> Paint {
    Paint::Metal(rgb(0x3A_4644))
}

fn slats() -> Paint {
    Paint::Planks {
        light: rgb(0xA8_7040),
        dark: rgb(0x70_4626),
        size: Vec2::new(1.9, 0.08),
    }
}

fn lamps_and_bollards(props: &mut Props) {
    props.at(DVec3::ZERO, 0.0);
    for x in [-8.0, -1.2, 6.2] {
        props.tube([x, -2.8, 1.9], 3.6, [0.07, 0.05], iron());
        props.tube([x, -2.8, 0.3], 0.4, [0.14, 0.09], iron());
        props.ball(
            [x, -2.8, 3.85],
            [0.2, 0.2, 0.24],
            Paint::Tiles {
                first: rgb(0xE8_E2CC),
                second: rgb(0xC8_B888),
                size: 0.08,
            },
        );
        props.at(DVec3::new(x, -2.8, 0.0), 20.0);
        props.sheet(
            [0.0, -0.08, 1.55],
            -90.0,
            [0.3, 0.42],
            Paint::Painting(Painting::Page),
        );
        props.at(DVec3::ZERO, 0.0);
    }
    for n in 0..12 {
        let x = -9.5 + 1.7 * f64::from(n);
        props.tube(
            [x, -2.95, 0.5],
            0.8,
            [0.06, 0.05],
            Paint::Tiles {
                first: rgb(0xB8_3028),
                second: rgb(0xE8_E4DC),
                size: 0.1,
            },
        );
    }
}

fn bench_and_plants(props: &mut Props) {
    props.at(DVec3::new(-2.9, -2.2, 0.12), 4.0);
    props.block([0.0, 0.0, 0.44], [1.8, 0.42, 0.05], slats());
    props.turned_block(
        [0.0, 0.24, 0.75],
        [1.8, 0.04, 0.4],
        DMat3::from_rotation_x(-0.2),
        slats(),
    );
    for x in [-0.75, 0.75] {
        props.block([x, 0.0, 0.21], [0.07, 0.4, 0.42], iron());
    }
    for (n, x) in [-10.2, -6.9, 0.6, 5.3, 8.6].into_iter().enumerate() {
        plant(
            props.at(DVec3::new(x, -0.85, 0.12), 0.0),
            1.25,
            46,
            20 + n as u32,
        );
    }
}

/// Crates of fruit.
fn market_stall(props: &mut Props) {
    for n in 0..6u32 {
        let (x, y) = (
            -11.4 + 0.56 * f64::from(n % 3),
            -0.75 - 0.4 * f64::from(n / 3),
        );
        props.at(DVec3::new(x, y, 0.12), 3.0 * f64::from(n));
        props.block(
            [0.0, 0.0, 0.3],
            [0.5, 0.36, 0.6 - 0.2 * f64::from(n / 3)],
            slats(),
        );
        for ball in 0..9u32 {
            let id = hash(n * 17 + ball);
            let centre = [
                0.16 * f64::from(ball % 3) - 0.16,
                0.11 * f64::from(ball / 3) - 0.11,
                0.62 - 0.1 * f64::from(n / 3),
            ];
            props.ball(
                centre,
                [0.07, 0.06, 0.06],
                Paint::Fruit(hue(0.35 * pick(id, 1), 0.8, 0.85)),
            );
        }
    }
}

fn boards(props: &mut Props) {
    props.at(DVec3::new(2.3, -2.3, 0.12), -25.0);
    props.block(
        [0.0, 0.0, 0.55],
        [0.6, 0.05, 1.0],
        Paint::Label {
            ground: rgb(0x1E_2A26),
            ink: rgb(0xE8_E4D8),
            text: "SOUP 3",
        },
    );
    props.at(DVec3::new(7.3, -2.5, 0.12), 8.0);
    props.block(
        [0.0, 0.0, 0.55],
        [0.55, 0.45, 1.1],
        Paint::Painting(Painting::Blocks),
    );
}

pub(crate) fn tree(props: &mut Props, seed: u32) {
    props.tube([0.0, 0.0, 1.5], 3.0, [0.17, 0.1], Paint::Bark);
    let grate = Paint::Tiles {
        first: rgb(0x4A_4038),
        second: rgb(0x30_2A26),
        size: 0.11,
    };
    props.block([0.0, 0.0, 0.125], [1.1, 1.1, 0.012], grate);
    for n in 0..420u32 {
        let id = hash(seed.wrapping_mul(4241).wrapping_add(n));
        let angle = std::f64::consts::TAU * f64::from(pick(id, 1));
        let up = 2.0 * f64::from(pick(id, 2)) - 1.0;
        let out = (1.0 - up * up).sqrt() * (0.5 + 0.5 * f64::from(pick(id, 3)));
        let centre = DVec3::new(
            1.15 * out * angle.cos(),
            1.0 * out * angle.sin(),
            3.9 + 1.0 * up,
        );
        let turn = DMat3::from_rotation_z(6.3 * f64::from(pick(id, 4)))
            * DMat3::from_rotation_x(2.4 * f64::from(pick(id, 5)) - 1.2);
        let half = DVec2::new(0.15, 0.085) * (0.8 + 0.6 * f64::from(pick(id, 6)));
        let green = hue(0.2 + 0.1 * pick(id, 7), 0.65, 0.4 + 0.35 * pick(id, 8));
        props.add(
            Shape::Sheet { half, round: true },
            centre,
            turn,
            Paint::Leaf(green),
        );
    }
}
