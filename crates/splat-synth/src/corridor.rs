//! Four corridors round a block, the last one leads back to the first. Every side has its own colours.
//!
//! The camera walks on a rounded rectangle of about 5.5 m by 4.5 m; corridors are 1.8 m wide. Metres.

use glam::swizzles::Vec2Swizzles as _;
use glam::{DVec2, DVec3, Vec2, Vec3};

use crate::clutter::plant;
use crate::light::{Lamp, Light};
use crate::lighting::lit;
use crate::noise::{hash, pick};
use crate::paint::{Painting, hue, palette, rgb};
use crate::props::Props;
use crate::scene::Scene;
use crate::textures::Paint;

const OUTER: DVec2 = DVec2::new(3.65, 3.15);
const INNER: DVec2 = DVec2::new(1.85, 1.35);
const HEIGHT: f64 = 2.5;
/// What hangs on walls, in turn.
pub(crate) const MOTIFS: [Painting; 9] = [
    Painting::Page,
    Painting::Map,
    Painting::Blocks,
    Painting::Circles,
    Painting::Landscape,
    Painting::Contours,
    Painting::Glass,
    Painting::Chart,
    Painting::Triangles,
];

pub(crate) fn scene() -> Scene {
    let mut props = Props::new();
    let floor = Paint::Terrazzo {
        ground: rgb(0xB4_AC9C),
        size: 0.05,
    };
    props.flat([0.0, 0.0, 0.0], 1.0, [2.0 * OUTER.x, 2.0 * OUTER.y], floor);
    props.flat(
        [0.0, 0.0, HEIGHT],
        -1.0,
        [2.0 * OUTER.x, 2.0 * OUTER.y],
        Paint::Ceiling,
    );
    // Side n is walked towards +x turned by n quarter turns; its outer wall stands on the right hand.
    for side in 0..4u32 {
        let yaw = 90.0 * f64::from(side);
        let (out, inn) = if side.is_multiple_of(2) {
            (OUTER, INNER)
        } else {
            (OUTER.yx(), INNER.yx())
        };
        props.at(DVec3::ZERO, yaw);
        walls(&mut props, side, out, inn);
        hangings(&mut props, side, out, inn);
        standing(&mut props, side, out);
    }
    let mut lamps = Vec::new();
    props.at(DVec3::ZERO, 0.0);
    for (x, y, along_x) in [
        (-1.2, -2.25, true),
        (1.4, -2.25, true),
        (2.75, 0.0, false),
        (1.2, 2.25, true),
        (-1.4, 2.25, true),
        (-2.75, 0.1, false),
    ] {
        let size = if along_x { [1.1, 0.28] } else { [0.28, 1.1] };
        props.block(
            [x, y, HEIGHT - 0.01],
            [size[0] + 0.06, size[1] + 0.06, 0.04],
            Paint::Metal(rgb(0xB8_B8B4)),
        );
        props.flat(
            [x, y, HEIGHT - 0.032],
            -1.0,
            size,
            Paint::Glow(Vec3::splat(1.3)),
        );
        lamps.push(Lamp {
            centre: DVec3::new(x, y, HEIGHT - 0.04),
            half_u: DVec3::X * 0.5 * size[0],
            half_v: DVec3::Y * -0.5 * size[1],
            colour: Vec3::new(1.05, 1.0, 0.9) * 2.2,
        });
    }
    let light = Light {
        lamps,
        sun: None,
        sky: Vec3::splat(0.5),
        bounce: Vec3::splat(1.0),
        reach: 0.25,
        texel: 0.08,
    };
    lit(props, light)
}

/// Wainscot below, another material above, a rail between, on both walls.
fn walls(props: &mut Props, side: u32, out: DVec2, inn: DVec2) {
    const RAIL: f64 = 1.05;
    let lower = [
        Paint::Tiles {
            first: rgb(0x4E_7E86),
            second: rgb(0xA8_C0B8),
            size: 0.15,
        },
        Paint::Planks {
            light: rgb(0xA0_7446),
            dark: rgb(0x6C_4828),
            size: Vec2::new(1.1, 0.12),
        },
        Paint::Bricks {
            brick: rgb(0xA0_5844),
            mortar: rgb(0xB4_A894),
            size: Vec2::new(0.22, 0.075),
        },
        Paint::Tiles {
            first: rgb(0xC2_A868),
            second: rgb(0x8A_4A3A),
            size: 0.11,
        },
    ][side as usize];
    let upper = [
        Paint::Plaster(rgb(0xC8_C4B0)),
        Paint::Wallpaper {
            ground: rgb(0xCC_C6B4),
            first: rgb(0x3E_6470),
            second: rgb(0xB8_7A3C),
        },
        Paint::Plaster(rgb(0xA4_B89C)),
        Paint::Wallpaper {
            ground: rgb(0xB8_C4CC),
            first: rgb(0x6A_4A6A),
            second: rgb(0xC8_9A38),
        },
    ][side as usize];
    let rail = Paint::Wood(rgb(0x86_5C38));
    for (y, facing, length) in [(-out.y, 90.0, 2.0 * out.x), (-inn.y, -90.0, 2.0 * inn.x)] {
        let inward = if facing > 0.0 { 1.0 } else { -1.0 };
        props.sheet([0.0, y, 0.5 * RAIL], facing, [length, RAIL], lower);
        props.sheet(
            [0.0, y, 0.5 * (RAIL + HEIGHT)],
            facing,
            [length, HEIGHT - RAIL],
            upper,
        );
        props.block([0.0, y + 0.012 * inward, RAIL], [length, 0.05, 0.06], rail);
        props.block([0.0, y + 0.008 * inward, 0.05], [length, 0.03, 0.1], rail);
    }
}

/// Doors, signs, posters and notice boards; every wall has its own order.
fn hangings(props: &mut Props, side: u32, out: DVec2, inn: DVec2) {
    const SIGNS: [[&str; 2]; 4] = [
        ["ROOM 101", "LAB"],
        ["ROOM 112", "STORE"],
        ["ROOM 123", "OFFICE"],
        ["ROOM 134", "EXIT"],
    ];
    let wood = Paint::Wood(rgb(0x74_5034));
    for (wall, (y, facing, half)) in [(-out.y, 90.0, out.x), (-inn.y, -90.0, inn.x)]
        .into_iter()
        .enumerate()
    {
        let inward = if facing > 0.0 { 1.0 } else { -1.0 };
        let door_at = half * [0.45, -0.35][wall] * if side.is_multiple_of(2) { 1.0 } else { -1.0 };
        let colour = palette(side * 5 + wall as u32 * 3);
        props.block(
            [door_at, y + 0.02 * inward, 1.02],
            [0.9, 0.06, 2.04],
            Paint::Panelled(colour),
        );
        for jamb in [-0.49, 0.49] {
            props.block(
                [door_at + jamb, y + 0.025 * inward, 1.05],
                [0.08, 0.09, 2.1],
                wood,
            );
        }
        let sign = Paint::Label {
            ground: rgb(0xE4_DEC8),
            ink: rgb(0x22_2A38),
            text: SIGNS[side as usize][wall],
        };
        props.sheet(
            [door_at, y + 0.02 * inward, 2.24],
            facing,
            [0.8, 0.17],
            sign,
        );
        // What fits beside the door, from end to end, no two alike.
        let mut x = -half + 0.35;
        let mut n = side * 5 + wall as u32 * 2;
        while x < half - 0.35 {
            let id = hash(side * 101 + wall as u32 * 37 + n);
            let size = [
                0.32 + 0.3 * f64::from(pick(id, 1)),
                0.4 + 0.3 * f64::from(pick(id, 2)),
            ];
            let centre = x + 0.5 * size[0];
            if (centre - door_at).abs() > 0.6 + 0.5 * size[0] {
                let z = 1.62 + 0.2 * f64::from(pick(id, 3));
                let frame = if pick(id, 4) < 0.5 {
                    wood
                } else {
                    Paint::Flat(palette(id >> 7) * 0.5)
                };
                props.framed(
                    [centre, y, z],
                    facing,
                    size,
                    frame,
                    Paint::Painting(MOTIFS[(n % 9) as usize]),
                );
            }
            x += size[0] + 0.2;
            n += 1;
        }
    }
}

/// What stands along the outer wall, low enough to look over.
fn standing(props: &mut Props, side: u32, out: DVec2) {
    let y = -out.y + 0.2;
    let shift = if side.is_multiple_of(2) { -1.0 } else { 1.0 };
    let seat = Paint::Fabric {
        first: palette(side * 3 + 2),
        second: rgb(0xD8_CCB0),
        width: 0.05,
    };
    props.block([0.9 * shift, y, 0.42], [1.1, 0.34, 0.07], seat);
    for x in [-0.48, 0.48] {
        props.block(
            [0.9 * shift + x, y, 0.2],
            [0.05, 0.3, 0.4],
            Paint::Metal(rgb(0x66_6A6C)),
        );
    }
    for n in 0..3u32 {
        let id = hash(side * 19 + n);
        let centre = [0.6 * shift + 0.25 * f64::from(n), y, 0.475 + 0.02];
        props.block(
            centre,
            [0.16, 0.22, 0.04],
            Paint::Spine(hue(pick(id, 1), 0.6, 0.7)),
        );
    }
    let bottle = Paint::Label {
        ground: rgb(0xB8_2418),
        ink: rgb(0xF0_E8D8),
        text: "FIRE",
    };
    props.tube([-0.35 * shift, y - 0.08, 0.62], 0.5, [0.075, 0.07], bottle);
    props.tube(
        [-0.35 * shift, y - 0.08, 0.9],
        0.08,
        [0.05, 0.02],
        Paint::Metal(rgb(0x28_2828)),
    );
    props.tube(
        [-out.x + 0.16, -out.y + 0.16, 0.5 * HEIGHT],
        HEIGHT,
        [0.05, 0.05],
        Paint::Metal(rgb(0x9A_7A58)),
    );
    let parcel = Paint::Painting(Painting::Page);
    props.block([0.1 * shift, y - 0.02, 0.16], [0.4, 0.3, 0.32], parcel);
    // The frame of `plant` is its own; the caller sets the next one.
    let yaw = 90.0 * f64::from(side);
    let corner =
        glam::DMat3::from_rotation_z(yaw.to_radians()) * DVec3::new(out.x - 0.4, -out.y + 0.4, 0.0);
    plant(props.at(corner, 30.0), 1.1, 48, 40 + side);
}
