//! Splats and a camera -> 2D Gaussians with opacity, colour and depth. docs/GRADIENTS.md 2.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Quaternion, UnitQuaternion, Vector2, Vector3};

use super::{Camera, Params};

pub const NEAR: f64 = 0.01;
/// Variance in px^2 added to each 2D Gaussian, so that none falls between pixel centres.
pub const BLUR: f64 = 0.3;
pub const MIN_OPACITY: f64 = 1.0 / 255.0;
/// A colour beyond this is a broken splat; squared it would take a whole image's SSIM with it.
const MAX_COLOUR: f64 = 1e4;

#[derive(Debug, Clone)]
pub struct Projected {
    pub splat_ix: usize,
    pub mean_in_cam: Vector3<f64>,
    pub centre_px: Vector2<f64>,
    /// With the blur.
    pub covariance_px: Matrix2<f64>,
    /// Inverse of `covariance_px`.
    pub conic: Matrix2<f64>,
    pub opacity: f64,
    pub colour: Vector3<f64>,
    /// Half sides of the box outside of which alpha is below `MIN_OPACITY`.
    pub radius_px: Vector2<f64>,
    pub covariance_in_cam: Matrix3<f64>,
    pub jacobian: Matrix2x3<f64>,
    /// x / z and y / z as they stand in the Jacobian.
    pub slope: Vector2<f64>,
    /// The slope was held at the limit, so it does not follow the mean.
    pub is_clamped: [bool; 2],
    /// From the camera centre, unit, in the map frame.
    pub direction_in_world: Vector3<f64>,
    pub distance: f64,
    /// Channel below 0 before it was cut.
    pub is_dark: [bool; 3],
}

/// Splats nearer or fainter than this are not drawn.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    pub near: f64,
    pub min_opacity: f64,
}

pub const LIMITS: Limits = Limits {
    near: NEAR,
    min_opacity: MIN_OPACITY,
};

/// What is drawn, in the order of splats.
pub fn project(params: &Params, camera: &Camera, sh_degree: u8) -> Vec<Projected> {
    project_within(params, camera, sh_degree, LIMITS)
}

pub fn project_within(
    params: &Params,
    camera: &Camera,
    sh_degree: u8,
    limits: Limits,
) -> Vec<Projected> {
    (0..params.means.len())
        .filter_map(|splat_ix| project_one(params, splat_ix, camera, sh_degree, limits))
        .collect()
}

fn project_one(
    params: &Params,
    splat_ix: usize,
    camera: &Camera,
    sh_degree: u8,
    limits: Limits,
) -> Option<Projected> {
    let mean = Vector3::from(params.means[splat_ix]);
    let log_scale = Vector3::from(params.log_scales[splat_ix]);
    let quat = params.quats[splat_ix];
    let logit = params.opacity_logits[splat_ix];
    let stride = params.sh_stride();
    let n_active = 3 * (usize::from(sh_degree.min(params.sh_degree)) + 1).pow(2);
    let sh = &params.sh[splat_ix * stride..splat_ix * stride + n_active];
    let (scale, opacity) = (log_scale.map(f64::exp), sigmoid(logit));
    // After activation: an infinite logit is an opacity of 0 or 1, a log-scale of minus infinity is a point.
    let numbers = mean.iter().chain(&scale).chain(&quat).chain(sh);
    if opacity.is_nan()
        || !numbers
            .copied()
            .all(|number| number.abs() <= f64::from(f32::MAX))
    {
        return None;
    }

    let mean_in_cam = camera.rotation * mean + camera.translation;
    if mean_in_cam.z <= limits.near || opacity < limits.min_opacity {
        return None;
    }

    let half = rotation(quat) * Matrix3::from_diagonal(&scale);
    let covariance_in_cam = camera.rotation * half * half.transpose() * camera.rotation.transpose();
    let (slope, is_clamped) = limited_slope(camera, mean_in_cam);
    let jacobian = jacobian(camera, mean_in_cam.z, slope);
    let covariance_px =
        jacobian * covariance_in_cam * jacobian.transpose() + Matrix2::identity() * BLUR;
    let conic = covariance_px.try_inverse()?;
    // Beyond f32 no backend can follow, and such a splat covers everything with nothing to learn.
    let fits_f32 = |value: f64| value.abs() < f64::from(f32::MAX);
    if !covariance_px.iter().copied().all(fits_f32) || !fits_f32(covariance_px.determinant()) {
        return None;
    }

    let k = &camera.intrinsics;
    let centre_px = Vector2::new(
        k.fx * mean_in_cam.x / mean_in_cam.z + k.cx,
        k.fy * mean_in_cam.y / mean_in_cam.z + k.cy,
    );
    let radius_px = radius_px(opacity, &covariance_px);
    if !touches_image(centre_px, radius_px, [k.width_px, k.height_px]) {
        return None;
    }

    let from_centre = mean - camera_centre(camera);
    let distance = from_centre.norm();
    let direction_in_world = from_centre / distance;
    let raw = colour(sh, direction_in_world);
    if raw.amax() >= MAX_COLOUR {
        return None;
    }
    Some(Projected {
        splat_ix,
        mean_in_cam,
        centre_px,
        covariance_px,
        conic,
        opacity,
        colour: raw.map(|c| c.max(0.0)),
        radius_px,
        covariance_in_cam,
        jacobian,
        slope,
        is_clamped,
        direction_in_world,
        distance,
        is_dark: [raw.x < 0.0, raw.y < 0.0, raw.z < 0.0],
    })
}

pub fn sigmoid(logit: f64) -> f64 {
    1.0 / (1.0 + (-logit).exp())
}

/// The zero quaternion stands for no rotation.
pub fn rotation(quat: [f64; 4]) -> Matrix3<f64> {
    let [w, x, y, z] = quat;
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 0.0)
        .map_or_else(Matrix3::identity, |unit| {
            unit.to_rotation_matrix().into_inner()
        })
}

pub fn camera_centre(camera: &Camera) -> Vector3<f64> {
    -(camera.rotation.transpose() * camera.translation)
}

/// Far outside the image the linearisation explodes (EWA): 30 % of half the image beyond its edge the slope stops.
fn limited_slope(camera: &Camera, p: Vector3<f64>) -> (Vector2<f64>, [bool; 2]) {
    let k = &camera.intrinsics;
    let limit = |value: f64, focal: f64, centre: f64, side: f64| {
        let margin = 0.3 * 0.5 * side / focal;
        let (low, high) = (-(centre / focal + margin), (side - centre) / focal + margin);
        // Not f64::clamp: a principal point far outside the image may cross the limits.
        let limited = value.max(low).min(high);
        (limited, limited != value)
    };
    let (x, x_clamped) = limit(p.x / p.z, k.fx, k.cx, f64::from(k.width_px));
    let (y, y_clamped) = limit(p.y / p.z, k.fy, k.cy, f64::from(k.height_px));
    (Vector2::new(x, y), [x_clamped, y_clamped])
}

/// Derivative of the pixel with respect to the point in the camera frame, at (slope z, z).
fn jacobian(camera: &Camera, z: f64, slope: Vector2<f64>) -> Matrix2x3<f64> {
    let (fx, fy) = (camera.intrinsics.fx, camera.intrinsics.fy);
    Matrix2x3::new(
        fx / z,
        0.0,
        -fx * slope.x / z, //
        0.0,
        fy / z,
        -fy * slope.y / z,
    )
}

/// Where `opacity exp(-d^2 / 2)` falls to `MIN_OPACITY`, in standard deviations, then in whole pixels.
fn radius_px(opacity: f64, covariance_px: &Matrix2<f64>) -> Vector2<f64> {
    let extent = (2.0 * (opacity / MIN_OPACITY).ln())
        .max(0.0)
        .sqrt()
        .min(3.33);
    Vector2::new(covariance_px.m11, covariance_px.m22)
        .map(|variance| (extent * variance.sqrt()).ceil())
}

fn touches_image(centre: Vector2<f64>, radius: Vector2<f64>, size_px: [u32; 2]) -> bool {
    (0..2).all(|axis| {
        centre[axis] + radius[axis] > 0.0 && centre[axis] - radius[axis] < f64::from(size_px[axis])
    })
}

/// Before the cut at 0. `sh` holds the active bands only.
pub fn colour(sh: &[f64], direction: Vector3<f64>) -> Vector3<f64> {
    let mut colour = Vector3::repeat(0.5);
    for (coefficient, value) in sh.chunks_exact(3).zip(sh_basis(direction)) {
        colour += Vector3::from_column_slice(coefficient) * value;
    }
    colour
}

/// Real spherical harmonics of degree 0 to 3 with the signs of 3DGS (Condon-Shortley phase).
pub fn sh_basis(d: Vector3<f64>) -> [f64; 16] {
    let (x, y, z) = (d.x, d.y, d.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        SH[0],
        -SH[1] * y,
        SH[1] * z,
        -SH[1] * x,
        SH[2] * x * y,
        -SH[2] * y * z,
        SH[3] * (2.0 * zz - xx - yy),
        -SH[2] * x * z,
        0.5 * SH[2] * (xx - yy),
        -SH[4] * y * (3.0 * xx - yy),
        SH[5] * x * y * z,
        -SH[6] * y * (4.0 * zz - xx - yy),
        SH[7] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -SH[6] * x * (4.0 * zz - xx - yy),
        0.5 * SH[5] * z * (xx - yy),
        -SH[4] * x * (xx - 3.0 * yy),
    ]
}

/// Square roots of 1/(4 pi), 3/(4 pi), 15/(4 pi), 5/(16 pi), 35/(32 pi), 105/(4 pi), 21/(32 pi), 7/(16 pi).
pub const SH: [f64; 8] = [
    0.282_094_791_773_878_14,
    0.488_602_511_902_919_9,
    1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
];
