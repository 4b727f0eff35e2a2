//! The living room: a table in the middle to walk round, every wall different, small things everywhere.
//!
//! x points east, y north, z up; the camera walks round the table. Metres.

use glam::{DVec3, Vec2, Vec3};

use crate::clutter::{loose_things, ornament, plant, table_top};
use crate::furniture::{chair, oak, shelf, sideboard, sofa, table, walnut};
use crate::light::{Lamp, Light};
use crate::lighting::lit;
use crate::noise::{hash, pick};
use crate::paint::{Painting, rgb};
use crate::props::Props;
use crate::scene::Scene;
use crate::textures::Paint;

const HALF_X: f64 = 3.2;

const HALF_Y: f64 = 2.6;

const HEIGHT: f64 = 2.7;

pub(crate) fn scene() -> Scene {
    let mut props = Props::new();
    shell(&mut props);
    table(&mut props);
    table_top(&mut props);
    for (x, y, yaw) in [
        (-0.4, 0.78, 184.0),
        (0.38, 0.72, 172.0),
        (-0.36, -0.74, 8.0),
        (0.45, -0.86, -21.0),
    ] {
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
    lit(props, light())
}

fn light() -> Light {
    let window = |x: f64| Lamp {
        centre: DVec3::new(x, -HALF_Y + 0.08, 1.55),
        half_u: DVec3::X * 0.6,
        half_v: DVec3::Z * -0.7,
        colour: Vec3::new(0.95, 1.05, 1.25) * 4.2,
    };
    let pendant = Lamp {
        centre: DVec3::new(0.0, 0.0, 1.88),
        half_u: DVec3::X * 0.2,
        half_v: DVec3::Y * -0.2,
        colour: Vec3::new(1.35, 1.05, 0.72) * 5.6,
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
        bounce: Vec3::new(1.02, 1.0, 0.96) * 0.78,
        reach: 0.6,
        texel: 0.06,
    }
}

fn shell(props: &mut Props) {
    let (x, y, h) = (2.0 * HALF_X, 2.0 * HALF_Y, HEIGHT);
    props.flat(
        [0.0, 0.0, 0.0],
        1.0,
        [x, y],
        Paint::Parquet {
            light: rgb(0xC8_9A62),
            dark: rgb(0x8A_5C36),
        },
    );
    let boards = Paint::Planks {
        light: rgb(0xE6_DCC6),
        dark: rgb(0xC2_B190),
        size: Vec2::new(1.9, 0.14),
    };
    props.flat([0.0, 0.0, h], -1.0, [x, y], boards);
    for n in 0..4 {
        props.block(
            [-2.4 + 1.6 * f64::from(n), 0.0, h - 0.08],
            [0.14, y, 0.16],
            walnut(),
        );
    }
    let north = Paint::Plaster(rgb(0xC9_C2A8));
    let brick = Paint::Bricks {
        brick: rgb(0xA9_5A42),
        mortar: rgb(0xB8_AE9E),
        size: Vec2::new(0.215, 0.072),
    };
    let paper = Paint::Wallpaper {
        ground: rgb(0xD5_D2BC),
        first: rgb(0x4E_7350),
        second: rgb(0xC2_6A58),
    };
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
        props.block(
            [0.0, side * (HALF_Y - 0.01), 0.05],
            [x, 0.02, 0.1],
            skirting,
        );
        props.block(
            [side * (HALF_X - 0.01), 0.0, 0.05],
            [0.02, y, 0.1],
            skirting,
        );
    }
    let rug = Paint::Rug {
        first: rgb(0x8A_2A2C),
        second: rgb(0xD8_C6A0),
    };
    props
        .at(DVec3::ZERO, 4.0)
        .block([0.05, 0.0, 0.006], [3.0, 2.2, 0.012], rug);
    props.at(DVec3::ZERO, 0.0);
}

fn north_wall(props: &mut Props) {
    let y = HALF_Y;
    let oak = oak();
    props.framed(
        [1.25, y, 1.75],
        -90.0,
        [0.5, 0.7],
        oak,
        Paint::Painting(Painting::Triangles),
    );
    props.framed(
        [1.95, y, 1.9],
        -90.0,
        [0.6, 0.42],
        walnut(),
        Paint::Painting(Painting::Landscape),
    );
    props.framed(
        [1.95, y, 1.3],
        -90.0,
        [0.45, 0.6],
        oak,
        Paint::Painting(Painting::Circles),
    );
    props.framed(
        [1.25, y, 1.08],
        -90.0,
        [0.36, 0.36],
        walnut(),
        Paint::Painting(Painting::Glass),
    );
    let text = Paint::Label {
        ground: rgb(0x22_3A4A),
        ink: rgb(0xF0_E6C8),
        text: "SPLAT MAPPER",
    };
    props.sheet([1.6, y - 0.01, 2.32], -90.0, [1.1, 0.2], text);
    props.framed(
        [-2.5, y, 1.75],
        -90.0,
        [0.55, 0.8],
        oak,
        Paint::Painting(Painting::Map),
    );
    props.framed(
        [-2.5, y, 0.85],
        -90.0,
        [0.4, 0.5],
        walnut(),
        Paint::Painting(Painting::Page),
    );
    // A low service server with drawers under the paintings.
    let chest = Paint::Drawers {
        wood: rgb(0x9A_7048),
        rows: 3,
        columns: 2,
    };
    props.block([1.6, y - 0.22, 0.4], [1.1, 0.42, 0.8], chest);
    for n in 0..5u32 {
        let id = hash(n + 77);
        ornament(
            props,
            DVec3::new(
                1.2 + 0.2 * f64::from(n),
                y - 0.2 - 0.1 * f64::from(pick(id, 2)),
                0.8,
            ),
            id,
        );
    }
}

fn east_wall(props: &mut Props) {
    let x = HALF_X;
    for (y, z, size, frame, motif) in [
        (-0.95, 1.72, [0.72, 0.9], walnut(), Painting::Blocks),
        (0.0, 1.75, [0.8, 0.6], oak(), Painting::Contours),
        (0.85, 1.7, [0.55, 0.8], walnut(), Painting::Circles),
        (-1.85, 1.6, [0.5, 0.7], oak(), Painting::Page),
        (0.0, 1.22, [0.6, 0.25], walnut(), Painting::Landscape),
    ] {
        props.framed([x, y, z], 180.0, size, frame, Paint::Painting(motif));
    }
    // Floor lamp.
    let steel = Paint::Metal(rgb(0x50_4A44));
    props.tube([2.75, 1.35, 0.015], 0.03, [0.16, 0.14], steel);
    props.tube([2.75, 1.35, 0.85], 1.66, [0.014, 0.012], steel);
    let shade = Paint::Wallpaper {
        ground: rgb(0xF0_E2BC),
        first: rgb(0xA8_6A38),
        second: rgb(0xC8_4838),
    };
    props.tube([2.75, 1.35, 1.66], 0.28, [0.2, 0.15], shade);
    // Crate with magazines as a side table.
    let crate_wood = Paint::Planks {
        light: rgb(0xC8_A878),
        dark: rgb(0x96_7448),
        size: Vec2::new(0.5, 0.09),
    };
    props.at(DVec3::new(2.7, -1.75, 0.0), 14.0);
    props.block([0.0, 0.0, 0.24], [0.44, 0.44, 0.48], crate_wood);
    props.flat(
        [0.02, 0.0, 0.482],
        1.0,
        [0.21, 0.29],
        Paint::Painting(Painting::Page),
    );
    props.tube(
        [-0.12, 0.12, 0.56],
        0.16,
        [0.05, 0.035],
        Paint::Terrazzo {
            ground: rgb(0x38_4858),
            size: 0.02,
        },
    );
    props.at(DVec3::ZERO, 0.0);
}

fn west_wall(props: &mut Props) {
    let x = -HALF_X;
    let motifs = [
        Painting::Landscape,
        Painting::Blocks,
        Painting::Glass,
        Painting::Triangles,
        Painting::Page,
        Painting::Contours,
    ];
    for (n, motif) in motifs.into_iter().enumerate() {
        let (column, row) = ((n % 3) as f64, (n / 3) as f64);
        let size = [0.36 + 0.06 * column, 0.38 + 0.04 * row];
        let frame = if n % 2 == 0 {
            walnut()
        } else {
            Paint::Flat(rgb(0x22_2020))
        };
        props.framed(
            [x, -0.35 + 0.62 * column, 1.95 - 0.58 * row],
            0.0,
            size,
            frame,
            Paint::Painting(motif),
        );
    }
    props.framed(
        [x, -1.35, 1.85],
        0.0,
        [0.5, 0.5],
        oak(),
        Paint::Painting(Painting::Clock),
    );
    props.framed(
        [x, 2.1, 1.6],
        0.0,
        [0.6, 0.85],
        oak(),
        Paint::Painting(Painting::Circles),
    );
    props.framed(
        [x, -1.95, 1.25],
        0.0,
        [0.4, 0.55],
        walnut(),
        Paint::Painting(Painting::Map),
    );
}

fn south_wall(props: &mut Props) {
    let y = -HALF_Y;
    for (centre_x, colours) in [
        (-1.4, [0xB8_5038, 0xE8_C890]),
        (1.3, [0x3E_6A78, 0xD8_D0B0]),
    ] {
        props.sheet([centre_x, y + 0.02, 1.55], 90.0, [1.2, 1.4], Paint::View);
        let white = Paint::Flat(rgb(0xE8_E4D8));
        for x in [-0.62, 0.0, 0.62] {
            props.block([centre_x + x, y + 0.04, 1.55], [0.05, 0.06, 1.46], white);
        }
        for z in [0.85, 1.75, 2.27] {
            props.block([centre_x, y + 0.04, z], [1.28, 0.06, 0.05], white);
        }
        props.block([centre_x, y + 0.12, 0.82], [1.4, 0.24, 0.03], white);
        let cloth = Paint::Fabric {
            first: rgb(colours[0]),
            second: rgb(colours[1]),
            width: 0.07,
        };
        for n in 0..5 {
            let fold = 0.02 * f64::from(n % 2);
            for side in [-1.0, 1.0] {
                let x = centre_x + side * (0.62 + 0.07 * f64::from(n));
                props.tube([x, y + 0.11 + fold, 1.3], 2.2, [0.05, 0.045], cloth);
            }
        }
        props.tube([centre_x, y + 0.12, 2.42], 0.04, [0.02, 0.02], walnut());
        let ribs = Paint::Tiles {
            first: rgb(0xDC_D8CC),
            second: rgb(0xC8_C2B4),
            size: 0.08,
        };
        props.block([centre_x, y + 0.07, 0.42], [1.1, 0.1, 0.55], ribs);
    }
    props.block(
        [-0.05, y + 0.02, 1.02],
        [0.86, 0.05, 2.04],
        Paint::Panelled(rgb(0x6E_8A6A)),
    );
    for side in [-1.0, 1.0] {
        props.block(
            [-0.05 + 0.47 * side, y + 0.02, 1.05],
            [0.08, 0.07, 2.1],
            oak(),
        );
    }
    props.framed(
        [2.7, y, 1.6],
        90.0,
        [0.5, 0.7],
        walnut(),
        Paint::Painting(Painting::Blocks),
    );
}
