//! The camera behind an image of any size: a pinhole, and the lens where the image is no pinhole's.

use glam::DVec2;

use splat_types::camera::{CameraModel, Intrinsics};

/// The camera behind a working image, which may be smaller than what the camera took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorkingCamera {
    /// In pixels of about the working image's size.
    pub pinhole: Intrinsics,
    /// Where the image is no pinhole's: its lens, of the working image.
    pub lens: Option<CameraModel>,
}

impl WorkingCamera {
    /// Of working images of `working_px`, from a camera whose images may have another size. `None` for cameras
    /// that are none.
    pub fn of(
        intrinsics: &Intrinsics,
        lens: Option<&CameraModel>,
        working_px: (u32, u32),
    ) -> Option<Self> {
        if !intrinsics.is_plausible() || working_px.0 == 0 || working_px.1 == 0 {
            return None;
        }
        let camera = Self {
            pinhole: *intrinsics,
            lens: lens.copied(),
        };
        Some(camera.resized(working_px))
    }

    /// The same camera behind images of another size.
    pub fn resized(&self, (width, height): (u32, u32)) -> Self {
        Self {
            pinhole: self.pinhole.resized(width, height),
            lens: self.lens.map(|lens| lens.resized(width, height)),
        }
    }

    /// Whether another camera of images of the same size shows rays at the same pixels, but for a share of the longer side.
    pub(crate) fn is_alike(&self, other: &Self, share: f64) -> bool {
        if self == other {
            return true;
        }
        let (own, others) = (&self.pinhole, &other.pinhole);
        if (own.width_px, own.height_px) != (others.width_px, others.height_px) {
            return false;
        }
        let size = DVec2::new(f64::from(own.width_px), f64::from(own.height_px));
        let tolerance_px = share * size.max_element();
        let places = [
            (0.05, 0.05),
            (0.95, 0.05),
            (0.05, 0.95),
            (0.95, 0.95),
            (0.5, 0.5),
        ];
        places.into_iter().all(|(x, y)| {
            let pixel = size * DVec2::new(x, y);
            let apart = (own.ray_in_cam(pixel) - others.ray_in_cam(pixel)).length() * own.fx;
            let shown = self.distorted(pixel).zip(other.distorted(pixel));
            apart < tolerance_px && shown.is_some_and(|(a, b)| a.distance(b) < tolerance_px)
        })
    }

    /// Where the pinhole would show what the lens shows at a pixel; not a number where the lens says nothing.
    pub(crate) fn undistorted(&self, pixel: DVec2) -> DVec2 {
        let Some(lens) = &self.lens else {
            return pixel;
        };
        let ray = lens.ray_in_cam(pixel);
        let undistorted = ray.and_then(|ray| self.pinhole.project(ray));
        undistorted.unwrap_or(DVec2::NAN)
    }

    /// Where the lens shows what the pinhole shows at a pixel.
    pub(crate) fn distorted(&self, pixel: DVec2) -> Option<DVec2> {
        match &self.lens {
            None => Some(pixel),
            Some(lens) => lens.project(self.pinhole.ray_in_cam(pixel)),
        }
    }
}
