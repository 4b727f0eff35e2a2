//! Pinhole intrinsics, lens distortion models and the way between pixels and rays.
//!
//! Pixel centres lie at +0.5: the first pixel is sampled at (0.5, 0.5). ROS `CameraInfo` and OpenCV count
//! centres at integers; add 0.5 to their cx, cy at the boundary.

use glam::{DVec2, DVec3};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    pub width_px: u32,
    pub height_px: u32,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
}

/// Lens distortion as ROS `CameraInfo` names it; coefficients in the order of its `d`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Distortion {
    None,
    /// k1 k2 p1 p2 k3 (Brown-Conrady).
    PlumbBob([f64; 5]),
    /// k1 k2 p1 p2 k3 k4 k5 k6.
    Rational([f64; 8]),
    /// k1 k2 k3 k4 over the angle (Kannala-Brandt fisheye).
    Equidistant([f64; 4]),
}

/// A real lens: intrinsics of the picture as it arrives, and its distortion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    pub intrinsics: Intrinsics,
    pub distortion: Distortion,
}

impl Intrinsics {
    /// Pixel of a point in the camera frame; `None` at or behind the camera.
    pub fn project(&self, point_in_cam: DVec3) -> Option<DVec2> {
        (point_in_cam.z > 1e-9).then(|| {
            DVec2::new(
                self.fx * point_in_cam.x / point_in_cam.z + self.cx,
                self.fy * point_in_cam.y / point_in_cam.z + self.cy,
            )
        })
    }

    /// Point with z = 1 on the ray through a pixel.
    pub fn ray_in_cam(&self, pixel: DVec2) -> DVec3 {
        DVec3::new(
            (pixel.x - self.cx) / self.fx,
            (pixel.y - self.cy) / self.fy,
            1.0,
        )
    }

    /// The same camera with its picture resized; a resize may change the aspect.
    pub fn resized(&self, width_px: u32, height_px: u32) -> Self {
        let sx = f64::from(width_px) / f64::from(self.width_px);
        let sy = f64::from(height_px) / f64::from(self.height_px);
        Self {
            width_px,
            height_px,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
        }
    }

    /// Finite, positive focal lengths and a principal point within one picture of the centre.
    pub fn is_plausible(&self) -> bool {
        let (w, h) = (f64::from(self.width_px), f64::from(self.height_px));
        let longest = w.max(h);
        let focal_fits = |f: f64| f.is_finite() && f > 0.05 * longest && f < 100.0 * longest;
        let centre_fits = |c: f64, side: f64| c.is_finite() && c > -side && c < 2.0 * side;
        w > 0.0
            && h > 0.0
            && focal_fits(self.fx)
            && focal_fits(self.fy)
            && centre_fits(self.cx, w)
            && centre_fits(self.cy, h)
    }
}
