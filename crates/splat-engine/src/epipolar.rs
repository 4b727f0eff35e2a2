//! Points seen in two views -> how far each lies from the other's epipolar line, and which way the first camera
//! should move.
//!
//! Knows nothing of splats. Only the pose of the view that is stepped on moves. GRADIENTS.md, section 8.

use glam::{DMat3, DVec2, DVec3};

use crate::view::Correspondence;
use splat_types::camera::Intrinsics;
use splat_types::transform::{Rigid, skew};

/// A match that is farther off is wrong and pulls nowhere (VGGT-X gives it no weight either).
const MAX_ERROR_PX: f64 = 20.0;
/// Sine of the angle to the baseline below which a ray is too near the epipole: the line turns without bound there.
const MIN_SINE: f64 = 0.01;
/// Baseline below which two views have no epipolar geometry, share of a unit of the map.
const MIN_BASELINE: f64 = 1e-9;

/// A camera with its pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Eye {
    pub(crate) intrinsics: Intrinsics,
    pub(crate) cam_from_world: Rigid,
}

/// Symmetric epipolar distance of a match between two cameras, each its intrinsics and `cam_from_world`, in px; `None` near the epipole
/// and without a baseline.
pub fn distance_px(
    own: &(Intrinsics, Rigid),
    other: &(Intrinsics, Rigid),
    own_px: [f32; 2],
    other_px: [f32; 2],
) -> Option<f64> {
    let eye = |&(intrinsics, cam_from_world): &(Intrinsics, Rigid)| Eye {
        intrinsics,
        cam_from_world,
    };
    Some(one(&eye(own), &eye(other), own_px, other_px)?.0)
}

/// Weighted mean of the symmetric epipolar distance in px, and its gradient with respect to (rho, theta) of
/// `exp([rho; theta]) * own.cam_from_world`. `other` answers with the camera of a view, `None` where there is none.
pub(crate) fn epipolar(
    own: &Eye,
    matches: &[Correspondence],
    other: impl Fn(u32) -> Option<Eye>,
) -> (f64, [f64; 6]) {
    let (mut sum, mut weights, mut gradient) = (0.0, 0.0, [0.0; 6]);
    for found in matches {
        let weight = f64::from(found.weight);
        let usable = weight > 0.0 && weight.is_finite();
        let Some(other) = other(found.other_view_ix).filter(|_| usable) else {
            continue;
        };
        let Some((error, of_pose)) = one(own, &other, found.own_px, found.other_px) else {
            continue;
        };
        weights += weight;
        sum += weight * error.min(MAX_ERROR_PX);
        if error < MAX_ERROR_PX {
            gradient
                .iter_mut()
                .zip(of_pose)
                .for_each(|(g, v)| *g += weight * v);
        }
    }
    if weights <= 0.0 {
        return (0.0, [0.0; 6]);
    }
    (sum / weights, gradient.map(|g| g / weights))
}

/// Distance of one match and its gradient; `None` near the epipole and without a baseline.
fn one(own: &Eye, other: &Eye, own_px: [f32; 2], other_px: [f32; 2]) -> Option<(f64, [f64; 6])> {
    let other_from_own = other.cam_from_world * own.cam_from_world.inverse();
    let length = other_from_own.translation.length();
    if length.is_nan() || length < MIN_BASELINE {
        return None;
    }
    // The distance does not depend on the length of the essential matrix: the derivative of the length cancels.
    let rotation = other_from_own.rotation_matrix();
    let essential = skew(other_from_own.translation) * rotation;
    let y = own.ray(own_px);
    let z = other.ray(other_px);
    let (line, own_line) = (essential * y, essential.transpose() * z);
    let (inverse, own_inverse) = (other.inverse_focal(), own.inverse_focal());
    let (n, own_n) = (line * inverse, own_line * own_inverse);
    let (a, b) = (n.length_squared(), own_n.length_squared());
    // Of a line's normal, the part in the image; the sine of ray and baseline times the baseline over the focal.
    let least = |inverse: DVec3| (MIN_SINE * length).powi(2) * inverse.x * inverse.y;
    if a.is_nan() || b.is_nan() || a <= least(inverse) || b <= least(own_inverse) {
        return None;
    }
    let residual = z.dot(line);
    let factor = (1.0 / a + 1.0 / b).sqrt();
    let error = residual.abs() * factor;
    if !error.is_finite() {
        return None;
    }
    let sign = if residual == 0.0 {
        0.0
    } else {
        residual.signum()
    };
    let by_line = n * inverse * (-residual.abs() / (factor * a * a));
    let by_own_line = own_n * own_inverse * (-residual.abs() / (factor * b * b));
    let by_essential = outer(z * (sign * factor) + by_line, y) + outer(z, by_own_line);
    // own moves by exp(xi): other_from_own moves by exp(-xi) on its right.
    let rho = vee(rotation.transpose() * by_essential);
    let theta = vee(essential.transpose() * by_essential);
    Some((
        error,
        [-rho.x, -rho.y, -rho.z, -theta.x, -theta.y, -theta.z],
    ))
}

impl Eye {
    fn ray(&self, px: [f32; 2]) -> DVec3 {
        self.intrinsics
            .ray_in_cam(DVec2::new(f64::from(px[0]), f64::from(px[1])))
    }

    /// Third component 0: a line's distance is measured in the image.
    fn inverse_focal(&self) -> DVec3 {
        DVec3::new(1.0 / self.intrinsics.fx, 1.0 / self.intrinsics.fy, 0.0)
    }
}

fn outer(column: DVec3, row: DVec3) -> DMat3 {
    DMat3::from_cols(column * row.x, column * row.y, column * row.z)
}

/// `vee(m).dot(e)` is the sum over entries of `m` times `skew(e)`.
fn vee(m: DMat3) -> DVec3 {
    let at = |row: usize, col: usize| m.col(col)[row];
    DVec3::new(
        at(2, 1) - at(1, 2),
        at(0, 2) - at(2, 0),
        at(1, 0) - at(0, 1),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Central differences in f64 with step 1e-6.
    const TOLERANCE: f64 = 1e-5;

    fn eye(n: f64) -> Eye {
        Eye {
            intrinsics: Intrinsics {
                width_px: 320,
                height_px: 240,
                fx: 280.0 + n,
                fy: 300.0 - n,
                cx: 158.0,
                cy: 121.0,
            },
            cam_from_world: Rigid::exp(
                DVec3::new(0.4 * n, -0.1 * n, 0.2 * n * n),
                DVec3::new(0.05 * n, -0.1 * n, 0.03),
            ),
        }
    }

    /// Points in front of both cameras, with errors of up to `noise_px`.
    fn matches(own: &Eye, noise_px: f32) -> Vec<Correspondence> {
        (0..12_u8)
            .map(|k| {
                let t = f64::from(k);
                let point = DVec3::new(
                    (t * 1.3).sin(),
                    (t * 0.7).cos() * 0.8,
                    3.0 + (t * 2.1).sin(),
                );
                let ix = u32::from(k % 2) + 1;
                let px = |eye: &Eye| {
                    let pixel = eye
                        .intrinsics
                        .project(eye.cam_from_world.transform_point(point));
                    pixel.unwrap().as_vec2().to_array()
                };
                let mut own_px = px(own);
                // Never 0: the distance has a kink there.
                own_px[usize::from(k) % 2] += noise_px * (2.0 + (t * 3.3).sin()) as f32;
                Correspondence {
                    own_px,
                    other_view_ix: ix,
                    other_px: px(&eye(f64::from(ix))),
                    weight: 0.5 + f32::from(k) / 12.0,
                }
            })
            .collect()
    }

    fn others(ix: u32) -> Option<Eye> {
        (1..3).contains(&ix).then(|| eye(f64::from(ix)))
    }

    #[test]
    fn the_gradient_agrees_with_differences() {
        let own = eye(0.0);
        let matches = matches(&own, 2.0);
        let (_, found) = epipolar(&own, &matches, others);
        for (k, found) in found.iter().enumerate() {
            let at = |delta: f64| {
                let mut xi = [0.0; 6];
                xi[k] = delta;
                let step = Rigid::exp(DVec3::from_slice(&xi[..3]), DVec3::from_slice(&xi[3..]));
                let moved = Eye {
                    cam_from_world: step * own.cam_from_world,
                    ..own
                };
                epipolar(&moved, &matches, others).0
            };
            let wanted = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!(
                (found - wanted).abs() < TOLERANCE * wanted.abs().max(1.0),
                "{k}: {found} {wanted}"
            );
        }
    }

    #[test]
    fn perfect_matches_have_no_distance_and_a_shift_across_the_line_has_its_length() {
        let own = eye(0.0);
        assert!(epipolar(&own, &matches(&own, 0.0), others).0 < 1e-3);
        // Cameras side by side: lines are rows, so one row off is one px in each image.
        let mut side = own;
        side.cam_from_world.translation.x += 1.0;
        let off = Correspondence {
            own_px: [100.0, 80.0],
            other_view_ix: 0,
            other_px: [60.0, 81.0],
            weight: 1.0,
        };
        let (error, _) = epipolar(&own, &[off], |_| Some(side));
        assert!((error - 2.0_f64.sqrt()).abs() < 0.05, "{error}");
    }

    #[test]
    fn outliers_epipoles_and_equal_places_pull_nowhere() {
        let own = eye(0.0);
        let at = |own_px, other_px, weight| Correspondence {
            own_px,
            other_view_ix: 1,
            other_px,
            weight,
        };
        let far = [at([10.0, 10.0], [300.0, 230.0], 1.0)];
        assert_eq!(epipolar(&own, &far, others).1, [0.0; 6]);
        assert_eq!(epipolar(&own, &far, |_| Some(own)), (0.0, [0.0; 6]));
        assert_eq!(epipolar(&own, &far, |_| None), (0.0, [0.0; 6]));
        let lost = [
            at([f32::NAN, 10.0], [30.0, 20.0], 1.0),
            at([9.0, 9.0], [9.0, 9.0], f32::NAN),
        ];
        assert_eq!(epipolar(&own, &lost, others), (0.0, [0.0; 6]));
        let mut ahead = own;
        ahead.cam_from_world.translation.z += 1.0;
        let epipole = [158.0, 121.0];
        let (error, gradient) = epipolar(&own, &[at(epipole, epipole, 1.0)], |_| Some(ahead));
        assert_eq!((error, gradient), (0.0, [0.0; 6]));
    }
}
