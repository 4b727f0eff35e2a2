//! The street: a house front with shops below, walked past sideways.
//!
//! The front lies at y = 0 and looks along -y; the camera walks at y about -6.6. Metres.

use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};

use super::geometry::Shape;
use super::light::Light;
use super::noise::{hash, pick};
use super::room::plant;
use super::scene::{Props, Scene};
use super::textures::{Paint, Picture, hue, palette, rgb};

pub(super) fn scene() -> Scene {
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
        sun: Some((DVec3::new(-0.5, -0.75, 0.72).normalize(), Vec3::new(1.1, 1.0, 0.84) * 0.8)),
        sky: Vec3::new(0.62, 0.72, 0.9) * 0.75,
        bounce: Vec3::splat(0.55),
        reach: 0.5,
        texel: 0.16,
    };
    Scene::new(props, light)
}

fn ground(props: &mut Props) {
    props.flat([0.0, -9.0, 0.0], 1.0, [60.0, 12.0], Paint::Asphalt);
    let slabs = Paint::Bricks { brick: rgb(0x9A_948A), mortar: rgb(0x5A_564E), size: Vec2::new(0.6, 0.4) };
    props.block([0.0, -1.5, 0.06], [60.0, 3.0, 0.12], slabs);
    let kerb = Paint::Bricks { brick: rgb(0xB0_ACA4), mortar: rgb(0x50_4C48), size: Vec2::new(0.9, 0.4) };
    props.block([0.0, -3.06, 0.065], [60.0, 0.14, 0.135], kerb);
    props.flat([-1.0, -4.2, 0.004], 1.0, [24.0, 0.12], Paint::Flat(rgb(0xD8_D6CC)));
    props.tube([1.2, -3.9, 0.004], 0.008, [0.35, 0.35], Paint::Tiles { first: rgb(0x44_4240), second: rgb(0x5A_5650), size: 0.09 });
}

/// Five houses, each with its own material and windows.
fn house_fronts(props: &mut Props) {
    let materials = [
        Paint::Plaster(rgb(0xD8_B078)),
        Paint::Bricks { brick: rgb(0x9C_4E38), mortar: rgb(0xC4_B8A4), size: Vec2::new(0.24, 0.08) },
        Paint::Plaster(rgb(0x9A_B4B8)),
        Paint::Bricks { brick: rgb(0xC0_A070), mortar: rgb(0x8A_8070), size: Vec2::new(0.3, 0.12) },
        Paint::Plaster(rgb(0xC4_8A7A)),
    ];
    let mut left = -14.0;
    for (n, paint) in materials.into_iter().enumerate() {
        let n = n as u32;
        let width = [5.4, 5.0, 6.2, 5.2, 6.0][n as usize];
        let height = [8.6, 9.6, 7.8, 9.2, 8.2][n as usize];
        let setback = [0.0, -0.12, 0.06, -0.2, 0.0][n as usize];
        let middle = left + 0.5 * width;
        props.block([middle, 0.5 + setback, 0.5 * height], [width, 1.0, height], paint);
        let stone = Paint::Terrazzo { ground: rgb(0xC8_C0B0), size: 0.05 };
        props.block([middle, -0.06 + setback, 3.15], [width, 0.16, 0.22], stone);
        props.block([middle, -0.12 + setback, height - 0.15], [width + 0.1, 0.34, 0.3], stone);
        let n_windows = if width > 5.5 { 4 } else { 3 };
        for floor in 0..2u32 {
            for column in 0..n_windows {
                let x = left + width * (f64::from(column) + 0.5) / f64::from(n_windows);
                let z = 4.45 + 2.5 * f64::from(floor);
                window(props.at(DVec3::new(x, setback, z), 0.0), n * 31 + floor * 7 + column);
            }
        }
        props.at(DVec3::ZERO, 0.0);
        props.tube([left + 0.12, -0.1 + setback, 0.5 * height], height, [0.055, 0.055], Paint::Metal(rgb(0x8A_8E90)));
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
        let wood = Paint::Planks { light: palette(id >> 5), dark: palette(id >> 5) * 0.6, size: Vec2::new(2.0, 0.07) };
        for side in [-1.0, 1.0] {
            props.block([side * 0.72, -0.035, 0.0], [0.4, 0.05, tall], wood);
        }
    }
    if pick(id, 3) < 0.55 {
        props.block([0.0, -0.2, -0.5 * tall + 0.07], [0.9, 0.2, 0.16], Paint::Flat(rgb(0x8A_4A32)));
        for n in 0..26u32 {
            let own = hash(id ^ (n + 7));
            let centre = DVec3::new(
                0.9 * f64::from(pick(own, 1)) - 0.45,
                -0.2 - 0.12 * f64::from(pick(own, 2)),
                -0.5 * tall + 0.12 + 0.22 * f64::from(pick(own, 3)),
            );
            let turn = DMat3::from_rotation_z(6.0 * f64::from(pick(own, 4))) * DMat3::from_rotation_x(1.2);
            let petal = if n % 2 == 0 { hue(0.28, 0.6, 0.5) } else { hue(0.9 + 0.2 * pick(id, 5), 0.75, 0.9) };
            let half = DVec2::splat(0.04 + 0.03 * f64::from(pick(own, 6)));
            props.add(Shape::Sheet { half, round: true }, centre, turn, Paint::Leaf(petal));
        }
    }
}

fn shops(props: &mut Props) {
    let names = ["BAKERY", "BOOKS 42", "CAFE LUNA", "BIKES", "FLOWERS", "RECORDS"];
    for (n, name) in names.into_iter().enumerate() {
        let n = n as u32;
        let x = -11.6 + 4.5 * f64::from(n);
        let colour = palette(n * 3 + 1);
        props.at(DVec3::new(x, -0.14, 0.0), 0.0);
        props.block([0.0, 0.0, 2.66], [3.4, 0.14, 0.52], Paint::Flat(colour * 0.7));
        props.sheet([0.0, -0.08, 2.66], -90.0, [3.2, 0.46], Paint::Label {
            ground: colour,
            ink: rgb(0xF4_ECD4),
            text: name,
        });
        props.block([-0.55, 0.05, 1.35], [2.1, 0.1, 2.0], Paint::Pane);
        props.block([-0.55, 0.0, 0.22], [2.2, 0.2, 0.3], Paint::Tiles { first: colour, second: rgb(0xD8_D0C0), size: 0.12 });
        for side in 0..4 {
            let motif = [Picture::Page, Picture::Blocks, Picture::Chart, Picture::Circles][side];
            let at = -1.3 + 0.5 * side as f64;
            props.sheet([at, -0.012, 1.0 + 0.45 * f64::from(pick(n, side as u32))], -90.0, [0.36, 0.48], Paint::Picture(motif));
        }
        props.block([1.15, 0.05, 1.2], [0.95, 0.1, 2.2], Paint::Panelled(palette(n * 5 + 2)));
        props.block([0.0, 0.05, 1.3], [0.12, 0.24, 2.4], Paint::Wood(rgb(0x6A_4A30)));
        let awning = Paint::Fabric { first: palette(n * 7), second: rgb(0xE8_E2D4), width: 0.14 };
        if n % 2 == 0 {
            props.turned_block([-0.3, -0.55, 2.28], [2.9, 1.0, 0.03], DMat3::from_rotation_x(0.35), awning);
        }
        let hanging = Paint::Label { ground: rgb(0xE6_DCC0), ink: rgb(0x30_2418), text: ["TEA", "ART", "OPEN", "24H", "SALE", "NEW"][n as usize] };
        props.at(DVec3::new(x + 1.9, -0.5, 3.6), 24.0);
        props.block([0.0, 0.0, 0.0], [0.62, 0.05, 0.42], hanging);
    }
    props.at(DVec3::ZERO, 0.0);
    for n in 0..9u32 {
        let id = hash(n + 60);
        let motif = [Picture::Page, Picture::Triangles, Picture::Landscape, Picture::Circles, Picture::Map][n as usize % 5];
        let x = -12.0 + 2.9 * f64::from(n);
        props.sheet([x, -0.27, 3.75 + 0.3 * f64::from(pick(id, 1))], -90.0, [0.3, 0.42], Paint::Picture(motif));
    }
}

/// Things between the camera and the houses, so that near and far move differently.
fn street_things(props: &mut Props) {
    props.at(DVec3::ZERO, 0.0);
    let iron = Paint::Metal(rgb(0x3A_4644));
    for x in [-8.0, -1.2, 6.2] {
        props.tube([x, -2.8, 1.9], 3.6, [0.07, 0.05], iron);
        props.tube([x, -2.8, 0.3], 0.4, [0.14, 0.09], iron);
        props.ball([x, -2.8, 3.85], [0.2, 0.2, 0.24], Paint::Tiles { first: rgb(0xE8_E2CC), second: rgb(0xC8_B888), size: 0.08 });
        props.at(DVec3::new(x, -2.8, 0.0), 20.0);
        props.sheet([0.0, -0.08, 1.55], -90.0, [0.3, 0.42], Paint::Picture(Picture::Page));
        props.at(DVec3::ZERO, 0.0);
    }
    for n in 0..12 {
        let x = -9.5 + 1.7 * f64::from(n);
        props.tube([x, -2.95, 0.5], 0.8, [0.06, 0.05], Paint::Tiles { first: rgb(0xB8_3028), second: rgb(0xE8_E4DC), size: 0.1 });
    }
    // Bench, planters, crates of fruit, a newspaper box, a board, a parked van.
    let slats = Paint::Planks { light: rgb(0xA8_7040), dark: rgb(0x70_4626), size: Vec2::new(1.9, 0.08) };
    props.at(DVec3::new(-2.9, -2.2, 0.12), 4.0);
    props.block([0.0, 0.0, 0.44], [1.8, 0.42, 0.05], slats);
    props.turned_block([0.0, 0.24, 0.75], [1.8, 0.04, 0.4], DMat3::from_rotation_x(-0.2), slats);
    for x in [-0.75, 0.75] {
        props.block([x, 0.0, 0.21], [0.07, 0.4, 0.42], iron);
    }
    for (n, x) in [-10.2, -6.9, 0.6, 5.3, 8.6].into_iter().enumerate() {
        plant(props.at(DVec3::new(x, -0.85, 0.12), 0.0), 1.25, 46, 20 + n as u32);
    }
    for n in 0..6u32 {
        let (x, y) = (-11.4 + 0.56 * f64::from(n % 3), -0.75 - 0.4 * f64::from(n / 3));
        props.at(DVec3::new(x, y, 0.12), 3.0 * f64::from(n));
        props.block([0.0, 0.0, 0.3], [0.5, 0.36, 0.6 - 0.2 * f64::from(n / 3)], slats);
        for ball in 0..9u32 {
            let id = hash(n * 17 + ball);
            let centre = [0.16 * f64::from(ball % 3) - 0.16, 0.11 * f64::from(ball / 3) - 0.11, 0.62 - 0.1 * f64::from(n / 3)];
            props.ball(centre, [0.07, 0.06, 0.06], Paint::Fruit(hue(0.35 * pick(id, 1), 0.8, 0.85)));
        }
    }
    props.at(DVec3::new(2.3, -2.3, 0.12), -25.0);
    props.block([0.0, 0.0, 0.55], [0.6, 0.05, 1.0], Paint::Label { ground: rgb(0x1E_2A26), ink: rgb(0xE8_E4D8), text: "SOUP 3" });
    props.at(DVec3::new(7.3, -2.5, 0.12), 8.0);
    props.block([0.0, 0.0, 0.55], [0.55, 0.45, 1.1], Paint::Picture(Picture::Blocks));
}

fn tree(props: &mut Props, seed: u32) {
    props.tube([0.0, 0.0, 1.5], 3.0, [0.17, 0.1], Paint::Bark);
    let grate = Paint::Tiles { first: rgb(0x4A_4038), second: rgb(0x30_2A26), size: 0.11 };
    props.block([0.0, 0.0, 0.125], [1.1, 1.1, 0.012], grate);
    for n in 0..420u32 {
        let id = hash(seed.wrapping_mul(4241).wrapping_add(n));
        let angle = std::f64::consts::TAU * f64::from(pick(id, 1));
        let up = 2.0 * f64::from(pick(id, 2)) - 1.0;
        let out = (1.0 - up * up).sqrt() * (0.5 + 0.5 * f64::from(pick(id, 3)));
        let centre = DVec3::new(1.15 * out * angle.cos(), 1.0 * out * angle.sin(), 3.9 + 1.0 * up);
        let turn = DMat3::from_rotation_z(6.3 * f64::from(pick(id, 4))) * DMat3::from_rotation_x(2.4 * f64::from(pick(id, 5)) - 1.2);
        let half = DVec2::new(0.15, 0.085) * (0.8 + 0.6 * f64::from(pick(id, 6)));
        let green = hue(0.2 + 0.1 * pick(id, 7), 0.65, 0.4 + 0.35 * pick(id, 8));
        props.add(Shape::Sheet { half, round: true }, centre, turn, Paint::Leaf(green));
    }
}
