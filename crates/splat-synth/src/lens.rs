//! The lenses that a take can be filmed through.

use crate::settings::{LensKind, SynthSettings};
use splat_types::camera::{CameraModel, Distortion, Intrinsics};

/// Barrel distortion of a cheap webcam, with a little decentring.
const BARREL: [f64; 5] = [-0.25, 0.07, 0.0008, -0.0005, 0.0];
/// Close to f * angle, as fisheye lenses are sold.
const FISHEYE: [f64; 4] = [-0.012, 0.006, -0.002, 0.0003];

/// A lens with the given horizontal field of view (before distortion, but for the fisheye).
pub(crate) fn lens(kind: LensKind, width_px: u32, height_px: u32, fov_deg: f64) -> CameraModel {
    let (width, height) = (f64::from(width_px), f64::from(height_px));
    let half_angle = 0.5 * fov_deg.to_radians();
    let focal = match kind {
        LensKind::Pinhole | LensKind::Radial => 0.5 * width / half_angle.tan(),
        LensKind::Fisheye => 0.5 * width / half_angle,
    };
    // No real sensor sits exactly behind the middle of its lens.
    let intrinsics = Intrinsics {
        width_px,
        height_px,
        fx: focal,
        fy: focal,
        cx: width * 0.503,
        cy: height * 0.496,
    };
    let distortion = match kind {
        LensKind::Pinhole => Distortion::None,
        LensKind::Radial => Distortion::PlumbBob(BARREL),
        LensKind::Fisheye => Distortion::Equidistant(FISHEYE),
    };
    CameraModel {
        intrinsics,
        distortion,
    }
}

impl SynthSettings {
    /// The camera that the images are taken with.
    pub fn lens(&self) -> CameraModel {
        lens(self.lens, self.width_px, self.height_px, self.fov_deg)
    }
}
