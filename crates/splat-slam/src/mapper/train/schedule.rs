//! Which view the next step trains on, and with which rates; decides nothing else.

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::mapper::params::{DepthLoss, MapperParams, PoseOptimization};
use splat_engine::settings::{DepthMode, PoseMode, StepSettings};

/// Share of the steps between arrivals that train on the newest views.
const NEWEST_SHARE: f64 = 0.5;
/// Views that count as newest: about one batch.
const N_NEWEST: usize = 8;
/// Rates at the last step, as a share of those at the first.
const FINAL_MEAN_RATE: f32 = 0.01;
const FINAL_POSE_RATE: f32 = 0.03;
const FINAL_DEPTH_WEIGHT: f32 = 0.1;
/// Between arrivals poses move slowly: splats that have just been seeded would pull them about.
const STREAMING_POSE_RATE: f32 = 0.2;
/// First pose rate as a share of the standard deviation that the model states: a few steps of a view cover it.
const RATE_OF_ERROR: f32 = 0.5;
/// Bands above the base colour wait until the geometry has converged (3DGS trains them late).
const SH_START: f32 = 0.3;
/// Rate of the SH bands above the base, as a share of the base rate (3DGS).
const SH_REST_RATE: f32 = 1.0 / 20.0;

/// Draws the view of each step.
#[derive(Debug)]
pub struct Schedule {
    rng: Pcg64Mcg,
    /// Rest of the shuffled round through all views.
    round: Vec<usize>,
}

/// Where the run stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Phase {
    /// Keyframes may still come.
    Streaming,
    /// All keyframes are there; the share of the final steps that is done, 0 to 1.
    Final(f32),
}

impl Schedule {
    pub fn new(seed: u64) -> Self {
        Self {
            rng: Pcg64Mcg::seed_from_u64(seed ^ 0x5eed_0001),
            round: Vec::new(),
        }
    }

    /// One of `trainable`, which is in order of arrival; `None` when it is empty.
    pub fn next_view(&mut self, trainable: &[usize], phase: Phase) -> Option<usize> {
        let newest = trainable.len().saturating_sub(N_NEWEST);
        if phase == Phase::Streaming && newest > 0 && self.rng.random_bool(NEWEST_SHARE) {
            return Some(trainable[self.rng.random_range(newest..trainable.len())]);
        }
        if self.round.is_empty() {
            self.round = trainable.to_vec();
            self.round.shuffle(&mut self.rng);
        }
        self.round.pop()
    }

    /// Views were removed: the round may name some that are gone.
    pub fn restart_round(&mut self) {
        self.round.clear();
    }
}

/// Steps of the whole run that should be done when this share of the input has come.
pub fn due(params: &MapperParams, progress: f64) -> u64 {
    (params.train.steps as f64 * (1.0 - params.train.final_share) * progress.clamp(0.0, 1.0)) as u64
}

/// Numbers of one step. `scene_depth` is the median depth of the views in map units: lengths scale with it.
/// `pose_error` is what the model says that poses may be off by, in radians and map units: the farther, the faster.
pub fn settings(
    params: &MapperParams,
    scene_depth: f32,
    pose_error: [f32; 2],
    phase: Phase,
) -> StepSettings {
    let raised = |rate: f32, error: f32| {
        if rate > 0.0 {
            rate.max(RATE_OF_ERROR * error)
        } else {
            0.0
        }
    };
    let done = match phase {
        Phase::Streaming => 0.0,
        Phase::Final(share) => share.clamp(0.0, 1.0),
    };
    let decayed = |rate: f32, last: f32| rate * last.powf(done);
    let pose_share = if phase == Phase::Streaming {
        STREAMING_POSE_RATE
    } else {
        1.0
    };
    // A splat's own age says when its bands start; else all wait together.
    let sh_is_on = params.train.sh_interval > 0 || (phase != Phase::Streaming && done >= SH_START);
    let lr_mean = decayed(params.train.lr_mean * scene_depth, FINAL_MEAN_RATE);
    let if_mcmc = |value: f32| if params.mcmc.enabled { value } else { 0.0 };
    // Terms that have no say below have the weight of the parameters.
    let mut weights = params.train.weights;
    weights.depth_weight = decayed(weights.depth_weight, FINAL_DEPTH_WEIGHT);
    weights.opacity_reg = if_mcmc(params.mcmc.opacity_reg);
    // A scale is a length: its share of the scene is what has a size.
    weights.scale_reg = if_mcmc(params.mcmc.scale_reg / scene_depth.max(f32::MIN_POSITIVE));
    StepSettings {
        lr_mean,
        lr_scale: params.train.lr_scale,
        lr_quat: params.train.lr_quat,
        lr_opacity: params.train.lr_opacity,
        lr_sh0: params.train.lr_sh,
        lr_sh_rest: params.train.lr_sh * SH_REST_RATE,
        lr_pose_rotation: pose_share
            * decayed(
                raised(params.train.lr_rotation, pose_error[0]),
                FINAL_POSE_RATE,
            ),
        lr_pose_translation: pose_share
            * decayed(
                raised(params.train.lr_translation * scene_depth, pose_error[1]),
                FINAL_POSE_RATE,
            ),
        lr_pose_network: pose_share * decayed(params.train.lr_pose_network, FINAL_POSE_RATE),
        lr_focal: pose_share * decayed(params.train.lr_focal, FINAL_POSE_RATE),
        lr_exposure: params.train.lr_exposure,
        ssim_weight: params.train.ssim_weight,
        weights,
        depth_mode: match params.train.depth_mode {
            DepthLoss::InvDepth => DepthMode::InverseDepth,
            DepthLoss::PaperCode => DepthMode::PaperCode,
            DepthLoss::PaperAlpha => DepthMode::PaperAlpha,
        },
        epipolar_weight: params.train.epipolar_weight,
        noise: if_mcmc(lr_mean * params.mcmc.noise),
        sh_degree: if sh_is_on { params.train.sh_degree } else { 0 },
        sh_interval: params.train.sh_interval,
        train_splats: true,
        pose: pose_step(params),
        ..StepSettings::default()
    }
}

fn pose_step(params: &MapperParams) -> PoseMode {
    let moves_alone = params.train.lr_rotation > 0.0 || params.train.lr_translation > 0.0;
    match params.train.pose_opt {
        PoseOptimization::PerView if moves_alone => PoseMode::Direct,
        PoseOptimization::Network if moves_alone || params.train.lr_pose_network > 0.0 => {
            PoseMode::Shared
        }
        _ => PoseMode::Held,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_engine::loss_weights::LossWeights;

    #[test]
    fn a_final_round_visits_every_view_once() {
        let mut schedule = Schedule::new(7);
        let views: Vec<usize> = (3..20).collect();
        let mut drawn: Vec<usize> = views
            .iter()
            .filter_map(|_| schedule.next_view(&views, Phase::Final(0.5)))
            .collect();
        drawn.sort_unstable();
        assert_eq!(drawn, views);
        assert_eq!(schedule.next_view(&[], Phase::Final(0.9)), None);
    }

    #[test]
    fn streaming_prefers_the_newest_views() {
        let mut schedule = Schedule::new(7);
        let views: Vec<usize> = (0..80).collect();
        let draws = 1000;
        let newest = (0..draws)
            .filter_map(|_| schedule.next_view(&views, Phase::Streaming))
            .filter(|v| *v >= 72)
            .count();
        // Half by preference, a tenth of the other half by chance.
        assert!((480..620).contains(&newest), "{newest}");
    }

    #[test]
    fn a_weight_of_the_loss_reaches_the_step_without_a_line_of_its_own() {
        let mut params = MapperParams::default();
        params.train.weights = LossWeights::all(2.0);
        let expected = LossWeights {
            opacity_reg: 0.0,
            scale_reg: 0.0,
            ..LossWeights::all(2.0)
        };
        let found = settings(&params, 2.0, [0.0; 2], Phase::Streaming);
        assert_eq!(found.weights, expected, "without mcmc.enabled");
    }

    #[test]
    fn rates_decay_only_after_the_last_keyframe() {
        let params = MapperParams::default();
        let at = |phase| settings(&params, 2.0, [0.0; 2], phase);
        assert_eq!(at(Phase::Streaming).lr_mean, at(Phase::Final(0.0)).lr_mean);
        assert!((at(Phase::Final(1.0)).lr_mean / at(Phase::Streaming).lr_mean - 0.01).abs() < 1e-6);
        assert_eq!(at(Phase::Streaming).sh_degree, 0);
        assert_eq!(at(Phase::Final(1.0)).sh_degree, params.train.sh_degree);
    }
}
