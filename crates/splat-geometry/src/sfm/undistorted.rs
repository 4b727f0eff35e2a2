//! The pinholes that images of an uncalibrated camera are undistorted to.

use std::collections::BTreeMap;

use splat_types::camera::{CameraModel, Intrinsics};

/// How the images of uncalibrated views are undistorted; empty for a lens that is a pinhole.
#[derive(Debug, Default)]
pub(crate) struct Undistorted {
    /// By size of the image: its lens, and the pinhole to which it was undistorted.
    pub(crate) pinholes: BTreeMap<(u32, u32), (CameraModel, Intrinsics)>,
    /// Radial coefficient and working lens when the images were made.
    pub(crate) made_with: Option<(f64, Intrinsics)>,
}

impl Undistorted {
    /// Lens and pinhole of an image of that size, whose working image has the given lens today; `None` where the
    /// image is a pinhole's as it is.
    pub(crate) fn of(
        &self,
        (width_px, height_px): (u32, u32),
        lens_today: &Intrinsics,
    ) -> Option<(CameraModel, Intrinsics)> {
        let (lens, pinhole) = self.pinholes.get(&(width_px, height_px))?;
        let now = lens_today.resized(width_px, height_px);
        let since = now.fx / lens.intrinsics.fx;
        Some((*lens, pinhole.refocused(since)))
    }
}
