//! The lenses that a take can be filmed through, and the way between their pixels and rays.

use glam::{DVec2, DVec3};

use crate::camera::{Distortion, Intrinsics, Lens};

use super::LensKind;

/// Barrel distortion of a cheap webcam, with a little decentring.
const BARREL: [f64; 5] = [-0.25, 0.07, 0.0008, -0.0005, 0.0];
/// Close to f * angle, as fisheye lenses are sold.
const FISHEYE: [f64; 4] = [-0.012, 0.006, -0.002, 0.0003];

/// A lens with the given horizontal field of view (before distortion, but for the fisheye).
pub(super) fn lens(kind: LensKind, width_px: u32, height_px: u32, fov_deg: f64) -> Lens {
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
    Lens { intrinsics, distortion }
}

/// Place on the plane z = 1 -> place where the lens shows it, still in units of the focal length.
pub(super) fn distort(distortion: &Distortion, at: DVec2) -> DVec2 {
    let brown = |k: [f64; 8], p: [f64; 2]| {
        let r2 = at.length_squared();
        let up = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
        let down = 1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
        let both = 2.0 * at.x * at.y;
        let tangential = DVec2::new(
            p[0] * both + p[1] * (r2 + 2.0 * at.x * at.x),
            p[0] * (r2 + 2.0 * at.y * at.y) + p[1] * both,
        );
        at * (up / down) + tangential
    };
    match *distortion {
        Distortion::None => at,
        Distortion::PlumbBob([k1, k2, p1, p2, k3]) => brown([k1, k2, k3, 0.0, 0.0, 0.0, 0.0, 0.0], [p1, p2]),
        Distortion::Rational([k1, k2, p1, p2, k3, k4, k5, k6]) => brown([k1, k2, k3, k4, k5, k6, 0.0, 0.0], [p1, p2]),
        Distortion::Equidistant(k) => {
            let radius = at.length();
            if radius < 1e-12 { at } else { at * (bent_angle(k, radius.atan()) / radius) }
        }
    }
}

/// Pixel of a point in front of the camera.
pub(super) fn project(lens: &Lens, point_in_cam: DVec3) -> Option<DVec2> {
    let flat = (point_in_cam.z > 1e-9).then(|| point_in_cam.truncate() / point_in_cam.z)?;
    lens.intrinsics.project(distort(&lens.distortion, flat).extend(1.0))
}

/// Unit direction of the light that falls on a pixel.
pub(super) fn ray_in_cam(lens: &Lens, pixel: DVec2) -> DVec3 {
    let shown = lens.intrinsics.ray_in_cam(pixel).truncate();
    match lens.distortion {
        Distortion::None => shown.extend(1.0).normalize(),
        Distortion::Equidistant(k) => {
            let bent = shown.length();
            let angle = straight_angle(k, bent);
            let out = if bent < 1e-12 { DVec2::ZERO } else { shown / bent };
            (out * angle.sin()).extend(angle.cos())
        }
        Distortion::PlumbBob(_) | Distortion::Rational(_) => {
            undistort(&lens.distortion, shown).extend(1.0).normalize()
        }
    }
}

fn bent_angle(k: [f64; 4], angle: f64) -> f64 {
    let a2 = angle * angle;
    angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
}

/// Newton on the one angle; the lenses above bend monotonically far beyond their field of view.
fn straight_angle(k: [f64; 4], bent: f64) -> f64 {
    let mut angle = bent;
    for _ in 0..8 {
        let a2 = angle * angle;
        let slope = 1.0 + a2 * (3.0 * k[0] + a2 * (5.0 * k[1] + a2 * (7.0 * k[2] + a2 * 9.0 * k[3])));
        angle -= (bent_angle(k, angle) - bent) / slope.max(0.1);
    }
    angle
}

/// Newton in two dimensions with a slope by differences; quadratic, so six rounds reach rounding.
fn undistort(distortion: &Distortion, shown: DVec2) -> DVec2 {
    const STEP: f64 = 1e-6;
    let mut at = shown;
    for _ in 0..6 {
        let here = distort(distortion, at);
        let along_x = (distort(distortion, at + DVec2::X * STEP) - here) / STEP;
        let along_y = (distort(distortion, at + DVec2::Y * STEP) - here) / STEP;
        let missing = shown - here;
        let determinant = along_x.perp_dot(along_y);
        at += DVec2::new(missing.perp_dot(along_y), along_x.perp_dot(missing)) / determinant;
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_is_where_its_own_ray_projects() {
        for (kind, fov_deg) in [(LensKind::Pinhole, 66.0), (LensKind::Radial, 80.0), (LensKind::Fisheye, 120.0)] {
            let lens = lens(kind, 640, 480, fov_deg);
            for pixel in [DVec2::new(0.5, 0.5), DVec2::new(321.0, 238.0), DVec2::new(639.5, 479.5), DVec2::new(40.0, 300.0)] {
                let back = project(&lens, 3.0 * ray_in_cam(&lens, pixel)).unwrap();
                assert!(back.distance(pixel) < 1e-8, "{kind:?} {pixel} -> {back}");
            }
        }
    }
}
