//! What the map does about poses that wander together, jump alone, or outgrow the shared network.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use glam::{DQuat, DVec3};

use crate::ground_truth::{batch, known, numbered, room};
use crate::hooked::{Hooked, Hooks};
use splat_engine::cpu::engine::CpuEngine;
use splat_engine::error::EngineError;
use splat_engine::settings::StepSettings;
use splat_engine::traits::{SplatBuffers as _, ViewStore as _};
use splat_geometry::model::GeometryModel as _;
use splat_mapper::params::settings::Settings;
use splat_slam::mapper::mapper::Mapper;
use splat_slam::mapper::params::{MapParams, MapperParams, PoseOptimization, TrainParams};
use splat_slam::mapper::splats::transform::Carry;
use splat_slam::mapper::train::schedule::End;
use splat_types::frame::Frame;
use splat_types::snapshot::{Scale, Snapshot};
use splat_types::transform::Rigid;

/// Steps between the map's looks at its poses.
const ANCHOR_EVERY: u64 = 250;

/// An engine that learns nothing; its steps do to the poses what bad steps of a real one might.
type Pushed = Hooked<Pushes>;

#[derive(Debug, Default)]
struct Pushes {
    n_steps: u64,
    /// Of all cameras and splats together, in every step.
    wander: Option<Rigid>,
    /// Of one camera, once.
    jump: Option<(usize, Rigid)>,
    n_networks: Arc<AtomicU32>,
}

impl Hooks for Pushes {
    fn before(&self, _: &CpuEngine, call: &'static str) -> Result<(), EngineError> {
        let is_start = call == "start_pose_network";
        self.n_networks
            .fetch_add(u32::from(is_start), Ordering::Relaxed);
        Ok(())
    }
    fn step(&mut self, inner: &mut CpuEngine, _: usize, _: &StepSettings) {
        self.n_steps += 1;
        if let Some(wander) = self.wander {
            inner.transform_cameras(&wander).unwrap();
            let mut splats = inner.read().unwrap();
            let carry = Carry::new(wander.into(), splats.sh_degree);
            (0..splats.len()).for_each(|i| carry.transform(&mut splats, i));
            inner.replace(&splats).unwrap();
        }
        if let (ANCHOR_EVERY, Some((view_ix, jump))) = (2 * self.n_steps, self.jump) {
            let pose = inner.poses().unwrap()[view_ix];
            inner.set_pose(view_ix, jump * pose).unwrap();
        }
    }
}

fn pushed(hooks: Pushes) -> Pushed {
    Pushed {
        hooks,
        ..Pushed::default()
    }
}

fn map_params(pose_opt: PoseOptimization) -> MapperParams {
    MapperParams {
        map: MapParams {
            // Reached by the seeds of the first views: none come later.
            max_splats: 100,
            holdout: 0,
            ..MapParams::default()
        },
        train: TrainParams {
            pose_opt,
            max_side: 64,
            seeds_per_keyframe: 20,
            ..TrainParams::default()
        },
        ..MapperParams::default()
    }
}

/// A map of the frames with these numbers, in batches of those that are given together.
fn map_of(engine: Pushed, pose: PoseOptimization, batches: &[&[usize]]) -> (Mapper, Vec<Snapshot>) {
    let (frames, extent) = room();
    let mut model = known(Settings::shipped().params().unwrap().ground_truth, extent);
    let mut map = Mapper::new(map_params(pose), 3, Scale::GIVEN, Box::new(engine));
    let mut after = Vec::new();
    for (id, numbers) in (0..).zip(batches) {
        let all: Vec<(u32, Frame)> = numbered(&frames, true);
        let chosen: Vec<_> = numbers.iter().map(|n| all[*n].clone()).collect();
        let batch = batch(id, 0, &chosen);
        let geometry = model.infer(&batch).unwrap();
        map.add(Some(&batch), &geometry, None).unwrap();
        after.push(Snapshot::clone(&map.snapshot().unwrap()));
    }
    (map, after)
}

fn assert_poses(found: &Snapshot, wanted: &Snapshot) {
    for (found, wanted) in found.poses.iter().zip(&wanted.poses) {
        let (a, b) = (&found.world_from_cam, &wanted.world_from_cam);
        let (shift, turn) = ((a.translation - b.translation).length(), a.angle_to(b));
        assert!(
            shift < 1e-6 && turn < 1e-6,
            "keyframe {}: {shift} and {turn} rad off",
            found.keyframe_id
        );
    }
}

#[test]
fn what_wanders_together_is_moved_back_together() {
    let wander = Rigid::new(
        DQuat::from_scaled_axis(DVec3::new(2e-4, -1e-4, 1e-4)),
        DVec3::new(1e-3, 0.0, -2e-3),
    );
    let engine = pushed(Pushes {
        wander: Some(wander),
        ..Pushes::default()
    });
    let (mut map, before) = map_of(engine, PoseOptimization::PerView, &[&[0, 1, 2, 3, 4]]);
    let before = &before[0];
    map.step(ANCHOR_EVERY - 1, End::Unknown).unwrap();
    let wandered = map.snapshot().unwrap();
    let shift =
        wandered.poses[0].world_from_cam.translation - before.poses[0].world_from_cam.translation;
    assert!(shift.length() > 0.1, "the test moves nothing: {shift}");
    map.step(1, End::Unknown).unwrap();
    let after = map.snapshot().unwrap();
    assert_poses(&after, before);
    // Holes may have been filled behind the first.
    assert!(after.splats.len() >= before.splats.len());
    for (a, b) in after.splats.means.iter().zip(&before.splats.means) {
        let off = (0..3).map(|k| (a[k] - b[k]).abs()).fold(0.0, f32::max);
        assert!(off < 1e-3, "a splat is left behind by {off}");
    }
    assert_eq!(map.n_put_back(), 0);
}

#[test]
fn a_view_that_jumps_goes_back_to_the_models_pose_and_a_refined_one_stays() {
    for (degrees, n_put_back) in [(30.0_f64, 1), (1.0, 0)] {
        let turn = DQuat::from_rotation_y(degrees.to_radians());
        let engine = pushed(Pushes {
            jump: Some((2, Rigid::new(turn, DVec3::ZERO))),
            ..Pushes::default()
        });
        let (mut map, before) = map_of(engine, PoseOptimization::PerView, &[&[0, 1, 2, 3, 4]]);
        map.step(ANCHOR_EVERY, End::Unknown).unwrap();
        assert_eq!(map.n_put_back(), n_put_back, "{degrees} degrees");
        let moved = map.snapshot().unwrap().poses[2].world_from_cam;
        let angle = moved
            .angle_to(&before[0].poses[2].world_from_cam)
            .to_degrees();
        // Its share of what all have in common goes to all.
        let is_back = angle < 0.3 * degrees;
        assert_eq!(is_back, n_put_back == 1, "{angle} of {degrees} degrees");
    }
}

#[test]
fn cameras_that_spread_get_a_fresh_network_and_no_pose_jumps() {
    let engine = Pushed::default();
    let n_networks = Arc::clone(&engine.hooks.n_networks);
    let (_, after) = map_of(
        engine,
        PoseOptimization::Network,
        &[&[0, 1], &[2, 3, 4, 5, 6, 7]],
    );
    assert_eq!(n_networks.load(Ordering::Relaxed), 2);
    assert_eq!(after[1].poses.len(), 8);
    assert_poses(&after[1], &after[0]);
}
