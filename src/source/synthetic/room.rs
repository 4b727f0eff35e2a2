//! The living room: a table in the middle to walk round, every wall different, small things everywhere.
//!
//! x points east, y north, z up; the camera walks round the table. Metres.

use glam::{DMat3, DVec2, DVec3, Vec3};

use super::geometry::Shape;
use super::light::{Lamp, Light};
use super::noise::{hash, pick};
use super::scene::{Props, Scene};
use super::textures::{Paint, Picture, Rgb, hue, palette, rgb};

const HALF_X: f64 = 3.2;
const HALF_Y: f64 = 2.6;
const HEIGHT: f64 = 2.7;

pub(super) fn scene() -> Scene {
    let mut props = Props::new();
    shell(&mut props);
    table(&mut props);
    table_top(&mut props);
    for (x, y, yaw) in [(-0.4, 0.78, 184.0), (0.38, 0.72, 172.0), (-0.36, -0.74, 8.0), (0.45, -0.86, -21.0)] {
        chair(props.at(DVec3::new(x, y, 0.0), yaw));
    }
    shelf(props.at(DVec3::new(-0.55, HALF_Y - 0.16, 0.0), 0.0));
    north_wall(props.at(DVec3::ZERO, 0.0));
    sofa(props.at(DVec3::new(HALF_X - 0.48, -0.25, 0.0), -90.0));
    east_wall(props.at(DVec3::ZERO, 0.0));
    sideboard(props.at(DVec3::new(-HALF_X + 0.24, 0.35, 0.0), 90.0));
    west_wall(props.at(DVec3::ZERO, 0.0));
    south_wall(props.at(DVec3::ZERO, 0.0));
    plant(props.at(DVec3::new(2.72, 2.1, 0.0), 0.0), 1.55, 70, 3);
    plant(props.at(DVec3::new(-2.75, -1.75, 0.0), 40.0), 1.2, 60, 4);
    plant(props.at(DVec3::new(-2.95, 0.95, 0.86), 10.0), 0.5, 26, 5);
    loose_things(props.at(DVec3::ZERO, 0.0));
    Scene::new(props, light())
}

fn light() -> Light {
    let window = |x: f64| Lamp {
        centre: DVec3::new(x, -HALF_Y + 0.08, 1.55),
        half_u: DVec3::X * 0.6,
        half_v: DVec3::Z * -0.7,
        colour: Vec3::new(0.95, 1.05, 1.25) * 1.9,
    };
    let pendant = Lamp {
        centre: DVec3::new(0.0, 0.0, 1.88),
        half_u: DVec3::X * 0.2,
        half_v: DVec3::Y * -0.2,
        colour: Vec3::new(1.35, 1.05, 0.72) * 3.2,
    };
    let upward = Lamp {
        centre: DVec3::new(2.75, 1.35, 1.78),
        half_u: DVec3::X * 0.16,
        half_v: DVec3::Y * 0.16,
        colour: Vec3::new(1.4, 1.05, 0.68) * 5.0,
    };
    Light {
        lamps: vec![window(-1.4), window(1.3), pendant, upward],
        sun: None,
        sky: Vec3::splat(0.8),
        bounce: Vec3::new(1.02, 1.0, 0.96) * 0.95,
        reach: 0.35,
        texel: 0.06,
    }
}

fn oak() -> Paint {
    Paint::Wood(rgb(0xB5_8850))
}

fn walnut() -> Paint {
    Paint::Wood(rgb(0x7A_5236))
}

fn shell(props: &mut Props) {
    let (x, y, h) = (2.0 * HALF_X, 2.0 * HALF_Y, HEIGHT);
    props.flat([0.0, 0.0, 0.0], 1.0, [x, y], Paint::Parquet { light: rgb(0xC8_9A62), dark: rgb(0x8A_5C36) });
    let boards = Paint::Planks { light: rgb(0xE6_DCC6), dark: rgb(0xC2_B190), size: glam::Vec2::new(1.9, 0.14) };
    props.flat([0.0, 0.0, h], -1.0, [x, y], boards);
    for n in 0..4 {
        props.block([-2.4 + 1.6 * f64::from(n), 0.0, h - 0.08], [0.14, y, 0.16], walnut());
    }
    let north = Paint::Plaster(rgb(0xC9_C2A8));
    let brick = Paint::Bricks { brick: rgb(0xA9_5A42), mortar: rgb(0xB8_AE9E), size: glam::Vec2::new(0.215, 0.072) };
    let paper =
        Paint::Wallpaper { ground: rgb(0xD5_D2BC), first: rgb(0x4E_7350), second: rgb(0xC2_6A58) };
    let south = Paint::Plaster(rgb(0xA8_B9B4));
    for (centre, facing, width, paint) in [
        ([0.0, HALF_Y, 0.5 * h], -90.0, x, north),
        ([HALF_X, 0.0, 0.5 * h], 180.0, y, brick),
        ([-HALF_X, 0.0, 0.5 * h], 0.0, y, paper),
        ([0.0, -HALF_Y, 0.5 * h], 90.0, x, south),
    ] {
        props.sheet(centre, facing, [width, h], paint);
    }
    let skirting = Paint::Flat(rgb(0xE4_DFD2));
    for side in [-1.0, 1.0] {
        props.block([0.0, side * (HALF_Y - 0.01), 0.05], [x, 0.02, 0.1], skirting);
        props.block([side * (HALF_X - 0.01), 0.0, 0.05], [0.02, y, 0.1], skirting);
    }
    let rug = Paint::Rug { first: rgb(0x8A_2A2C), second: rgb(0xD8_C6A0) };
    props.at(DVec3::ZERO, 4.0).block([0.05, 0.0, 0.006], [3.0, 2.2, 0.012], rug);
    props.at(DVec3::ZERO, 0.0);
}

fn table(props: &mut Props) {
    props.at(DVec3::ZERO, 0.0);
    let top = Paint::Planks { light: rgb(0xC0_8A52), dark: rgb(0x86_5630), size: glam::Vec2::new(1.5, 0.15) };
    props.block([0.0, 0.0, 0.725], [1.5, 0.86, 0.04], top);
    props.block([0.0, 0.0, 0.67], [1.3, 0.68, 0.07], walnut());
    for (x, y) in [(-0.66, -0.35), (0.66, -0.35), (-0.66, 0.35), (0.66, 0.35)] {
        props.tube([x, y, 0.355], 0.7, [0.025, 0.04], walnut());
    }
    // Pendant lamp over it.
    props.tube([0.0, 0.0, 2.4], 0.6, [0.008, 0.008], Paint::Flat(rgb(0x22_2222)));
    let shade = Paint::Fabric { first: rgb(0xD8_A24A), second: rgb(0x9C_4A2A), width: 0.05 };
    props.tube([0.0, 0.0, 2.0], 0.24, [0.3, 0.12], shade);
    props.ball([0.0, 0.0, 1.9], [0.06, 0.06, 0.06], Paint::Glow(Vec3::new(1.5, 1.3, 0.95)));
}

fn table_top(props: &mut Props) {
    let z = 0.745;
    let cloth = Paint::Fabric { first: rgb(0xE6_E0D0), second: rgb(0x3A_5E88), width: 0.045 };
    props.at(DVec3::new(0.0, 0.0, z), 12.0).block([0.02, 0.0, 0.002], [0.5, 0.7, 0.004], cloth);
    props.at(DVec3::new(0.05, 0.06, z + 0.004), 0.0);
    props.tube([0.0, 0.0, 0.05], 0.1, [0.08, 0.17], Paint::Terrazzo { ground: rgb(0xDD_DAD0), size: 0.02 });
    for (n, (x, y, up)) in
        [(0.07, 0.03, 0.12), (-0.05, 0.07, 0.12), (-0.03, -0.07, 0.12), (0.02, 0.01, 0.18), (0.06, -0.06, 0.125)]
            .into_iter()
            .enumerate()
    {
        let skin = [rgb(0xC8_3A24), rgb(0x8C_A838), rgb(0xE2_8A22), rgb(0xD8_B834), rgb(0xA8_2430)][n];
        props.ball([x, y, up], [0.042, 0.042, 0.04], Paint::Fruit(skin));
    }
    // Laptop.
    props.at(DVec3::new(-0.48, -0.12, z), 160.0);
    props.block([0.0, 0.0, 0.009], [0.34, 0.24, 0.018], Paint::Metal(rgb(0xA8_ACB0)));
    props.flat([0.0, 0.03, 0.0185], 1.0, [0.3, 0.12], Paint::Tiles {
        first: rgb(0x2A_2C30),
        second: rgb(0x3A_3C42),
        size: 0.019,
    });
    let lid = DMat3::from_rotation_x(-0.3);
    props.turned_block([0.0, 0.15, 0.12], [0.34, 0.012, 0.23], lid, Paint::Metal(rgb(0x98_9CA2)));
    let screen = lid * DMat3::from_rotation_x(std::f64::consts::FRAC_PI_2);
    let sheet = Shape::Sheet { half: DVec2::new(0.155, 0.1), round: false };
    props.add(sheet, DVec3::new(0.0, 0.15, 0.12) + lid * DVec3::new(0.0, -0.007, 0.0), screen, Paint::Picture(Picture::Chart));
    // A vase with flowers, mugs, books, a newspaper, plates.
    props.at(DVec3::new(0.42, 0.2, z), 0.0);
    props.tube([0.0, 0.0, 0.1], 0.2, [0.05, 0.07], Paint::Tiles { first: rgb(0x3E_6A8A), second: rgb(0xE0_DCCC), size: 0.03 });
    bouquet(props, 0.2, 18);
    for (x, y, yaw, colour) in [(-0.2, 0.3, 10.0, 0xC8_5A3A), (0.3, -0.28, 70.0, 0x4A_7A8A), (-0.62, 0.22, 0.0, 0xE0_C060)] {
        props.at(DVec3::new(x, y, z), yaw);
        let glaze = Paint::Fabric { first: rgb(colour), second: rgb(0xEE_E8DA), width: 0.022 };
        props.tube([0.0, 0.0, 0.05], 0.1, [0.036, 0.042], glaze);
        props.block([0.05, 0.0, 0.05], [0.02, 0.012, 0.06], Paint::Flat(rgb(colour)));
    }
    props.at(DVec3::new(0.55, -0.2, z), 24.0);
    for n in 0..4 {
        let turn = DMat3::from_rotation_z(0.35 * f64::from(pick(n, 8)) - 0.15);
        let size = [0.24 - 0.015 * f64::from(n), 0.17 - 0.01 * f64::from(n), 0.03];
        props.turned_block([0.0, 0.0, 0.015 + 0.03 * f64::from(n)], size, turn, Paint::Spine(palette(n * 5 + 1)));
        let cover = Shape::Sheet { half: DVec2::new(0.5 * size[0], 0.5 * size[1]), round: false };
        props.add(cover, DVec3::new(0.0, 0.0, 0.0302 + 0.03 * f64::from(n)), turn, Paint::Picture(Picture::Contours));
    }
    props.at(DVec3::new(0.05, -0.3, z), -8.0).flat([0.0, 0.0, 0.006], 1.0, [0.28, 0.2], Paint::Picture(Picture::Page));
    props.at(DVec3::new(-0.35, 0.3, z), 33.0).flat([0.0, 0.0, 0.004], 1.0, [0.21, 0.3], Paint::Picture(Picture::Map));
}

fn bouquet(props: &mut Props, from_z: f64, n_flowers: u32) {
    for n in 0..n_flowers {
        let id = hash(n + 400);
        let angle = std::f64::consts::TAU * f64::from(pick(id, 1));
        let out = 0.03 + 0.13 * f64::from(pick(id, 2));
        let up = from_z + 0.1 + 0.16 * f64::from(pick(id, 3));
        let tilt = DMat3::from_rotation_z(angle) * DMat3::from_rotation_y(0.9 * f64::from(pick(id, 4)));
        let centre = DVec3::new(out * angle.cos(), out * angle.sin(), up);
        let half = DVec2::splat(0.025 + 0.025 * f64::from(pick(id, 5)));
        let petal = Paint::Leaf(hue(0.9 + 0.25 * pick(id, 6), 0.7, 0.9));
        props.add(Shape::Sheet { half, round: true }, centre, tilt, petal);
        let stem = 0.5 * (from_z + up) - 0.03;
        let green = Paint::Leaf(rgb(0x4A_7A34));
        props.add(Shape::Sheet { half: DVec2::new(0.05, 0.015), round: true }, DVec3::new(0.6 * centre.x, 0.6 * centre.y, stem), tilt, green);
    }
}

fn chair(props: &mut Props) {
    // Seen from the chair the table lies along -y.
    let seat = Paint::Fabric { first: rgb(0x7A_3A34), second: rgb(0xC8_B890), width: 0.04 };
    props.block([0.0, 0.0, 0.46], [0.42, 0.42, 0.05], seat);
    for (x, y) in [(-0.18, -0.18), (0.18, -0.18)] {
        props.tube([x, y, 0.86 - 0.43], 0.86, [0.018, 0.016], oak());
    }
    for (x, y) in [(-0.18, 0.18), (0.18, 0.18)] {
        props.tube([x, y, 0.22], 0.44, [0.016, 0.02], oak());
    }
    for n in 0..3 {
        props.block([0.0, -0.18, 0.6 + 0.12 * f64::from(n)], [0.36, 0.018, 0.07], oak());
    }
}

/// Six boards with books of all sizes and a few other things between them; the front looks along -y.
fn shelf(props: &mut Props) {
    const WIDTH: f64 = 2.5;
    const TALL: f64 = 2.2;
    const DEEP: f64 = 0.3;
    props.block([0.0, 0.14, 0.5 * TALL], [WIDTH, 0.02, TALL], walnut());
    for x in [-0.5 * WIDTH, 0.0, 0.5 * WIDTH] {
        props.block([x, 0.0, 0.5 * TALL], [0.03, DEEP, TALL], walnut());
    }
    for n in 0..7 {
        props.block([0.0, 0.0, 0.08 + 0.35 * f64::from(n)], [WIDTH, DEEP, 0.025], walnut());
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
                let centre = [x + 0.5 * thick + lean * 0.1, -0.13 + 0.5 * deep, base + 0.5 * tall];
                let cloth = hue(pick(id, 5), 0.35 + 0.5 * pick(id, 6), 0.25 + 0.6 * pick(id, 7));
                let turn = DMat3::from_rotation_y(-lean);
                props.turned_block(centre, [thick, deep, tall], turn, Paint::Spine(cloth));
                x += thick + 0.002 + lean * 0.35;
            }
        }
    }
    for (x, size, colour) in [(-0.9, 0.3, 0x8A_6A48), (-0.45, 0.24, 0x5A_7A7A), (0.7, 0.34, 0xA8_5A40)] {
        let weave = Paint::Fabric { first: rgb(colour), second: rgb(0xD8_C8A0), width: 0.03 };
        props.block([x, 0.0, TALL + 0.09], [size, 0.26, 0.16], weave);
    }
}

fn ornament(props: &mut Props, foot: DVec3, id: u32) {
    let colour = palette(id >> 5);
    if pick(id, 1) < 0.5 {
        props.ball([foot.x, foot.y, foot.z + 0.06], [0.06, 0.06, 0.06], Paint::Terrazzo { ground: colour, size: 0.015 });
    } else {
        let glaze = Paint::Tiles { first: colour, second: palette(id >> 9), size: 0.02 };
        props.tube([foot.x, foot.y, foot.z + 0.09], 0.18, [0.055, 0.03], glaze);
    }
}

fn north_wall(props: &mut Props) {
    let y = HALF_Y;
    let oak = oak();
    props.framed([1.25, y, 1.75], -90.0, [0.5, 0.7], oak, Paint::Picture(Picture::Triangles));
    props.framed([1.95, y, 1.9], -90.0, [0.6, 0.42], walnut(), Paint::Picture(Picture::Landscape));
    props.framed([1.95, y, 1.3], -90.0, [0.45, 0.6], oak, Paint::Picture(Picture::Circles));
    props.framed([1.25, y, 1.08], -90.0, [0.36, 0.36], walnut(), Paint::Picture(Picture::Glass));
    let text = Paint::Label { ground: rgb(0x22_3A4A), ink: rgb(0xF0_E6C8), text: "SPLAT MAPPER" };
    props.sheet([1.6, y - 0.01, 2.32], -90.0, [1.1, 0.2], text);
    props.framed([-2.5, y, 1.75], -90.0, [0.55, 0.8], oak, Paint::Picture(Picture::Map));
    props.framed([-2.5, y, 0.85], -90.0, [0.4, 0.5], walnut(), Paint::Picture(Picture::Page));
    // A low desk with drawers under the pictures.
    let chest = Paint::Drawers { wood: rgb(0x9A_7048), rows: 3, columns: 2 };
    props.block([1.6, y - 0.22, 0.4], [1.1, 0.42, 0.8], chest);
    for n in 0..5u32 {
        let id = hash(n + 77);
        ornament(props, DVec3::new(1.2 + 0.2 * f64::from(n), y - 0.2 - 0.1 * f64::from(pick(id, 2)), 0.8), id);
    }
}

/// Faces along -y of its own frame.
fn sofa(props: &mut Props) {
    let cloth = Paint::Fabric { first: rgb(0x3E_5A6A), second: rgb(0x86_A0A0), width: 0.06 };
    props.block([0.0, 0.0, 0.22], [2.1, 0.86, 0.3], cloth);
    props.block([0.0, 0.36, 0.55], [2.1, 0.2, 0.6], cloth);
    for x in [-0.98, 0.98] {
        props.block([x, -0.03, 0.4], [0.2, 0.84, 0.5], cloth);
    }
    for x in [-0.45, 0.45] {
        props.block([x, -0.08, 0.42], [0.86, 0.64, 0.14], cloth);
    }
    for (n, x) in [(0u32, -0.68), (1, -0.3), (2, 0.35), (3, 0.72)] {
        let turn = DMat3::from_rotation_z(0.3 * f64::from(pick(n, 3)) - 0.15) * DMat3::from_rotation_x(0.35);
        let cover = match n {
            0 => Paint::Rug { first: rgb(0xB8_4A30), second: rgb(0xE8_D8B0) },
            1 => Paint::Wallpaper { ground: rgb(0xE8_DCC0), first: rgb(0x3A_6A5A), second: rgb(0xD0_8A30) },
            2 => Paint::Fabric { first: rgb(0xD8_B048), second: rgb(0x4A_3A5A), width: 0.05 },
            _ => Paint::Picture(Picture::Triangles),
        };
        props.turned_block([x, 0.16, 0.68], [0.42, 0.13, 0.4], turn, cover);
    }
    props.block([0.5, -0.1, 0.495], [0.6, 0.66, 0.015], Paint::Rug { first: rgb(0x2E_5A6E), second: rgb(0xE4_D2A8) });
    for (x, y) in [(-0.95, -0.35), (0.95, -0.35), (-0.95, 0.35), (0.95, 0.35)] {
        props.tube([x, y, 0.04], 0.08, [0.02, 0.03], walnut());
    }
}

fn east_wall(props: &mut Props) {
    let x = HALF_X;
    for (y, z, size, frame, motif) in [
        (-0.95, 1.72, [0.72, 0.9], walnut(), Picture::Blocks),
        (0.0, 1.75, [0.8, 0.6], oak(), Picture::Contours),
        (0.85, 1.7, [0.55, 0.8], walnut(), Picture::Circles),
        (-1.85, 1.6, [0.5, 0.7], oak(), Picture::Page),
        (0.0, 1.22, [0.6, 0.25], walnut(), Picture::Landscape),
    ] {
        props.framed([x, y, z], 180.0, size, frame, Paint::Picture(motif));
    }
    // Floor lamp.
    let steel = Paint::Metal(rgb(0x50_4A44));
    props.tube([2.75, 1.35, 0.015], 0.03, [0.16, 0.14], steel);
    props.tube([2.75, 1.35, 0.85], 1.66, [0.014, 0.012], steel);
    let shade = Paint::Wallpaper { ground: rgb(0xF0_E2BC), first: rgb(0xA8_6A38), second: rgb(0xC8_4838) };
    props.tube([2.75, 1.35, 1.66], 0.28, [0.2, 0.15], shade);
    // Crate with magazines as a side table.
    let crate_wood = Paint::Planks { light: rgb(0xC8_A878), dark: rgb(0x96_7448), size: glam::Vec2::new(0.5, 0.09) };
    props.at(DVec3::new(2.7, -1.75, 0.0), 14.0);
    props.block([0.0, 0.0, 0.24], [0.44, 0.44, 0.48], crate_wood);
    props.flat([0.02, 0.0, 0.482], 1.0, [0.21, 0.29], Paint::Picture(Picture::Page));
    props.tube([-0.12, 0.12, 0.56], 0.16, [0.05, 0.035], Paint::Terrazzo { ground: rgb(0x38_4858), size: 0.02 });
    props.at(DVec3::ZERO, 0.0);
}

fn sideboard(props: &mut Props) {
    let chest = Paint::Drawers { wood: rgb(0xB0_7C4A), rows: 2, columns: 4 };
    props.block([0.0, 0.0, 0.46], [2.1, 0.44, 0.72], chest);
    props.block([0.0, 0.0, 0.84], [2.16, 0.48, 0.035], oak());
    for x in [-0.95, 0.95] {
        props.block([x, 0.0, 0.05], [0.06, 0.36, 0.1], walnut());
    }
    // Radio, records, candles, more books.
    let front = Paint::Fabric { first: rgb(0x5A_4632), second: rgb(0xC0_A878), width: 0.02 };
    props.block([-0.55, -0.02, 0.98], [0.42, 0.2, 0.25], walnut());
    props.sheet([-0.6, -0.125, 0.98], -90.0, [0.24, 0.19], front);
    props.sheet([-0.41, -0.125, 0.98], -90.0, [0.09, 0.09], Paint::Picture(Picture::Clock));
    for n in 0..12u32 {
        let id = hash(n + 900);
        let tall = 0.2 + 0.1 * f64::from(pick(id, 1));
        let centre = [-0.2 + 0.042 * f64::from(n), 0.03, 0.857 + 0.5 * tall];
        props.block(centre, [0.038, 0.18, tall], Paint::Spine(hue(pick(id, 2), 0.6, 0.3 + 0.5 * pick(id, 3))));
    }
    for (x, tall) in [(0.45, 0.22), (0.53, 0.15), (0.6, 0.28)] {
        props.tube([x, -0.08, 0.857 + 0.5 * tall], tall, [0.028, 0.026], Paint::Fruit(rgb(0xE6_D8B8)));
    }
}

fn west_wall(props: &mut Props) {
    let x = -HALF_X;
    let motifs = [Picture::Landscape, Picture::Blocks, Picture::Glass, Picture::Triangles, Picture::Page, Picture::Contours];
    for (n, motif) in motifs.into_iter().enumerate() {
        let (column, row) = ((n % 3) as f64, (n / 3) as f64);
        let size = [0.36 + 0.06 * column, 0.38 + 0.04 * row];
        let frame = if n % 2 == 0 { walnut() } else { Paint::Flat(rgb(0x22_2020)) };
        props.framed([x, -0.35 + 0.62 * column, 1.95 - 0.58 * row], 0.0, size, frame, Paint::Picture(motif));
    }
    props.framed([x, -1.35, 1.85], 0.0, [0.5, 0.5], oak(), Paint::Picture(Picture::Clock));
    props.framed([x, 2.1, 1.6], 0.0, [0.6, 0.85], oak(), Paint::Picture(Picture::Circles));
    props.framed([x, -1.95, 1.25], 0.0, [0.4, 0.55], walnut(), Paint::Picture(Picture::Map));
}

fn south_wall(props: &mut Props) {
    let y = -HALF_Y;
    for (centre_x, colours) in [(-1.4, [0xB8_5038, 0xE8_C890]), (1.3, [0x3E_6A78, 0xD8_D0B0])] {
        props.sheet([centre_x, y + 0.02, 1.55], 90.0, [1.2, 1.4], Paint::View);
        let white = Paint::Flat(rgb(0xE8_E4D8));
        for x in [-0.62, 0.0, 0.62] {
            props.block([centre_x + x, y + 0.04, 1.55], [0.05, 0.06, 1.46], white);
        }
        for z in [0.85, 1.75, 2.27] {
            props.block([centre_x, y + 0.04, z], [1.28, 0.06, 0.05], white);
        }
        props.block([centre_x, y + 0.12, 0.82], [1.4, 0.24, 0.03], white);
        let cloth = Paint::Fabric { first: rgb(colours[0]), second: rgb(colours[1]), width: 0.07 };
        for n in 0..5 {
            let fold = 0.02 * f64::from(n % 2);
            for side in [-1.0, 1.0] {
                let x = centre_x + side * (0.62 + 0.07 * f64::from(n));
                props.tube([x, y + 0.11 + fold, 1.3], 2.2, [0.05, 0.045], cloth);
            }
        }
        props.tube([centre_x, y + 0.12, 2.42], 0.04, [0.02, 0.02], walnut());
        let ribs = Paint::Tiles { first: rgb(0xDC_D8CC), second: rgb(0xC8_C2B4), size: 0.08 };
        props.block([centre_x, y + 0.07, 0.42], [1.1, 0.1, 0.55], ribs);
    }
    props.block([-0.05, y + 0.02, 1.02], [0.86, 0.05, 2.04], Paint::Panelled(rgb(0x6E_8A6A)));
    for side in [-1.0, 1.0] {
        props.block([-0.05 + 0.47 * side, y + 0.02, 1.05], [0.08, 0.07, 2.1], oak());
    }
    props.framed([2.7, y, 1.6], 90.0, [0.5, 0.7], walnut(), Paint::Picture(Picture::Blocks));
}

/// A pot with leaves on all sides; `tall` over all.
pub(super) fn plant(props: &mut Props, tall: f64, n_leaves: u32, seed: u32) {
    let pot = 0.22 * tall;
    let glaze = Paint::Terrazzo { ground: hue(0.04 + 0.1 * pick(seed, 1), 0.45, 0.7), size: 0.03 };
    props.tube([0.0, 0.0, 0.5 * pot], pot, [0.5 * pot, 0.7 * pot], glaze);
    props.tube([0.0, 0.0, 0.45 * tall], 0.5 * tall, [0.02, 0.012], Paint::Bark);
    for n in 0..n_leaves {
        let id = hash(seed.wrapping_mul(7919).wrapping_add(n));
        let share = f64::from(n) / f64::from(n_leaves);
        let angle = 2.4 * f64::from(n) + 0.5 * f64::from(pick(id, 1));
        let long = tall * (0.1 + 0.07 * f64::from(pick(id, 2)));
        let rise = 0.9 - 1.1 * f64::from(pick(id, 3));
        let roll = 1.2 * f64::from(pick(id, 4)) - 0.6;
        let turn = DMat3::from_rotation_z(angle) * DMat3::from_rotation_y(-rise) * DMat3::from_rotation_x(roll);
        let foot = DVec3::new(0.0, 0.0, tall * (0.3 + 0.5 * share));
        let centre = foot + turn * DVec3::new(long * 1.25, 0.0, 0.0);
        let green: Rgb = hue(0.2 + 0.14 * pick(id, 5), 0.6, 0.35 + 0.35 * pick(id, 6));
        props.add(Shape::Sheet { half: DVec2::new(long, 0.34 * long), round: true }, centre, turn, Paint::Leaf(green));
    }
}

fn loose_things(props: &mut Props) {
    // A basket of balls of wool, a stool, a box of toys on the floor.
    let basket = Paint::Fabric { first: rgb(0xB8_8E52), second: rgb(0x6A_4A28), width: 0.035 };
    props.tube([-1.95, 1.85, 0.15], 0.3, [0.16, 0.22], basket);
    for (n, (x, y)) in [(-2.02, 1.9), (-1.88, 1.85), (-1.97, 1.76)].into_iter().enumerate() {
        let wool = Paint::Fabric { first: palette(n as u32 * 3), second: palette(n as u32 + 9), width: 0.02 };
        props.ball([x, y, 0.33], [0.085, 0.085, 0.085], wool);
    }
    props.tube([2.45, 0.95, 0.21], 0.42, [0.17, 0.15], Paint::Tiles { first: rgb(0x88_4A3A), second: rgb(0xD8_C8A8), size: 0.07 });
    for n in 0..9u32 {
        let id = hash(n + 5000);
        let (x, y) = (-1.9 + 0.7 * f64::from(pick(id, 1)), -1.75 + 0.5 * f64::from(pick(id, 2)));
        let turn = DMat3::from_rotation_z(6.0 * f64::from(pick(id, 3)));
        props.turned_block([x, y, 0.04], [0.08; 3], turn, Paint::Picture(Picture::Blocks));
    }
}
