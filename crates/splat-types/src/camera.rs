//! Pinhole intrinsics, lens distortion models and the way between pixels and rays.
//!
//! Pixel centres lie at +0.5: the first pixel is sampled at (0.5, 0.5). ROS `CameraInfo` and OpenCV count
//! centres at integers; add 0.5 to their cx, cy at the boundary.

use glam::{DMat2, DVec2, DVec3};

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

/// A real lens: intrinsics of the image as it arrives, and its distortion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraModel {
    pub intrinsics: Intrinsics,
    pub distortion: Distortion,
}

impl Intrinsics {
    /// Pixel of a point in the camera frame; `None` at or behind the camera.
    #[inline]
    pub fn project(&self, point_in_cam: DVec3) -> Option<DVec2> {
        (point_in_cam.z > 1e-9).then(|| {
            DVec2::new(
                self.fx * point_in_cam.x / point_in_cam.z + self.cx,
                self.fy * point_in_cam.y / point_in_cam.z + self.cy,
            )
        })
    }

    /// Point with z = 1 on the ray through a pixel.
    #[inline]
    pub fn ray_in_cam(&self, pixel: DVec2) -> DVec3 {
        DVec3::new(
            (pixel.x - self.cx) / self.fx,
            (pixel.y - self.cy) / self.fy,
            1.0,
        )
    }

    /// The same camera with its image resized; a resize may change the aspect.
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

    /// The same image with another focal length.
    pub fn refocused(&self, factor: f64) -> Self {
        Self {
            fx: self.fx * factor,
            fy: self.fy * factor,
            ..*self
        }
    }

    /// Finite, positive focal lengths and a principal point within one image of the centre.
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

/// Newton steps of `undistort`; lenses in use need 3 to 8.
const MAX_NEWTON_STEPS: usize = 60;
/// Largest residual that counts as solved, on the plane z = 1: 1e-6 px at a focal length of 1000 px.
const SOLVED: f64 = 1e-9;
/// Rays beyond this radius on the plane z = 1 (85.7 deg off axis) are not for a pinhole.
const MAX_RADIUS: f64 = 13.3;
const RADIUS_STEP: f64 = 0.01;

impl Distortion {
    #[inline]
    pub fn is_none(&self) -> bool {
        match self {
            Self::None => true,
            Self::PlumbBob(k) => k.iter().all(|&c| c == 0.0),
            Self::Rational(k) => k.iter().all(|&c| c == 0.0),
            // Zero coefficients still mean an equidistant lens, which is no pinhole.
            Self::Equidistant(_) => false,
        }
    }

    pub fn is_finite(&self) -> bool {
        match self {
            Self::None => true,
            Self::PlumbBob(k) => k.iter().all(|c| c.is_finite()),
            Self::Rational(k) => k.iter().all(|c| c.is_finite()),
            Self::Equidistant(k) => k.iter().all(|c| c.is_finite()),
        }
    }

    /// Where the lens puts the ray through `ideal` on the plane z = 1, in the same plane.
    #[inline]
    pub fn distort(&self, ideal: DVec2) -> DVec2 {
        match self {
            Self::None => ideal,
            Self::PlumbBob(k) => brown(&widened(k), ideal).0,
            Self::Rational(k) => brown(k, ideal).0,
            Self::Equidistant(k) => {
                let radius = ideal.length();
                // The ratio angle / radius tends to 1; below this radius it is 1 to the last digit.
                if radius < 1e-9 {
                    ideal
                } else {
                    ideal * (fisheye(k, radius.atan()).0 / radius)
                }
            }
        }
    }

    /// The inverse of `distort`; `None` where no ray in front of the camera lands there.
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        if !distorted.is_finite() {
            return None;
        }
        match self {
            Self::None => Some(distorted),
            Self::PlumbBob(k) => undistort_brown(&widened(k), distorted),
            Self::Rational(k) => undistort_brown(k, distorted),
            Self::Equidistant(k) => undistort_fisheye(k, distorted),
        }
    }

    /// Radius on the plane z = 1 up to which rays further out land further out. Beyond it a polynomial folds
    /// back and says nothing of the lens.
    pub fn max_radius(&self) -> f64 {
        let lands_at = |radius: f64| match self {
            // The tangential part is small and has no say in where the radial part folds.
            Self::PlumbBob(k) => radius * radial(&widened(k), radius * radius).0,
            Self::Rational(k) => radius * radial(k, radius * radius).0,
            Self::None | Self::Equidistant(_) => self.distort(DVec2::new(radius, 0.0)).x,
        };
        let mut last = 0.0;
        let mut radius = 0.0;
        while radius < MAX_RADIUS {
            let next = lands_at(radius + RADIUS_STEP);
            // False for NaN, which ends the loop too.
            let grows = next > last;
            if !grows {
                break;
            }
            last = next;
            radius += RADIUS_STEP;
        }
        radius
    }
}

impl CameraModel {
    /// Pixel of a point in the camera frame, through the real lens; `None` at or behind the camera.
    #[inline]
    pub fn project(&self, point_in_cam: DVec3) -> Option<DVec2> {
        (point_in_cam.z > 1e-9).then(|| {
            let landed = self
                .distortion
                .distort(point_in_cam.truncate() / point_in_cam.z);
            let i = &self.intrinsics;
            DVec2::new(i.fx * landed.x + i.cx, i.fy * landed.y + i.cy)
        })
    }

    /// Point with z = 1 on the ray that lands on a pixel; `None` where no ray in front of the camera does.
    #[inline]
    pub fn ray_in_cam(&self, pixel: DVec2) -> Option<DVec3> {
        let landed = self.intrinsics.ray_in_cam(pixel).truncate();
        self.distortion
            .undistort(landed)
            .map(|ideal| ideal.extend(1.0))
    }

    /// The same lens with its image resized; coefficients live on the plane z = 1 and stay.
    pub fn resized(&self, width_px: u32, height_px: u32) -> Self {
        Self {
            intrinsics: self.intrinsics.resized(width_px, height_px),
            distortion: self.distortion,
        }
    }
}

fn widened(k: &[f64; 5]) -> [f64; 8] {
    [k[0], k[1], k[2], k[3], k[4], 0.0, 0.0, 0.0]
}

/// Radial factor of the rational model and its derivative by r squared (OpenCV calib3d, "rational model").
fn radial(k: &[f64; 8], r2: f64) -> (f64, f64) {
    let above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
    let below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]));
    let above_rate = k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4]);
    let below_rate = k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7]);
    (
        above / below,
        (above_rate * below - above * below_rate) / (below * below),
    )
}

/// Brown-Conrady with rational radial part: where the ray lands, and the derivative of that.
fn brown(k: &[f64; 8], p: DVec2) -> (DVec2, DMat2) {
    let (p1, p2) = (k[2], k[3]);
    let r2 = p.length_squared();
    let (factor, rate) = radial(k, r2);
    let landed = DVec2::new(
        p.x * factor + 2.0 * p1 * p.x * p.y + p2 * (r2 + 2.0 * p.x * p.x),
        p.y * factor + p1 * (r2 + 2.0 * p.y * p.y) + 2.0 * p2 * p.x * p.y,
    );
    let mixed = 2.0 * p.x * p.y * rate + 2.0 * p1 * p.x + 2.0 * p2 * p.y;
    let derivative = DMat2::from_cols(
        DVec2::new(
            factor + 2.0 * p.x * p.x * rate + 2.0 * p1 * p.y + 6.0 * p2 * p.x,
            mixed,
        ),
        DVec2::new(
            mixed,
            factor + 2.0 * p.y * p.y * rate + 6.0 * p1 * p.y + 2.0 * p2 * p.x,
        ),
    );
    (landed, derivative)
}

fn undistort_brown(k: &[f64; 8], distorted: DVec2) -> Option<DVec2> {
    let is_before_fold = |p: DVec2| brown(k, p).1.determinant() > 1e-12;
    // A strong pincushion shows rays far out, where the polynomial may have folded; the axis is always before it.
    let mut ideal = if is_before_fold(distorted) {
        distorted
    } else {
        DVec2::ZERO
    };
    let mut residual = brown(k, ideal).0 - distorted;
    for _ in 0..MAX_NEWTON_STEPS {
        if !is_before_fold(ideal) {
            return None;
        }
        let step = brown(k, ideal).1.inverse() * residual;
        let at_share = |share: f64| {
            let next = ideal - step * share;
            (next, brown(k, next).0 - distorted)
        };
        // Halving keeps Newton from jumping over the fold of a strong polynomial.
        let shares = std::iter::successors(Some(1.0), |share| Some(share * 0.5)).take(10);
        let better = shares
            .map(at_share)
            .find(|(_, next)| next.length() < residual.length());
        // None is better when the residual is down to rounding errors.
        let Some((next, next_residual)) = better else {
            break;
        };
        (ideal, residual) = (next, next_residual);
    }
    (residual.length() < SOLVED && radial(k, ideal.length_squared()).0 > 0.0).then_some(ideal)
}

/// Angle at which an equidistant lens shows a ray `angle` off axis, and its derivative (Kannala and Brandt 2006, eq. 6).
fn fisheye(k: &[f64; 4], angle: f64) -> (f64, f64) {
    let a2 = angle * angle;
    let shown = angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))));
    let rate = 1.0 + a2 * (3.0 * k[0] + a2 * (5.0 * k[1] + a2 * (7.0 * k[2] + a2 * 9.0 * k[3])));
    (shown, rate)
}

fn undistort_fisheye(k: &[f64; 4], distorted: DVec2) -> Option<DVec2> {
    let shown = distorted.length();
    if shown < 1e-9 {
        return Some(distorted);
    }
    let mut angle = shown.min(1.5);
    for _ in 0..MAX_NEWTON_STEPS {
        let (at, rate) = fisheye(k, angle);
        let is_before_fold = rate > 1e-6;
        if !is_before_fold {
            return None;
        }
        let step = (at - shown) / rate;
        angle = (angle - step).clamp(0.0, std::f64::consts::FRAC_PI_2);
        if step.abs() < 1e-15 {
            break;
        }
    }
    let radius = angle.tan();
    let solved = (fisheye(k, angle).0 - shown).abs() < SOLVED && radius <= MAX_RADIUS;
    solved.then(|| distorted * (radius / shown))
}
