//! Gradients of the 2D Gaussians -> gradients of the splats and of the pose. docs/GRADIENTS.md 7 and 8.

use nalgebra::{Matrix3, Vector2, Vector3, Vector4};

use super::project::{Projected, SH, rotation, sh_basis};
use super::raster_backward::ProjectedGradient;
use super::{Camera, Params};

/// Gradient of the splats, of [rho; theta] and of the logarithm of a factor on both focal lengths.
pub fn project_backward(
    params: &Params,
    camera: &Camera,
    projected: &[Projected],
    gradients: &[ProjectedGradient],
    sh_degree: u8,
) -> (Params, [f64; 6], f64) {
    let mut splats = Params::zeros_like(params);
    let (mut rho, mut theta, mut log_focal) = (Vector3::zeros(), Vector3::zeros(), 0.0);
    for (splat, v) in projected.iter().zip(gradients) {
        let ix = splat.splat_ix;
        let (v_mean_in_cam, v_covariance_in_cam) = through_projection(camera, splat, v);
        log_focal += through_focal(camera, splat, v);
        let v_offset_in_world = through_colour(params, splat, v, sh_degree, &mut splats.sh);

        let v_mean = camera.rotation.transpose() * v_mean_in_cam + v_offset_in_world;
        splats.means[ix] = v_mean.into();
        splats.opacity_logits[ix] = v.opacity * splat.opacity * (1.0 - splat.opacity);
        let v_covariance = camera.rotation.transpose() * v_covariance_in_cam * camera.rotation;
        (splats.log_scales[ix], splats.quats[ix]) = through_covariance(params, ix, &v_covariance);

        // T' = exp([rho; theta]) T moves points by rho + theta x p, and turns the covariance: S' = S + [theta]S - S[theta].
        // The camera centre moves by -R' rho and not at all with theta, since rotation about the camera leaves it there.
        rho += v_mean_in_cam + camera.rotation * v_offset_in_world;
        let a = splat.covariance_in_cam * v_covariance_in_cam
            - v_covariance_in_cam * splat.covariance_in_cam;
        theta += splat.mean_in_cam.cross(&v_mean_in_cam) + 2.0 * Vector3::new(a.m23, a.m31, a.m12);
    }
    let pose = [rho.x, rho.y, rho.z, theta.x, theta.y, theta.z];
    (splats, pose, log_focal)
}

/// To the mean and the covariance in the camera frame.
fn through_projection(
    camera: &Camera,
    splat: &Projected,
    v: &ProjectedGradient,
) -> (Vector3<f64>, Matrix3<f64>) {
    let (fx, fy) = (camera.intrinsics.fx, camera.intrinsics.fy);
    let [x, y, z] = splat.mean_in_cam.into();
    let v_covariance_px = -(splat.conic * v.conic * splat.conic);
    let v_covariance_in_cam = splat.jacobian.transpose() * v_covariance_px * splat.jacobian;
    let v_j = 2.0 * v_covariance_px * splat.jacobian * splat.covariance_in_cam;

    // The centre: fx x/z + cx, fy y/z + cy.
    let mut v_mean = Vector3::new(
        fx / z * v.centre_px.x,
        fy / z * v.centre_px.y,
        -(fx * x * v.centre_px.x + fy * y * v.centre_px.y) / (z * z),
    );
    // The Jacobian: fx/z, fy/z, -fx slope_x/z, -fy slope_y/z.
    v_mean.z += -(fx * v_j.m11 + fy * v_j.m22) / (z * z);
    v_mean.z += (fx * splat.slope.x * v_j.m13 + fy * splat.slope.y * v_j.m23) / (z * z);
    let v_slope = [-fx / z * v_j.m13, -fy / z * v_j.m23];
    for axis in 0..2 {
        if !splat.is_clamped[axis] {
            v_mean[axis] += v_slope[axis] / z;
            v_mean.z -= v_slope[axis] * splat.slope[axis] / z;
        }
    }
    v_mean.z += v.z;
    (v_mean, v_covariance_in_cam)
}

/// The centre's offset from the principal point and the Jacobian are as the focal length; a held slope is as its
/// inverse.
fn through_focal(camera: &Camera, splat: &Projected, v: &ProjectedGradient) -> f64 {
    let k = &camera.intrinsics;
    let v_covariance_px = -(splat.conic * v.conic * splat.conic);
    let v_j = 2.0 * v_covariance_px * splat.jacobian * splat.covariance_in_cam;
    let mut v_log = v.centre_px.x * (splat.centre_px.x - k.cx)
        + v.centre_px.y * (splat.centre_px.y - k.cy)
        + v_j.component_mul(&splat.jacobian).sum();
    let [focal_x, focal_y] = [k.fx, k.fy].map(|focal| focal / splat.mean_in_cam.z);
    let v_slope = Vector2::new(-focal_x * v_j.m13, -focal_y * v_j.m23);
    for axis in 0..2 {
        if splat.is_clamped[axis] {
            v_log -= v_slope[axis] * splat.slope[axis];
        }
    }
    v_log
}

/// To the coefficients, and through the viewing direction to the mean relative to the camera centre.
fn through_colour(
    params: &Params,
    splat: &Projected,
    v: &ProjectedGradient,
    sh_degree: u8,
    v_sh: &mut [f64],
) -> Vector3<f64> {
    let mut v_colour = v.colour;
    for channel in 0..3 {
        if splat.is_dark[channel] {
            v_colour[channel] = 0.0;
        }
    }
    let n_active = (usize::from(sh_degree.min(params.sh_degree)) + 1).pow(2);
    let start = splat.splat_ix * params.sh_stride();
    let direction = splat.direction_in_world;
    let (values, slopes) = (sh_basis(direction), sh_basis_slopes(direction));
    let mut v_direction = Vector3::zeros();
    for b in 0..n_active {
        let range = start + 3 * b..start + 3 * b + 3;
        let coefficient = Vector3::from_column_slice(&params.sh[range.clone()]);
        v_direction += slopes[b] * coefficient.dot(&v_colour);
        for (channel, target) in v_sh[range].iter_mut().enumerate() {
            *target += values[b] * v_colour[channel];
        }
    }
    // Normalisation lets only the part across the direction through.
    (v_direction - direction * direction.dot(&v_direction)) / splat.distance
}

/// Derivatives of `sh_basis`, its formulas taken as polynomials in x, y, z.
fn sh_basis_slopes(d: Vector3<f64>) -> [Vector3<f64>; 16] {
    let (x, y, z) = (d.x, d.y, d.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        Vector3::zeros(),
        SH[1] * Vector3::new(0.0, -1.0, 0.0),
        SH[1] * Vector3::new(0.0, 0.0, 1.0),
        SH[1] * Vector3::new(-1.0, 0.0, 0.0),
        SH[2] * Vector3::new(y, x, 0.0),
        SH[2] * Vector3::new(0.0, -z, -y),
        SH[3] * Vector3::new(-2.0 * x, -2.0 * y, 4.0 * z),
        SH[2] * Vector3::new(-z, 0.0, -x),
        SH[2] * Vector3::new(x, -y, 0.0),
        SH[4] * Vector3::new(-6.0 * x * y, 3.0 * (yy - xx), 0.0),
        SH[5] * Vector3::new(y * z, x * z, x * y),
        SH[6] * Vector3::new(2.0 * x * y, xx + 3.0 * yy - 4.0 * zz, -8.0 * y * z),
        SH[7] * Vector3::new(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy),
        SH[6] * Vector3::new(3.0 * xx + yy - 4.0 * zz, 2.0 * x * y, -8.0 * x * z),
        SH[5] * Vector3::new(x * z, -y * z, 0.5 * (xx - yy)),
        SH[4] * Vector3::new(3.0 * (yy - xx), 6.0 * x * y, 0.0),
    ]
}

/// covariance = M M', M = Rot(q) diag(s): to log-scales and the raw quaternion.
fn through_covariance(
    params: &Params,
    ix: usize,
    v_covariance: &Matrix3<f64>,
) -> ([f64; 3], [f64; 4]) {
    let rot = rotation(params.quats[ix]);
    let scale = Vector3::from(params.log_scales[ix]).map(f64::exp);
    let v_m = 2.0 * v_covariance * rot * Matrix3::from_diagonal(&scale);
    let v_log_scale = Vector3::from_fn(|k, _| scale[k] * rot.column(k).dot(&v_m.column(k)));
    let v_rot = v_m * Matrix3::from_diagonal(&scale);
    (
        v_log_scale.into(),
        through_rotation(params.quats[ix], &v_rot),
    )
}

/// Rot(q / |q|): to q, as w, x, y, z. The zero quaternion gets none.
fn through_rotation(quat: [f64; 4], g: &Matrix3<f64>) -> [f64; 4] {
    let length = Vector4::from(quat).norm();
    if length == 0.0 {
        return [0.0; 4];
    }
    let unit = Vector4::from(quat) / length;
    let [w, x, y, z] = unit.into();
    let v_unit = 2.0
        * Vector4::new(
            x * (g.m32 - g.m23) + y * (g.m13 - g.m31) + z * (g.m21 - g.m12),
            -2.0 * x * (g.m22 + g.m33)
                + y * (g.m21 + g.m12)
                + z * (g.m31 + g.m13)
                + w * (g.m32 - g.m23),
            x * (g.m21 + g.m12) - 2.0 * y * (g.m11 + g.m33)
                + z * (g.m32 + g.m23)
                + w * (g.m13 - g.m31),
            x * (g.m31 + g.m13) + y * (g.m32 + g.m23) - 2.0 * z * (g.m11 + g.m22)
                + w * (g.m21 - g.m12),
        );
    ((v_unit - unit * unit.dot(&v_unit)) / length).into()
}
