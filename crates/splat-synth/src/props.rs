//! How scene files put solids in place: boxes, tubes, balls, sheets, alone or in groups that share a frame.

use glam::{DMat3, DVec2, DVec3};

use crate::geometry::{PlacedShape, Shape};
use crate::noise::hash;
use crate::paint::Rgb;
use crate::solid::Solid;
use crate::textures::Paint;

/// Puts solids in place; a group of things shares the frame set by `at`.
#[derive(Debug)]
pub(crate) struct Props {
    pub(crate) solids: Vec<Solid>,
    origin: DVec3,
    turn: DMat3,
    number: u32,
}

impl Props {
    pub(crate) fn new() -> Self {
        Self {
            solids: Vec::new(),
            origin: DVec3::ZERO,
            turn: DMat3::IDENTITY,
            number: 1,
        }
    }

    /// Of the next solid: what is uneven about its paint follows from it.
    pub(crate) fn next_number(&self) -> u32 {
        self.number
    }

    /// From here on solids are numbered as if `number` came next: equal numbers look equal.
    pub(crate) fn number_from(&mut self, number: u32) {
        self.number = number;
    }

    /// From here on places are meant from `origin`, turned by `yaw_deg` about z.
    pub(crate) fn at(&mut self, origin: DVec3, yaw_deg: f64) -> &mut Self {
        self.origin = origin;
        self.turn = DMat3::from_rotation_z(yaw_deg.to_radians());
        self
    }

    pub(crate) fn add(&mut self, shape: Shape, centre: DVec3, local: DMat3, paint: Paint) {
        let placed = PlacedShape {
            shape,
            centre: self.origin + self.turn * centre,
            world_from_local: self.turn * local,
        };
        let seed = hash(self.number);
        self.number += 1;
        self.solids.push(Solid {
            placed,
            paint,
            seed,
            mean: Rgb::ZERO,
            grids: Vec::new(),
        });
    }

    /// A box by its centre and full size.
    pub(crate) fn block(&mut self, centre: [f64; 3], size: [f64; 3], paint: Paint) {
        let half = 0.5 * DVec3::from_array(size);
        self.add(
            Shape::Block { half },
            DVec3::from_array(centre),
            DMat3::IDENTITY,
            paint,
        );
    }

    /// A box turned about its own centre.
    pub(crate) fn turned_block(
        &mut self,
        centre: [f64; 3],
        size: [f64; 3],
        local: DMat3,
        paint: Paint,
    ) {
        let half = 0.5 * DVec3::from_array(size);
        self.add(
            Shape::Block { half },
            DVec3::from_array(centre),
            local,
            paint,
        );
    }

    /// A cone cut off at both ends: centre, height, radius below and above.
    pub(crate) fn tube(&mut self, centre: [f64; 3], height: f64, radii: [f64; 2], paint: Paint) {
        let shape = Shape::Tube {
            half_height: 0.5 * height,
            bottom: radii[0],
            top: radii[1],
        };
        self.add(shape, DVec3::from_array(centre), DMat3::IDENTITY, paint);
    }

    pub(crate) fn ball(&mut self, centre: [f64; 3], radii: [f64; 3], paint: Paint) {
        let shape = Shape::Ball {
            radii: DVec3::from_array(radii),
        };
        self.add(shape, DVec3::from_array(centre), DMat3::IDENTITY, paint);
    }

    /// An upright sheet that looks to `facing_deg` (0 along +x, 90 along +y).
    pub(crate) fn sheet(
        &mut self,
        centre: [f64; 3],
        facing_deg: f64,
        size: [f64; 2],
        paint: Paint,
    ) {
        let normal = DMat3::from_rotation_z(facing_deg.to_radians()) * DVec3::X;
        let local = DMat3::from_cols(DVec3::Z.cross(normal), DVec3::Z, normal);
        let shape = Shape::Sheet {
            half: 0.5 * DVec2::from_array(size),
            round: false,
        };
        self.add(shape, DVec3::from_array(centre), local, paint);
    }

    /// A sheet that lies flat and looks up, or down where `up` is negative.
    pub(crate) fn flat(&mut self, centre: [f64; 3], up: f64, size: [f64; 2], paint: Paint) {
        let local = DMat3::from_cols(DVec3::X, DVec3::Y * up.signum(), DVec3::Z * up.signum());
        let shape = Shape::Sheet {
            half: 0.5 * DVec2::from_array(size),
            round: false,
        };
        self.add(shape, DVec3::from_array(centre), local, paint);
    }

    /// A painting in a wooden frame, hung so that it looks to `facing_deg`; `size` without the frame.
    pub(crate) fn framed(
        &mut self,
        centre: [f64; 3],
        facing_deg: f64,
        size: [f64; 2],
        frame: Paint,
        motif: Paint,
    ) {
        const RIM: f64 = 0.035;
        let normal = DMat3::from_rotation_z(facing_deg.to_radians()) * DVec3::X;
        let local = DMat3::from_cols(DVec3::Z.cross(normal), DVec3::Z, normal);
        let centre = DVec3::from_array(centre);
        let half = DVec3::new(0.5 * size[0] + RIM, 0.5 * size[1] + RIM, 0.015);
        self.add(Shape::Block { half }, centre + normal * 0.015, local, frame);
        let sheet = Shape::Sheet {
            half: 0.5 * DVec2::from_array(size),
            round: false,
        };
        self.add(sheet, centre + normal * 0.032, local, motif);
    }
}
