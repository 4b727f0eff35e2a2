//! Central differences of the reference's loss by every parameter: what its gradients are held against.

use std::hash::{DefaultHasher, Hash, Hasher};

use glam::DVec3;

use super::random::Scene;
use super::{Camera, Gradients, Params, Target, Weights, bin, gradients, project};
use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

/// Truncation error is about STEP^2 times the third derivative over six, some 1e-8 of the gradient for splats
/// wider than a pixel; rounding is 1e-16 / STEP.
const STEP: f64 = 1e-5;
const MAX_RELATIVE: f64 = 1e-5;
/// Numbers far below the largest of their array are held against this share of it.
const FLOOR: f64 = 1e-3;
/// Share of parameters whose difference may span a jump and is then no derivative. Depth that is stretched over all pixels jumps
/// wherever the edge of a splat takes in a pixel.
const MAX_SKIPPED: f64 = 0.1;

pub const ARRAYS: [&str; 8] = [
    "means",
    "log_scales",
    "quats",
    "opacity_logits",
    "sh",
    "pose",
    "exposure",
    "log_focal",
];

/// Where the loss is taken.
#[derive(Clone)]
pub struct Point {
    pub params: Params,
    pub cam_from_world: Rigid,
    /// Log gain and offset of r, g, b.
    pub exposure: [[f64; 3]; 2],
    pub log_focal: f64,
}

pub struct Problem {
    pub point: Point,
    pub scene: Scene,
    target: Target,
    weights: Weights,
    sh_degree: u8,
}

impl Problem {
    pub fn new(scene: Scene, weights: Weights, sh_degree: u8) -> Self {
        let point = Point {
            params: Params::from(&scene.splats),
            cam_from_world: scene.view.cam_from_world,
            exposure: [[0.0; 3]; 2],
            log_focal: 0.0,
        };
        let target = Target::new(&scene.view);
        Self {
            point,
            scene,
            target,
            weights,
            sh_degree,
        }
    }

    pub fn camera(&self, point: &Point) -> Camera {
        let factor = point.log_focal.exp();
        let intrinsics = Intrinsics {
            fx: factor * self.scene.view.intrinsics.fx,
            fy: factor * self.scene.view.intrinsics.fy,
            ..self.scene.view.intrinsics
        };
        Camera::new(&intrinsics, &point.cam_from_world)
    }

    pub fn gradients(&self, point: &Point) -> Gradients {
        let target = Target {
            exposure: point.exposure,
            ..self.target.clone()
        };
        gradients(
            &point.params,
            &self.camera(point),
            &target,
            &self.weights,
            self.sh_degree,
        )
    }

    /// Everything that is decided and not computed. Between two points with equal decisions the loss is smooth.
    fn decisions(&self, point: &Point, result: &Gradients) -> u64 {
        let projected = project::project(&point.params, &self.camera(point), self.sh_degree);
        let mut hasher = DefaultHasher::new();
        bin::order(&projected).hash(&mut hasher);
        for splat in &projected {
            (splat.splat_ix, splat.is_clamped, splat.is_dark).hash(&mut hasher);
        }
        for hit in result.raster.hits.iter().flatten() {
            (hit.ix, hit.is_saturated).hash(&mut hasher);
        }
        let depth = &result.loss.depth_decisions;
        (&depth.branches, depth.ends).hash(&mut hasher);
        let [gain, offset] = point.exposure;
        for (at, (rendered, wanted)) in result.raster.rgb.iter().zip(&self.target.rgb).enumerate() {
            (gain[at % 3].exp() * rendered + offset[at % 3] > *wanted).hash(&mut hasher);
        }
        hasher.finish()
    }

    /// Largest error of each array of `claimed`, relative, or what is wrong.
    pub fn check(&self, claimed: &Gradients) -> Result<[f64; 8], String> {
        let base = self.decisions(&self.point, &self.gradients(&self.point));
        let (mut n_skipped, mut n_all) = (0, 0);
        let mut worst = [0.0; 8];
        for (array_ix, array) in ARRAYS.into_iter().enumerate() {
            let claimed = flat(claimed, array_ix);
            let numeric: Vec<Option<f64>> = (0..claimed.len())
                .map(|k| {
                    let [low, high] = [-STEP, STEP].map(|h| self.point.moved(array_ix, k, h));
                    let [at_low, at_high] = [&low, &high].map(|point| self.gradients(point));
                    let is_smooth = self.decisions(&low, &at_low) == base
                        && self.decisions(&high, &at_high) == base;
                    is_smooth.then(|| (at_high.loss.total - at_low.loss.total) / (2.0 * STEP))
                })
                .collect();
            n_all += numeric.len();
            n_skipped += numeric.iter().filter(|n| n.is_none()).count();
            let largest = numeric
                .iter()
                .flatten()
                .fold(0.0, |max: f64, n| max.max(n.abs()));
            for (k, (claim, numeric)) in claimed.iter().zip(&numeric).enumerate() {
                let Some(numeric) = numeric else { continue };
                // Rounding of a loss near 1 moves a difference by some 1e-11.
                let error = (claim - numeric).abs() / numeric.abs().max(FLOOR * largest).max(5e-6);
                if error.is_nan() || error > MAX_RELATIVE {
                    return Err(format!(
                        "{array}[{k}]: claimed {claim:e}, differences say {numeric:e}"
                    ));
                }
                worst[array_ix] = error.max(worst[array_ix]);
            }
        }
        if n_skipped as f64 > MAX_SKIPPED * n_all as f64 {
            return Err(format!("{n_skipped} of {n_all} differences span a jump"));
        }
        Ok(worst)
    }
}

impl Point {
    fn moved(&self, array_ix: usize, k: usize, by: f64) -> Self {
        let mut moved = self.clone();
        match ARRAYS[array_ix] {
            "means" => moved.params.means[k / 3][k % 3] += by,
            "log_scales" => moved.params.log_scales[k / 3][k % 3] += by,
            "quats" => moved.params.quats[k / 4][k % 4] += by,
            "opacity_logits" => moved.params.opacity_logits[k] += by,
            "sh" => moved.params.sh[k] += by,
            "exposure" => moved.exposure[k / 3][k % 3] += by,
            "log_focal" => moved.log_focal += by,
            _ => {
                let mut delta = [0.0; 6];
                delta[k] = by;
                let [rho, theta] = [&delta[..3], &delta[3..]].map(DVec3::from_slice);
                moved.cam_from_world = Rigid::exp(rho, theta) * self.cam_from_world;
            }
        }
        moved
    }
}

pub fn flat(gradients: &Gradients, array_ix: usize) -> Vec<f64> {
    match ARRAYS[array_ix] {
        "means" => gradients.splats.means.concat(),
        "log_scales" => gradients.splats.log_scales.concat(),
        "quats" => gradients.splats.quats.concat(),
        "opacity_logits" => gradients.splats.opacity_logits.clone(),
        "sh" => gradients.splats.sh.clone(),
        "exposure" => gradients.exposure.concat(),
        "log_focal" => vec![gradients.log_focal],
        _ => gradients.pose.to_vec(),
    }
}
