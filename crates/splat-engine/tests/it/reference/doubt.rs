//! How far an honest f32 rendering may be off, pixel by pixel.
//!
//! Most pixels follow from smooth arithmetic and differ by rounding only. Some do not: alpha within rounding of 1/255,
//! a ray that all but ends, two splats at all but one depth, a needle whose 2D covariance f32 cannot invert. There the
//! reference implementation says by how much the pixel changes if it is decided the other way, and a comparison allows that much, there only.

use nalgebra::{Matrix3, Vector2, Vector3, Vector5};

use super::project::{LIMITS, Limits, MIN_OPACITY, NEAR, Projected, project_within};
use super::raster::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, pixel_centre, raw_alpha};
use super::{Camera, Params, bin};

/// Half the distance of neighbouring f32 near 1.
const ROUNDING: f64 = 6e-8;
/// Relative error granted to a backend's exp and sigmoid.
const EXP_ERROR: f64 = 1e-5;

#[derive(Debug, Clone, Copy, Default)]
pub struct Doubt {
    pub rgb: [f64; 3],
    pub alpha: f64,
    /// Relative.
    pub depth: f64,
}

/// A splat that is drawn, or might be in f32.
struct Candidate {
    splat: Projected,
    mean_in_world: [f64; 3],
    is_drawn: bool,
    /// Rounding may decide otherwise.
    is_doubtful: bool,
    depth_error: f64,
    centre_error_px: Vector2<f64>,
    /// Norm of the error of the 2D covariance, px^2.
    covariance_error: f64,
    /// Relative, of the determinant taken as a difference of products.
    determinant_error: f64,
}

/// One candidate at one pixel.
struct Part {
    ix: usize,
    alpha: f64,
    transmittance: f64,
    is_drawn: bool,
    alpha_error: f64,
}

/// One per pixel.
pub fn doubt(params: &Params, camera: &Camera, sh_degree: u8) -> Vec<Doubt> {
    let candidates = candidates(params, camera, sh_degree);
    let (width, height) = (
        camera.intrinsics.width_px as usize,
        camera.intrinsics.height_px as usize,
    );
    (0..width * height)
        .map(|pixel| {
            pixel_doubt(
                &candidates,
                camera,
                pixel_centre(pixel % width, pixel / width),
            )
        })
        .collect()
}

/// Near to far.
fn candidates(params: &Params, camera: &Camera, sh_degree: u8) -> Vec<Candidate> {
    let widest = (0..params.means.len())
        .map(|ix| mean_error(params, camera, ix).z)
        .filter(|error| error.is_finite())
        .fold(0.0, f64::max);
    let limits = Limits {
        near: (NEAR - widest).max(1e-6),
        min_opacity: MIN_OPACITY * (1.0 - EXP_ERROR),
    };
    let projected = project_within(params, camera, sh_degree, limits);
    let order = bin::order(&projected);
    let candidates = order
        .into_iter()
        .map(|ix| candidate(params, camera, projected[ix].clone()));
    candidates
        .filter(|candidate| candidate.is_drawn || candidate.is_doubtful)
        .collect()
}

fn candidate(params: &Params, camera: &Camera, splat: Projected) -> Candidate {
    let mean_error = mean_error(params, camera, splat.splat_ix);
    let (z, k) = (splat.mean_in_cam.z, &camera.intrinsics);
    let centre_error_px = Vector2::from_fn(|axis, _| {
        let (focal, centre) = [(k.fx, k.cx), (k.fy, k.cy)][axis];
        let slope = (splat.mean_in_cam[axis] / z).abs();
        focal / z * (mean_error[axis] + slope * mean_error.z)
            + 4.0 * ROUNDING * (focal * slope + centre.abs())
    });
    // Relative errors of the Jacobian and of exp(log_scale) come in squared.
    let log_scales = params.log_scales[splat.splat_ix].into_iter();
    let largest_log_scale = log_scales
        .filter(|log_scale| log_scale.is_finite())
        .map(f64::abs)
        .fold(0.0, f64::max);
    let relative = ROUNDING * (4.0 + largest_log_scale) + 2.0 * mean_error.norm() / z;
    let covariance_error =
        relative * splat.jacobian.norm_squared() * splat.covariance_in_cam.trace();
    let covariance = &splat.covariance_px;
    let determinant_error =
        2.0 * ROUNDING * covariance.m11 * covariance.m22 / covariance.determinant();
    let is_near_limit = (z - LIMITS.near).abs() <= mean_error.z
        || (splat.opacity / LIMITS.min_opacity - 1.0).abs() <= EXP_ERROR;
    Candidate {
        mean_in_world: params.means[splat.splat_ix],
        is_drawn: z > LIMITS.near && splat.opacity >= LIMITS.min_opacity,
        is_doubtful: is_near_limit,
        depth_error: mean_error.z,
        centre_error_px,
        covariance_error,
        determinant_error,
        splat,
    }
}

/// Of the mean in the camera frame: roundings of its terms add like noise.
fn mean_error(params: &Params, camera: &Camera, ix: usize) -> Vector3<f64> {
    if camera.rotation == Matrix3::identity() && camera.translation == Vector3::zeros() {
        return Vector3::zeros();
    }
    let mean = Vector3::from(params.means[ix]);
    let squares = camera.rotation.component_mul(&camera.rotation) * mean.component_mul(&mean);
    2.0 * ROUNDING
        * (squares + camera.translation.component_mul(&camera.translation)).map(f64::sqrt)
}

fn pixel_doubt(candidates: &[Candidate], camera: &Camera, pixel: Vector2<f64>) -> Doubt {
    let (parts, mut doubt) = walk(candidates, pixel);
    let light = |part: &Part| {
        let splat = &candidates[part.ix].splat;
        Vector5::new(
            splat.colour.x,
            splat.colour.y,
            splat.colour.z,
            1.0,
            splat.mean_in_cam.z,
        )
    };
    let mut behind = Vector5::zeros();
    for (at, part) in parts.iter().enumerate().rev() {
        let dimming = if part.is_drawn {
            1.0 / (1.0 - part.alpha)
        } else {
            1.0
        };
        let gain = part.transmittance * light(part) - dimming * behind;
        doubt += gain.abs() * part.alpha_error;
        for other in &parts[at + 1..] {
            let (near, far) = (&candidates[part.ix], &candidates[other.ix]);
            if far.splat.mean_in_cam.z - near.splat.mean_in_cam.z
                > near.depth_error + far.depth_error
            {
                break;
            }
            if may_swap(near, far, camera) {
                let weight = part.alpha * other.alpha * part.transmittance;
                doubt += weight * (light(part) - light(other)).abs();
            }
        }
        if part.is_drawn {
            behind += part.alpha * part.transmittance * light(part);
        }
    }
    let relative = |error: f64, value: f64| if value > 0.0 { error / value } else { 0.0 };
    Doubt {
        rgb: [doubt[0], doubt[1], doubt[2]],
        alpha: doubt[3],
        depth: relative(doubt[4], behind[4]) + relative(doubt[3], behind[3]),
    }
}

/// Front to back, with the doubt about where the ray ends.
fn walk(candidates: &[Candidate], pixel: Vector2<f64>) -> (Vec<Part>, Vector5<f64>) {
    let (mut parts, mut doubt) = (Vec::new(), Vector5::zeros());
    let (mut transmittance, mut transmittance_error) = (1.0, 0.0);
    for (ix, candidate) in candidates.iter().enumerate() {
        let raw = raw_alpha(&candidate.splat, pixel);
        let error = EXP_ERROR + sigma_error(candidate, pixel);
        let alpha = raw.min(MAX_ALPHA);
        // Doubt that exceeds what there is (a needle beyond f32) is cut off at: anything from nothing to all.
        let reaches_minimum = alpha * (1.0 + error) >= MIN_ALPHA;
        let is_undecided =
            candidate.is_doubtful || (alpha * (1.0 - error) < MIN_ALPHA && reaches_minimum);
        let is_drawn = candidate.is_drawn && alpha >= MIN_ALPHA;
        if !is_drawn && !is_undecided {
            continue;
        }
        let is_saturated = raw * (1.0 - error) > MAX_ALPHA;
        let rounding = if is_saturated {
            2.0 * ROUNDING
        } else {
            alpha * error
        };
        let alpha_error = if is_undecided {
            alpha.max(rounding)
        } else {
            rounding
        }
        .min(1.0);
        if is_drawn {
            transmittance_error += alpha_error / (1.0 - alpha) + ROUNDING;
            let left = transmittance * (1.0 - alpha);
            if (left / MIN_TRANSMITTANCE - 1.0).abs() <= transmittance_error + 1e-5 {
                doubt += transmittance * brightest(candidates);
            }
            if left <= MIN_TRANSMITTANCE {
                break;
            }
        }
        parts.push(Part {
            ix,
            alpha,
            transmittance,
            is_drawn,
            alpha_error,
        });
        if is_drawn {
            transmittance *= 1.0 - alpha;
        }
    }
    (parts, doubt)
}

/// sigma = d' Q d / 2: a moved centre, a wrong covariance (dQ = -Q dS Q) and rounding of the sum itself.
fn sigma_error(candidate: &Candidate, pixel: Vector2<f64>) -> f64 {
    let (splat, conic) = (&candidate.splat, &candidate.splat.conic);
    let d = splat.centre_px - pixel;
    let slope = conic * d;
    let products =
        (conic.m11 * d.x * d.x + conic.m22 * d.y * d.y) / 2.0 + (conic.m12 * d.x * d.y).abs();
    slope.abs().dot(&candidate.centre_error_px)
        + 0.5 * slope.norm_squared() * candidate.covariance_error
        + 0.5 * d.dot(&slope) * candidate.determinant_error
        + 2.0 * ROUNDING * products
}

fn brightest(candidates: &[Candidate]) -> Vector5<f64> {
    let colour = candidates
        .iter()
        .fold(Vector3::zeros(), |max: Vector3<f64>, c| {
            max.sup(&c.splat.colour)
        });
    let depth = candidates
        .last()
        .map_or(0.0, |candidate| candidate.splat.mean_in_cam.z);
    Vector5::new(colour.x, colour.y, colour.z, 1.0, depth)
}

/// Equal means give equal depths in any arithmetic, and an unturned camera adds without rounding differences.
fn may_swap(near: &Candidate, far: &Candidate, camera: &Camera) -> bool {
    near.mean_in_world != far.mean_in_world && camera.rotation != Matrix3::identity()
}
