//! What is known in metres beside the map -> metres of one map unit, with its standard deviation.
//!
//! A camera alone shows no lengths. Wheels, a depth camera, the height at which the camera is mounted or one measured
//! distance do; each gives many ratios, of which some are wrong.

use crate::mapper::inertial_scale;
use crate::mapper::keyframes::metric_ratios;
use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::metric_scale_params::{MetricSource, ScaleParams};
use splat_geometry::answer::MetricUnit;
use splat_geometry::length_ratio::{LogRatio, of_odometry, robust};
use splat_geometry::similarity;
use splat_types::snapshot::{KeyframePose, Scale, ScaleSource};
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// What depth cameras and measured heights are off by in common, which no number of ratios shows.
const DEPTH_ERROR: f64 = 0.005;
const HEIGHT_ERROR: f64 = 0.02;
/// Places that one measured distance rests on are known to such a share of it.
const BASELINE_ERROR: f64 = 0.01;

/// A distance that somebody measured between the camera's places at two times.
fn of_baseline(poses: &[KeyframePose], (from, to, metres): (f64, f64, f64)) -> Option<LogRatio> {
    let first = poses.first()?.stamp;
    let nearest = |secs: f64| {
        let off = |p: &&KeyframePose| (p.stamp.secs_since(first) - secs).abs();
        poses.iter().min_by(|a, b| off(a).total_cmp(&off(b)))
    };
    let (a, b) = (nearest(from)?, nearest(to)?);
    let units = (a.world_from_cam.translation - b.world_from_cam.translation).length();
    let log = (metres / units).ln();
    log.is_finite().then_some(LogRatio {
        log,
        std: BASELINE_ERROR,
    })
}

/// Metres of one map unit, as far as anything reports them.
#[derive(Debug)]
pub(crate) struct MetricScale {
    scale: Scale,
    /// What is looked for; `None`: nothing.
    params: Option<ScaleParams>,
    /// The model's lengths are metres.
    is_given: bool,
    has_depth_of_poses: bool,
    /// What makes the model's lengths metres, if anything does.
    unit: Option<MetricUnit>,
}

impl MetricScale {
    pub(crate) fn new(scale: Scale) -> Self {
        Self {
            scale,
            params: None,
            is_given: scale == Scale::GIVEN,
            has_depth_of_poses: false,
            unit: None,
        }
    }

    pub(crate) fn set_one_for_all_views(&mut self, has: bool) {
        self.has_depth_of_poses = has;
    }

    /// From now on the model's lengths are metres.
    pub(crate) fn set_unit(&mut self, unit: MetricUnit) {
        self.unit = Some(unit);
    }

    /// Depth of single views needs no factor.
    pub(crate) fn is_one_for_all_views(&self) -> bool {
        self.has_depth_of_poses || self.scale.source == ScaleSource::Given
    }

    /// From now on looks for metres by these parameters, unless the geometry has them.
    pub(crate) fn look_for(&mut self, params: &ScaleParams) {
        self.params = Some(params.clone());
    }

    pub(crate) fn params(&self) -> Option<&ScaleParams> {
        self.params.as_ref()
    }

    pub(crate) fn scale(&self) -> Scale {
        self.scale
    }

    pub(crate) fn set(&mut self, scale: Scale) {
        self.scale = scale;
    }

    /// A model that knows metres reports them of a map that had none.
    pub(crate) fn take_over(&mut self, metres_per_unit: f64) {
        if self.is_given && self.scale.source != ScaleSource::Given {
            self.scale = Scale {
                metres_per_unit: Some(metres_per_unit),
                ..Scale::GIVEN
            };
        }
    }

    /// Metres per unit as far as anything reports; `poses` as a snapshot has them.
    pub(crate) fn measure(
        &self,
        keyframes: &mut KeyframeStore,
        poses: &[KeyframePose],
        prior: Option<Scale>,
    ) -> Scale {
        let Some(params) = self.params.clone() else {
            return self.scale;
        };
        if self.scale.source == ScaleSource::Given || params.source == MetricSource::Off {
            return self.scale;
        }
        let by_model = params.source == MetricSource::Auto || params.source == MetricSource::Depth;
        if let Some(unit) = self.unit.filter(|_| by_model) {
            return self.noted(of_model(unit, keyframes, poses));
        }
        for registered in keyframes.values_mut() {
            metric_ratios::measure(registered, &params);
        }
        let found = estimates(&params, keyframes.registered().values(), poses);
        let best = found
            .into_iter()
            .filter_map(|(source, estimate)| Some((source, estimate?)))
            .min_by(|a, b| a.1.std.total_cmp(&b.1.std));
        // What a saved map knows better stays.
        let known = prior.and_then(|prior| prior.relative_std());
        if let Some(known) = known
            && best.is_none_or(|(_, estimate)| known <= estimate.std)
        {
            return prior.unwrap_or(self.scale);
        }
        let scale = best.map_or(Scale::UP_TO_SCALE, |(source, estimate)| {
            let metres = estimate.log.exp();
            Scale {
                source,
                metres_per_unit: Some(metres),
                std: Some(metres * estimate.std),
            }
        });
        self.noted(scale)
    }

    /// Says so where it comes of something else than before.
    fn noted(&self, scale: Scale) -> Scale {
        if scale.source != self.scale.source {
            tracing::info!(
                source = scale.source.name(),
                metres_per_unit = scale.metres_per_unit,
                std = scale.std,
                "scale of the map"
            );
        }
        scale
    }
}

/// Where the model's lengths are metres: how long one unit of the map is in them.
fn of_model(unit: MetricUnit, keyframes: &KeyframeStore, poses: &[KeyframePose]) -> Scale {
    let pair = |p: &RegisteredKeyframe| {
        let world_from_cam = pose_at(poses, p.keyframe.frame.stamp)?;
        Some((world_from_cam, p.submap_from_cam))
    };
    let pairs: Vec<(Rigid, Rigid)> = keyframes.registered().values().filter_map(pair).collect();
    let units_per_metre = similarity::of_poses(&pairs).map_or(1.0, |s| s.scale);
    let metres = 1.0 / units_per_metre;
    Scale {
        source: unit.source,
        metres_per_unit: Some(metres),
        std: Some(metres * unit.relative_std),
    }
}

/// What each source that is allowed says.
fn estimates<'a>(
    params: &ScaleParams,
    registered: impl Iterator<Item = &'a RegisteredKeyframe>,
    poses: &[KeyframePose],
) -> Vec<(ScaleSource, Option<LogRatio>)> {
    let may = |known: MetricSource| params.source == MetricSource::Auto || params.source == known;
    let registered: Vec<&RegisteredKeyframe> = registered.collect();
    let all = |which: usize| {
        registered
            .iter()
            .filter_map(|p| metric_ratios::ratio(p, which))
            .collect::<Vec<_>>()
    };
    let mut found = Vec::new();
    if may(MetricSource::Odometry) {
        let track: Vec<(Rigid, Rigid)> = registered
            .iter()
            .filter_map(|p| {
                let pose = pose_at(poses, p.keyframe.frame.stamp)?;
                Some((pose, p.keyframe.frame.odometry?))
            })
            .collect();
        let estimate = of_odometry(&track, params.odometry_error);
        found.push((ScaleSource::Odometry, estimate));
    }
    if may(MetricSource::Imu) {
        let estimate = inertial_scale::metres_per_unit(registered.iter().copied(), poses);
        found.push((ScaleSource::Imu, estimate));
    }
    if may(MetricSource::Depth) {
        found.push((ScaleSource::Depth, robust(all(0), DEPTH_ERROR)));
    }
    if may(MetricSource::Height) {
        found.push((ScaleSource::Height, robust(all(1), HEIGHT_ERROR)));
    }
    if let Some(baseline) = params
        .baseline_secs()
        .filter(|_| may(MetricSource::Baseline))
    {
        found.push((ScaleSource::Baseline, of_baseline(poses, baseline)));
    }
    found
}

fn pose_at(poses: &[KeyframePose], stamp: Stamp) -> Option<Rigid> {
    let ix = poses.binary_search_by_key(&stamp, |p| p.stamp).ok()?;
    Some(poses[ix].world_from_cam)
}
