//! Which view the next step trains on, and with which rates; decides nothing else.

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::mapper::params::{
    DepthLoss, MapperParams, PoseOptimization, ShInterval, SsimPadding, TrainParams, ViewOrder,
};
use splat_engine::settings::{DepthMode, PoseMode, StepSettings};

/// Steps that every view gets soon, the newest first: what was seen is to be shown. While some lack them they take so large a
/// share of all steps, and no more: where keyframes come faster than steps, old places must not be forgotten. More of either
/// costs what all other views show (docs/BENCHMARKS.md).
const FIRST_STEPS: u32 = 1;
const FIRST_SHARE: f64 = 0.25;
/// Least share of the rates on a view that was trained often.
const OLD_RATE: f32 = 0.1;
/// Steps on a view after which its holes are filled where no depth was verified: others have shown by then what they know.
const STEPS_BEFORE_FILLING: u32 = 4;
/// Rates at the last step, as a share of those at the first.
const FINAL_MEAN_RATE: f32 = 0.01;
/// First pose rate as a share of the standard deviation that the model states: a few steps of a view cover it.
const RATE_OF_ERROR: f32 = 0.5;
/// Inverse of the golden ratio: the fractional parts of its multiples lie as evenly as those of any number (Kronecker sequence).
const GOLDEN: f64 = 0.618_033_988_749_894_9;

/// Draws the view of each step.
#[derive(Debug)]
pub struct Schedule {
    rng: Pcg64Mcg,
    /// Rest of the round through all views.
    round: Vec<usize>,
    /// Steps on each view of the engine since it was new, or had new depth.
    n_steps: Vec<u32>,
}

/// What is known of the end of the steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum End {
    /// Nothing: keyframes may still come, and the map may be wanted at any moment.
    Unknown,
    /// It comes after the last keyframe, with steps in which rates can fall.
    Ahead,
    /// It comes; the share of the way to it that is done, 0 to 1.
    Nears(f32),
}

impl End {
    pub fn is_near(self) -> bool {
        matches!(self, Self::Nears(_))
    }
}

impl Schedule {
    pub fn new(seed: u64) -> Self {
        Self {
            rng: Pcg64Mcg::seed_from_u64(seed ^ 0x5eed_0001),
            round: Vec::new(),
            n_steps: Vec::new(),
        }
    }

    /// One of `trainable`, which is in order of arrival; `None` when it is empty.
    pub fn next_view(&mut self, trainable: &[usize], order: ViewOrder) -> Option<usize> {
        let view_ix = self.draw(trainable, order)?;
        if self.n_steps.len() <= view_ix {
            self.n_steps.resize(view_ix + 1, 0);
        }
        self.n_steps[view_ix] = self.n_steps[view_ix].saturating_add(1);
        Some(view_ix)
    }

    /// Steps on a view so far.
    pub fn steps_of(&self, view_ix: usize) -> u32 {
        self.n_steps.get(view_ix).copied().unwrap_or(0)
    }

    /// Whether depth that nobody verified may be guessed where a view has a hole.
    pub fn may_fill(&self, view_ix: usize, end: End) -> bool {
        end.is_near() || self.steps_of(view_ix) >= STEPS_BEFORE_FILLING
    }

    /// A view is as good as new: it has depth that it had not.
    pub fn renew(&mut self, view_ix: usize) {
        if let Some(n_steps) = self.n_steps.get_mut(view_ix) {
            *n_steps = 0;
        }
    }

    /// The engine's first `n_views` views are not new, and there are no others.
    pub fn note_trained(&mut self, n_views: usize) {
        self.n_steps = vec![FIRST_STEPS; n_views];
    }

    /// Views were removed: the round may name some that are gone.
    pub fn restart_round(&mut self) {
        self.round.clear();
    }

    fn draw(&mut self, trainable: &[usize], order: ViewOrder) -> Option<usize> {
        let mut newest_first = trainable.iter().rev().copied();
        let lacking = newest_first.find(|v| self.steps_of(*v) < FIRST_STEPS);
        if let Some(new) = lacking.filter(|_| self.rng.random_bool(FIRST_SHARE)) {
            return Some(new);
        }
        if self.round.is_empty() {
            self.round = trainable.to_vec();
            match order {
                ViewOrder::Spread => spread(&mut self.round, self.rng.random()),
                ViewOrder::Shuffled => self.round.shuffle(&mut self.rng),
            }
        }
        self.round.pop()
    }
}

/// Views that come after each other in time show the same place, and several steps in a row on one place take the splats away from
/// what all others show. Sorted by the fractional parts of the multiples of the golden ratio, neighbours in the round are Fibonacci
/// numbers apart. `turn`, 0 to 1, makes each round another one.
fn spread(views: &mut Vec<usize>, turn: f64) {
    let key = |ix: usize| (ix as f64 * GOLDEN + turn).fract();
    let mut keyed: Vec<(f64, usize)> = views
        .iter()
        .enumerate()
        .map(|(ix, v)| (key(ix), *v))
        .collect();
    keyed.sort_by(|a, b| a.0.total_cmp(&b.0));
    views.clear();
    views.extend(keyed.into_iter().map(|(_, view_ix)| view_ix));
}

/// What is known of the end while keyframes come, `has_end`: of a run of `train.steps`.
pub fn end_of_run(params: &MapperParams, has_end: bool) -> End {
    if has_end && params.train.final_share > 0.0 {
        End::Ahead
    } else {
        End::Unknown
    }
}

/// Steps of the whole run that should be done when this share of the input has come.
pub fn due(params: &MapperParams, progress: f64) -> u64 {
    (params.train.steps as f64 * (1.0 - params.train.final_share) * progress.clamp(0.0, 1.0)) as u64
}

/// Numbers of one step. `scene_scale` is a length of the scene in map units: rates of lengths are shares of it.
/// `pose_error` is what the model says that poses may be off by, in radians and map units: the farther, the faster.
/// `n_steps`: on the view so far.
pub fn settings(
    params: &MapperParams,
    scene_scale: f32,
    pose_error: [f32; 2],
    end: End,
    n_steps: u32,
) -> StepSettings {
    let raised = |rate: f32, error: f32| {
        if rate > 0.0 {
            rate.max(RATE_OF_ERROR * error)
        } else {
            0.0
        }
    };
    let done = match end {
        End::Unknown | End::Ahead => 0.0,
        End::Nears(share) => share.clamp(0.0, 1.0),
    };
    let decayed = |rate: f32, last: f32| rate * last.powf(done);
    // A step on a young view must bring much, and one on an old view must not undo what the others say.
    let aged = match params.train.half_rate_steps {
        0 => 1.0,
        half => (1.0 / (1.0 + n_steps as f32 / half as f32)).max(OLD_RATE),
    };
    let final_pose = params.train.final_pose_rate;
    let of_splats = |rate: f32| aged * decayed(rate, params.train.final_rate);
    let lr_mean = aged * decayed(params.train.lr_mean * scene_scale, FINAL_MEAN_RATE);
    let if_mcmc = |value: f32| if params.mcmc.enabled { value } else { 0.0 };
    // Terms that have no say below have the weight of the parameters.
    let mut weights = params.train.weights;
    // Adam is blind to a factor on the whole loss: less of the photometric term is more of all others.
    let per_photo = 1.0 / params.train.photo_weight;
    let final_depth = params.train.final_depth_weight;
    weights.depth_weight = per_photo * decayed(weights.depth_weight, final_depth);
    weights.opacity_reg = per_photo * if_mcmc(params.mcmc.opacity_reg);
    // A scale is a length: its share of the scene is what has a size.
    let scale_reg = params.mcmc.scale_reg / scene_scale.max(f32::MIN_POSITIVE);
    weights.scale_reg = per_photo * if_mcmc(scale_reg);
    StepSettings {
        lr_mean,
        lr_mean_decay: settling(params, end),
        lr_scale: of_splats(params.train.lr_scale),
        lr_quat: of_splats(params.train.lr_quat),
        lr_opacity: of_splats(params.train.lr_opacity),
        lr_sh0: of_splats(params.train.lr_sh),
        lr_sh_rest: of_splats(params.train.lr_sh * params.train.sh_rest_rate),
        lr_pose_rotation: decayed(raised(params.train.lr_rotation, pose_error[0]), final_pose),
        lr_pose_translation: decayed(
            raised(params.train.lr_translation * scene_scale, pose_error[1]),
            final_pose,
        ),
        lr_pose_network: decayed(params.train.lr_pose_network, final_pose),
        lr_focal: decayed(params.train.lr_focal, final_pose),
        lr_exposure: params.train.lr_exposure,
        lr_appearance: params.train.lr_appearance,
        ssim_weight: params.train.ssim_weight,
        weights,
        depth_mode: match params.train.depth_mode {
            DepthLoss::InvDepth => DepthMode::InverseDepth,
            DepthLoss::PaperCode => DepthMode::PaperCode,
            DepthLoss::PaperAlpha => DepthMode::PaperAlpha,
        },
        noise: if_mcmc(lr_mean * params.mcmc.noise),
        sh_degree: params.train.sh_degree,
        sh_interval: params.train.sh_interval,
        ssim_valid: params.train.ssim_padding == SsimPadding::Valid,
        all_splats: params.mcmc.enabled && params.mcmc.all_splats,
        train_splats: true,
        pose: pose_step(params),
        ..StepSettings::default()
    }
}

/// Weight of the epipolar loss after so many steps of the run.
pub fn epipolar_weight(train: &TrainParams, n_run: u64) -> f32 {
    let is_over = train.epipolar_until > 0 && n_run >= train.epipolar_until;
    if is_over { 0.0 } else { train.epipolar_weight }
}

/// With `train.sh_interval_of: steps`, the highest band after so many steps of the run; every splat has it.
pub fn admit_bands(settings: &mut StepSettings, params: &MapperParams, n_run: u64) {
    let interval = u64::from(params.train.sh_interval);
    if params.train.sh_interval_of == ShInterval::Steps && interval > 0 {
        let highest = (n_run / interval).min(u64::from(params.train.sh_degree));
        settings.sh_degree = highest as u8;
        settings.sh_interval = 0;
    }
}

/// Where more keyframes may come, each splat's own updates stand in for an end: a mean that follows every view at the full rate, half
/// a pixel a step, never comes to rest.
fn settling(params: &MapperParams, end: End) -> f32 {
    match (end, params.train.half_mean_updates) {
        (End::Unknown, half @ 1..) => 1.0 / half as f32,
        _ => 0.0,
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
    fn bands_come_by_steps_where_they_are_asked_to() {
        let mut params = MapperParams::default();
        params.train.sh_interval = 1000;
        let at = |params: &MapperParams, n_run| {
            let mut settings = settings(params, 1.0, [0.0; 2], End::Unknown, 0);
            admit_bands(&mut settings, params, n_run);
            (settings.sh_degree, settings.sh_interval)
        };
        assert_eq!(at(&params, 5000), (3, 1000), "by the updates of each splat");
        params.train.sh_interval_of = ShInterval::Steps;
        let degrees = [0, 999, 1000, 2999, 3000, 9000].map(|n| at(&params, n));
        assert_eq!(degrees, [0, 0, 1, 2, 3, 3].map(|degree| (degree, 0)));
    }

    #[test]
    fn the_epipolar_loss_ends_where_it_is_asked_to() {
        let mut train = TrainParams {
            epipolar_weight: 2.0,
            ..TrainParams::default()
        };
        let at = |train: &TrainParams| [0, 2999, 3000].map(|n| epipolar_weight(train, n));
        assert_eq!(at(&train), [2.0, 2.0, 0.0], "as in 3R-GS");
        train.epipolar_until = 0;
        assert_eq!(at(&train), [2.0; 3], "never");
    }

    const ORDERS: [ViewOrder; 2] = [ViewOrder::Spread, ViewOrder::Shuffled];

    #[test]
    fn a_round_visits_every_view_once() {
        for order in ORDERS {
            let mut schedule = Schedule::new(7);
            schedule.note_trained(20);
            let views: Vec<usize> = (3..20).collect();
            let mut draw = || -> Vec<usize> {
                let each = views.iter();
                each.filter_map(|_| schedule.next_view(&views, order))
                    .collect()
            };
            let (mut first, second) = (draw(), draw());
            assert_ne!(first, second, "{order:?}");
            first.sort_unstable();
            assert_eq!(first, views);
            assert_eq!(schedule.next_view(&[], order), None);
        }
    }

    #[test]
    fn steps_that_follow_each_other_are_on_views_far_apart() {
        for n in [8, 38, 100, 501] {
            let mut schedule = Schedule::new(7);
            schedule.note_trained(n);
            let views: Vec<usize> = (0..n).collect();
            let round: Vec<usize> = (0..n)
                .filter_map(|_| schedule.next_view(&views, ViewOrder::Spread))
                .collect();
            let nearest = round.windows(2).map(|pair| pair[0].abs_diff(pair[1])).min();
            assert!(nearest.is_some_and(|apart| apart * 5 > n), "{n}: {round:?}");
        }
    }

    #[test]
    fn new_views_come_soon_and_leave_time_for_the_others() {
        for order in ORDERS {
            let mut schedule = Schedule::new(7);
            let views: Vec<usize> = (0..80).collect();
            schedule.note_trained(78);
            let mut draw = |n| -> (Vec<usize>, u32) {
                let drawn = (0..n).filter_map(|_| schedule.next_view(&views, order));
                let drawn = drawn.collect();
                (drawn, schedule.steps_of(78).min(schedule.steps_of(79)))
            };
            let (first, n_new) = draw(30);
            assert!(n_new >= 1, "{order:?}: {first:?}");
            let n_old = first.iter().filter(|v| **v < 72).count();
            assert!(n_old > 20, "{order:?}: {first:?}");

            schedule.renew(40);
            let soon: Vec<usize> = (0..20)
                .filter_map(|_| schedule.next_view(&views, order))
                .collect();
            assert!(soon.contains(&40), "{order:?}: {soon:?}");
        }
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
        let found = settings(&params, 2.0, [0.0; 2], End::Unknown, 0);
        assert_eq!(found.weights, expected, "without mcmc.enabled");
    }

    #[test]
    fn rates_fall_towards_an_end_that_is_known_and_as_a_view_is_trained() {
        let params = MapperParams::default();
        let at = |end| settings(&params, 2.0, [0.0; 2], end, 0);
        let (open, last) = (at(End::Unknown), at(End::Nears(1.0)));
        assert_eq!(at(End::Ahead), at(End::Nears(0.0)), "one schedule");
        let all_but_means = StepSettings {
            lr_mean_decay: 0.0,
            ..open.clone()
        };
        assert_eq!(all_but_means, at(End::Ahead));
        assert!((open.lr_mean_decay - 1.0 / 30.0).abs() < 1e-6);
        assert_eq!(end_of_run(&params, true), End::Ahead);
        assert_eq!(end_of_run(&params, false), End::Unknown);
        assert!((last.lr_mean / open.lr_mean - 0.01).abs() < 1e-6);
        assert!(last.weights.depth_weight < open.weights.depth_weight);
        assert!((last.lr_scale / open.lr_scale - 0.2).abs() < 1e-6);
        let trained = |n| settings(&params, 2.0, [0.0; 2], End::Unknown, n);
        assert!((trained(30).lr_opacity / open.lr_opacity - 0.5).abs() < 1e-6);
        assert!((trained(u32::MAX).lr_sh0 / open.lr_sh0 - 0.1).abs() < 1e-6);
        assert_eq!(trained(30).lr_pose_rotation, open.lr_pose_rotation);
        assert!(open.lr_pose_rotation > 0.0 && open.sh_degree == params.train.sh_degree);
    }
}
