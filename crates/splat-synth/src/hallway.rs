//! A straight hallway of bays that are all alike, to the last stain: a place that looks as if it were seen again.
//!
//! The camera walks along x in the middle; bays are 1.8 m long. Metres.

use glam::{DVec3, Vec2, Vec3};

use crate::light::{Lamp, Light};
use crate::lighting::lit;
use crate::paint::{Painting, rgb};
use crate::props::Props;
use crate::scene::Scene;
use crate::textures::Paint;

pub(crate) const BAY: f64 = 1.8;
/// The last ones are never reached: their end wall stays small.
const N_BAYS: u32 = 22;
/// How far the camera goes, bays.
pub(crate) const N_WALKED: f64 = 16.0;
const HALF_WIDTH: f64 = 0.95;
const HEIGHT: f64 = 2.5;

pub(crate) fn scene() -> Scene {
    let mut props = Props::new();
    let mut lamps = Vec::new();
    let first = props.next_number();
    for bay in 0..N_BAYS {
        let x = BAY * (f64::from(bay) - 1.0);
        props.at(DVec3::X * x, 0.0);
        // The same numbers give the same stains.
        props.number_from(first);
        one_bay(&mut props);
        lamps.push(Lamp {
            centre: DVec3::new(x, 0.0, HEIGHT - 0.04),
            half_u: DVec3::X * 0.4,
            half_v: DVec3::Y * -0.14,
            colour: Vec3::new(1.05, 1.0, 0.9) * 1.3,
        });
    }
    props.at(DVec3::ZERO, 0.0);
    let ends = [-1.5 * BAY, (f64::from(N_BAYS) - 1.5) * BAY];
    for (x, facing) in ends.into_iter().zip([0.0, 180.0]) {
        let wall = Paint::Plaster(rgb(0xA8_A498));
        props.sheet(
            [x, 0.0, 0.5 * HEIGHT],
            facing,
            [2.0 * HALF_WIDTH, HEIGHT],
            wall,
        );
    }
    let light = Light {
        lamps,
        sun: None,
        sky: Vec3::splat(0.5),
        bounce: Vec3::splat(1.0),
        reach: 0.25,
        texel: 0.12,
    };
    lit(props, light)
}

fn one_bay(props: &mut Props) {
    let floor = Paint::Terrazzo {
        ground: rgb(0xB4_AC9C),
        size: 0.05,
    };
    props.flat([0.0, 0.0, 0.0], 1.0, [BAY, 2.0 * HALF_WIDTH], floor);
    props.flat(
        [0.0, 0.0, HEIGHT],
        -1.0,
        [BAY, 2.0 * HALF_WIDTH],
        Paint::Ceiling,
    );
    props.flat(
        [0.0, 0.0, HEIGHT - 0.02],
        -1.0,
        [0.8, 0.28],
        Paint::Glow(Vec3::splat(1.3)),
    );
    let lower = Paint::Bricks {
        brick: rgb(0xA0_5844),
        mortar: rgb(0xB4_A894),
        size: Vec2::new(0.22, 0.075),
    };
    let upper = Paint::Wallpaper {
        ground: rgb(0xCC_C6B4),
        first: rgb(0x3E_6470),
        second: rgb(0xB8_7A3C),
    };
    for (y, facing) in [(-HALF_WIDTH, 90.0), (HALF_WIDTH, -90.0)] {
        props.sheet([0.0, y, 0.5], facing, [BAY, 1.0], lower);
        props.sheet([0.0, y, 1.75], facing, [BAY, 1.5], upper);
    }
    let door = Paint::Panelled(rgb(0x5A_7A6A));
    props.block([-0.3, -HALF_WIDTH + 0.02, 1.02], [0.8, 0.06, 2.04], door);
    let sign = Paint::Label {
        ground: rgb(0xE4_DEC8),
        ink: rgb(0x22_2A38),
        text: "ROOM",
    };
    props.sheet([-0.3, -HALF_WIDTH + 0.02, 2.24], 90.0, [0.6, 0.17], sign);
    let frame = Paint::Wood(rgb(0x74_5034));
    let hung = [
        ([0.5, -HALF_WIDTH, 1.6], 90.0, Painting::Map),
        ([-0.45, HALF_WIDTH, 1.55], -90.0, Painting::Contours),
        ([0.4, HALF_WIDTH, 1.7], -90.0, Painting::Landscape),
    ];
    for (centre, facing, motif) in hung {
        props.framed(centre, facing, [0.45, 0.6], frame, Paint::Painting(motif));
    }
    let parcel = Paint::Painting(Painting::Page);
    props.block([0.45, 0.72, 0.2], [0.4, 0.3, 0.4], parcel);
}
