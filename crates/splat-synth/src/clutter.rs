//! Small things that stand and lie about: on the table, on shelves, on the floor. They give near and far detail.

use glam::{DMat3, DVec2, DVec3};

use crate::geometry::Shape;
use crate::noise::{hash, pick};
use crate::paint::{Painting, Rgb, hue, palette, rgb};
use crate::props::Props;
use crate::textures::Paint;

/// Everything on the table.
pub(crate) fn table_top(props: &mut Props) {
    fruit_bowl(props);
    laptop(props);
    crockery(props);
    papers(props);
}

/// Top of the table over the floor.
const TABLE_Z: f64 = 0.745;

fn fruit_bowl(props: &mut Props) {
    let cloth = Paint::Fabric {
        first: rgb(0xE6_E0D0),
        second: rgb(0x3A_5E88),
        width: 0.045,
    };
    props.at(DVec3::new(0.0, 0.0, TABLE_Z), 12.0).block(
        [0.02, 0.0, 0.002],
        [0.5, 0.7, 0.004],
        cloth,
    );
    props.at(DVec3::new(0.05, 0.06, TABLE_Z + 0.004), 0.0);
    props.tube(
        [0.0, 0.0, 0.05],
        0.1,
        [0.08, 0.17],
        Paint::Terrazzo {
            ground: rgb(0xDD_DAD0),
            size: 0.02,
        },
    );
    for (n, (x, y, up)) in [
        (0.07, 0.03, 0.12),
        (-0.05, 0.07, 0.12),
        (-0.03, -0.07, 0.12),
        (0.02, 0.01, 0.18),
        (0.06, -0.06, 0.125),
    ]
    .into_iter()
    .enumerate()
    {
        let skin = [
            rgb(0xC8_3A24),
            rgb(0x8C_A838),
            rgb(0xE2_8A22),
            rgb(0xD8_B834),
            rgb(0xA8_2430),
        ][n];
        props.ball([x, y, up], [0.042, 0.042, 0.04], Paint::Fruit(skin));
    }
}

fn laptop(props: &mut Props) {
    props.at(DVec3::new(-0.48, -0.12, TABLE_Z), 160.0);
    props.block(
        [0.0, 0.0, 0.009],
        [0.34, 0.24, 0.018],
        Paint::Metal(rgb(0xA8_ACB0)),
    );
    props.flat(
        [0.0, 0.03, 0.0185],
        1.0,
        [0.3, 0.12],
        Paint::Tiles {
            first: rgb(0x2A_2C30),
            second: rgb(0x3A_3C42),
            size: 0.019,
        },
    );
    let lid = DMat3::from_rotation_x(-0.3);
    props.turned_block(
        [0.0, 0.15, 0.12],
        [0.34, 0.012, 0.23],
        lid,
        Paint::Metal(rgb(0x98_9CA2)),
    );
    let screen = lid * DMat3::from_rotation_x(std::f64::consts::FRAC_PI_2);
    let sheet = Shape::Sheet {
        half: DVec2::new(0.155, 0.1),
        round: false,
    };
    props.add(
        sheet,
        DVec3::new(0.0, 0.15, 0.12) + lid * DVec3::new(0.0, -0.007, 0.0),
        screen,
        Paint::Painting(Painting::Chart),
    );
}

/// A vase with flowers, and mugs.
fn crockery(props: &mut Props) {
    props.at(DVec3::new(0.42, 0.2, TABLE_Z), 0.0);
    props.tube(
        [0.0, 0.0, 0.1],
        0.2,
        [0.05, 0.07],
        Paint::Tiles {
            first: rgb(0x3E_6A8A),
            second: rgb(0xE0_DCCC),
            size: 0.03,
        },
    );
    bouquet(props, 0.2, 18);
    for (x, y, yaw, colour) in [
        (-0.2, 0.3, 10.0, 0xC8_5A3A),
        (0.3, -0.28, 70.0, 0x4A_7A8A),
        (-0.62, 0.22, 0.0, 0xE0_C060),
    ] {
        props.at(DVec3::new(x, y, TABLE_Z), yaw);
        let glaze = Paint::Fabric {
            first: rgb(colour),
            second: rgb(0xEE_E8DA),
            width: 0.022,
        };
        props.tube([0.0, 0.0, 0.05], 0.1, [0.036, 0.042], glaze);
        props.block(
            [0.05, 0.0, 0.05],
            [0.02, 0.012, 0.06],
            Paint::Flat(rgb(colour)),
        );
    }
}

/// Books, a newspaper, a map.
fn papers(props: &mut Props) {
    props.at(DVec3::new(0.55, -0.2, TABLE_Z), 24.0);
    for n in 0..4 {
        let turn = DMat3::from_rotation_z(0.35 * f64::from(pick(n, 8)) - 0.15);
        let size = [
            0.24 - 0.015 * f64::from(n),
            0.17 - 0.01 * f64::from(n),
            0.03,
        ];
        props.turned_block(
            [0.0, 0.0, 0.015 + 0.03 * f64::from(n)],
            size,
            turn,
            Paint::Spine(palette(n * 5 + 1)),
        );
        let cover = Shape::Sheet {
            half: DVec2::new(0.5 * size[0], 0.5 * size[1]),
            round: false,
        };
        props.add(
            cover,
            DVec3::new(0.0, 0.0, 0.0302 + 0.03 * f64::from(n)),
            turn,
            Paint::Painting(Painting::Contours),
        );
    }
    props.at(DVec3::new(0.05, -0.3, TABLE_Z), -8.0).flat(
        [0.0, 0.0, 0.006],
        1.0,
        [0.28, 0.2],
        Paint::Painting(Painting::Page),
    );
    props.at(DVec3::new(-0.35, 0.3, TABLE_Z), 33.0).flat(
        [0.0, 0.0, 0.004],
        1.0,
        [0.21, 0.3],
        Paint::Painting(Painting::Map),
    );
}

fn bouquet(props: &mut Props, from_z: f64, n_flowers: u32) {
    for n in 0..n_flowers {
        let id = hash(n + 400);
        let angle = std::f64::consts::TAU * f64::from(pick(id, 1));
        let out = 0.03 + 0.13 * f64::from(pick(id, 2));
        let up = from_z + 0.1 + 0.16 * f64::from(pick(id, 3));
        let tilt =
            DMat3::from_rotation_z(angle) * DMat3::from_rotation_y(0.9 * f64::from(pick(id, 4)));
        let centre = DVec3::new(out * angle.cos(), out * angle.sin(), up);
        let half = DVec2::splat(0.025 + 0.025 * f64::from(pick(id, 5)));
        let petal = Paint::Leaf(hue(0.9 + 0.25 * pick(id, 6), 0.7, 0.9));
        props.add(Shape::Sheet { half, round: true }, centre, tilt, petal);
        let stem = 0.5 * (from_z + up) - 0.03;
        let green = Paint::Leaf(rgb(0x4A_7A34));
        props.add(
            Shape::Sheet {
                half: DVec2::new(0.05, 0.015),
                round: true,
            },
            DVec3::new(0.6 * centre.x, 0.6 * centre.y, stem),
            tilt,
            green,
        );
    }
}

pub(crate) fn ornament(props: &mut Props, foot: DVec3, id: u32) {
    let colour = palette(id >> 5);
    if pick(id, 1) < 0.5 {
        props.ball(
            [foot.x, foot.y, foot.z + 0.06],
            [0.06, 0.06, 0.06],
            Paint::Terrazzo {
                ground: colour,
                size: 0.015,
            },
        );
    } else {
        let glaze = Paint::Tiles {
            first: colour,
            second: palette(id >> 9),
            size: 0.02,
        };
        props.tube([foot.x, foot.y, foot.z + 0.09], 0.18, [0.055, 0.03], glaze);
    }
}

/// A pot with leaves on all sides; `tall` over all.
pub(crate) fn plant(props: &mut Props, tall: f64, n_leaves: u32, seed: u32) {
    let pot = 0.22 * tall;
    let glaze = Paint::Terrazzo {
        ground: hue(0.04 + 0.1 * pick(seed, 1), 0.45, 0.7),
        size: 0.03,
    };
    props.tube([0.0, 0.0, 0.5 * pot], pot, [0.5 * pot, 0.7 * pot], glaze);
    props.tube(
        [0.0, 0.0, 0.45 * tall],
        0.5 * tall,
        [0.02, 0.012],
        Paint::Bark,
    );
    for n in 0..n_leaves {
        let id = hash(seed.wrapping_mul(7919).wrapping_add(n));
        let share = f64::from(n) / f64::from(n_leaves);
        let angle = 2.4 * f64::from(n) + 0.5 * f64::from(pick(id, 1));
        let long = tall * (0.1 + 0.07 * f64::from(pick(id, 2)));
        let rise = 0.9 - 1.1 * f64::from(pick(id, 3));
        let roll = 1.2 * f64::from(pick(id, 4)) - 0.6;
        let turn = DMat3::from_rotation_z(angle)
            * DMat3::from_rotation_y(-rise)
            * DMat3::from_rotation_x(roll);
        let foot = DVec3::new(0.0, 0.0, tall * (0.3 + 0.5 * share));
        let centre = foot + turn * DVec3::new(long * 1.25, 0.0, 0.0);
        let green: Rgb = hue(0.2 + 0.14 * pick(id, 5), 0.6, 0.35 + 0.35 * pick(id, 6));
        props.add(
            Shape::Sheet {
                half: DVec2::new(long, 0.34 * long),
                round: true,
            },
            centre,
            turn,
            Paint::Leaf(green),
        );
    }
}

pub(crate) fn loose_things(props: &mut Props) {
    // A basket of balls of wool, a stool, a box of toys on the floor.
    let basket = Paint::Fabric {
        first: rgb(0xB8_8E52),
        second: rgb(0x6A_4A28),
        width: 0.035,
    };
    props.tube([-1.95, 1.85, 0.15], 0.3, [0.16, 0.22], basket);
    for (n, (x, y)) in [(-2.02, 1.9), (-1.88, 1.85), (-1.97, 1.76)]
        .into_iter()
        .enumerate()
    {
        let wool = Paint::Fabric {
            first: palette(n as u32 * 3),
            second: palette(n as u32 + 9),
            width: 0.02,
        };
        props.ball([x, y, 0.33], [0.085, 0.085, 0.085], wool);
    }
    props.tube(
        [2.45, 0.95, 0.21],
        0.42,
        [0.17, 0.15],
        Paint::Tiles {
            first: rgb(0x88_4A3A),
            second: rgb(0xD8_C8A8),
            size: 0.07,
        },
    );
    for n in 0..9u32 {
        let id = hash(n + 5000);
        let (x, y) = (
            -1.9 + 0.7 * f64::from(pick(id, 1)),
            -1.75 + 0.5 * f64::from(pick(id, 2)),
        );
        let turn = DMat3::from_rotation_z(6.0 * f64::from(pick(id, 3)));
        props.turned_block(
            [x, y, 0.04],
            [0.08; 3],
            turn,
            Paint::Painting(Painting::Blocks),
        );
    }
}
