//! What an IMU measured between keyframes, and where the map has them -> metres of one map unit.

use crate::mapper::keyframes::registered::RegisteredKeyframe;
use splat_geometry::inertial::alignment::{MetricAlignment, align, align_for_unit};
use splat_geometry::inertial::frames::{Calibration, PosedFrame};
use splat_geometry::inertial::noise::ImuNoise;
use splat_geometry::length_ratio::LogRatio;
use splat_geometry::similarity;
use splat_geometry::stats::median;
use splat_types::inertial::ImuLog;
use splat_types::snapshot::KeyframePose;

/// The newest keyframes that are looked at: some two minutes.
const MAX_KEYFRAMES: usize = 300;
const KEPT_SECS: f64 = 600.0;
/// What places of keyframes are off by to begin with, as a share of the median step between them; then what their misfit says, within
/// such a factor at once.
const FIRST_STD: f64 = 0.02;
const MAX_FACTOR: f64 = 3.0;
const TURN_STD: f64 = 0.001;
const N_ROUNDS: usize = 4;
/// Wrong poses and gaps in time beyond what the noise states.
const MAX_MISFIT: f64 = 3.0;
/// Gravity is another one elsewhere on Earth, and accelerometers have an error of scale.
const COMMON_ERROR: f64 = 0.003;

/// `None` where nothing is known, or too little to be believed. Keyframes come in order of id, poses in order of time.
pub(crate) fn metres_per_unit<'a>(
    registered: impl DoubleEndedIterator<Item = &'a RegisteredKeyframe>,
    poses: &[KeyframePose],
) -> Option<LogRatio> {
    let newest: Vec<&RegisteredKeyframe> = registered.rev().take(MAX_KEYFRAMES).collect();
    let mut log = ImuLog::new(KEPT_SECS);
    let (mut frames, mut pairs) = (Vec::new(), Vec::new());
    for keyframe in newest.iter().rev() {
        let frame = &keyframe.keyframe.frame;
        let Some(span) = &frame.imu else {
            continue;
        };
        log.push(span);
        if let Ok(ix) = poses.binary_search_by_key(&frame.stamp, |p| p.stamp) {
            // Steps of the splats shake poses by more than geometry is off from one keyframe to the next.
            let world_from_cam = keyframe.submap_from_cam;
            frames.push(PosedFrame {
                stamp: frame.stamp,
                world_from_cam,
                std: [0.0, TURN_STD],
            });
            pairs.push((poses[ix].world_from_cam, world_from_cam));
        }
    }
    let map_per_model = similarity::of_poses(&pairs)?.scale;
    let found = by_own_misfit(&mut frames, &log)?;
    (found.misfit < MAX_MISFIT && found.has_unit()).then(|| LogRatio {
        log: (found.metres_per_unit / map_per_model).ln(),
        std: found.relative_std.hypot(COMMON_ERROR),
    })
}

/// Aligns with the noise of the places that makes the misfit 1: nobody states it.
fn by_own_misfit(frames: &mut [PosedFrame], log: &ImuLog) -> Option<MetricAlignment> {
    let noise = ImuNoise::of(log.model());
    let step = |two: &[PosedFrame]| {
        let [a, b] = [two[0], two[1]].map(|f| f.world_from_cam.translation);
        a.distance(b)
    };
    let mut steps: Vec<f64> = frames.windows(2).map(step).collect();
    let mut std = FIRST_STD * median(&mut steps)?.max(1e-9);
    let calibration = Calibration::default();
    for _ in 1..N_ROUNDS {
        frames.iter_mut().for_each(|frame| frame.std[0] = std);
        let metric = align(frames, log, &calibration, &noise).ok()?.metric?;
        std *= metric.misfit.clamp(1.0 / MAX_FACTOR, MAX_FACTOR);
    }
    frames.iter_mut().for_each(|frame| frame.std[0] = std);
    align_for_unit(frames, log, &calibration, &noise)
        .ok()?
        .metric
}
