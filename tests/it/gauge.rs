//! What the map does about poses that wander together, jump alone, or outgrow the shared network.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use glam::{DQuat, DVec3};
use splat_mapper::camera::Intrinsics;
use splat_mapper::config::{MapParams, PoseRefinement, Settings};
use splat_mapper::frame::{DepthMap, Frame, RgbImage};
use splat_mapper::geometry::GeometryModel as _;
use splat_mapper::map::SplatMap;
use splat_mapper::map::align::Carry;
use splat_mapper::map::schedule::Phase;
use splat_mapper::map::snapshot::{Scale, Snapshot};
use splat_mapper::pose::Rigid;
use splat_mapper::splat::cpu::CpuEngine;
use splat_mapper::splat::{
    Engine, Match, McmcSettings, RefinerSettings, Rendering, Splats, StepSettings, StepStats,
    TrainingView,
};

use crate::known::{batch, known, numbered, room};

/// Steps between the map's looks at its poses.
const GAUGE_EVERY: u64 = 250;

/// An engine that learns nothing; its steps do to the poses what bad steps of a real one might.
#[derive(Debug, Default)]
struct Pushed {
    inner: CpuEngine,
    n_steps: u64,
    /// Of all cameras and splats together, in every step.
    wander: Option<Rigid>,
    /// Of one camera, once.
    jump: Option<(usize, Rigid)>,
    n_networks: Arc<AtomicU32>,
}

impl Engine for Pushed {
    fn step(&mut self, _: usize, _: &StepSettings) {
        self.n_steps += 1;
        if let Some(wander) = self.wander {
            self.inner.move_cameras(&wander);
            let mut splats = self.inner.splats();
            let carry = Carry::new(wander.into(), splats.sh_degree);
            (0..splats.len()).for_each(|i| carry.carry(&mut splats, i));
            self.inner.overwrite(&splats);
        }
        if let (GAUGE_EVERY, Some((view_ix, jump))) = (2 * self.n_steps, self.jump) {
            let pose = self.inner.poses()[view_ix];
            self.inner.set_pose(view_ix, jump * pose);
        }
    }
    fn start_refiner(&mut self, settings: &RefinerSettings) {
        self.n_networks.fetch_add(1, Ordering::Relaxed);
        self.inner.start_refiner(settings);
    }
    fn adapter(&self) -> String {
        self.inner.adapter()
    }
    fn append(&mut self, splats: &Splats) {
        self.inner.append(splats);
    }
    fn retain(&mut self, keep: &[bool]) {
        self.inner.retain(keep);
    }
    fn overwrite(&mut self, splats: &Splats) {
        self.inner.overwrite(splats);
    }
    fn n_splats(&self) -> usize {
        self.inner.n_splats()
    }
    fn add_view(&mut self, view: TrainingView) -> usize {
        self.inner.add_view(view)
    }
    fn set_pose(&mut self, view_ix: usize, cam_from_map: Rigid) {
        self.inner.set_pose(view_ix, cam_from_map);
    }
    fn move_cameras(&mut self, new_from_old: &Rigid) {
        self.inner.move_cameras(new_from_old);
    }
    fn set_intrinsics(&mut self, view_ix: usize, intrinsics: &Intrinsics) {
        self.inner.set_intrinsics(view_ix, intrinsics);
    }
    fn set_image(&mut self, view_ix: usize, image: Arc<RgbImage>, intrinsics: &Intrinsics) {
        self.inner.set_image(view_ix, image, intrinsics);
    }
    fn set_depth(&mut self, view_ix: usize, depth: Option<Arc<DepthMap>>) {
        self.inner.set_depth(view_ix, depth);
    }
    fn set_mask(&mut self, view_ix: usize, mask: Option<Arc<[u8]>>) {
        self.inner.set_mask(view_ix, mask);
    }
    fn set_matches(&mut self, view_ix: usize, matches: &[Match]) {
        self.inner.set_matches(view_ix, matches);
    }
    fn relocate_and_grow(&mut self, settings: &McmcSettings) -> usize {
        self.inner.relocate_and_grow(settings)
    }
    fn focal_factor(&mut self) -> f64 {
        self.inner.focal_factor()
    }
    fn exposures(&mut self) -> Vec<[[f32; 3]; 2]> {
        self.inner.exposures()
    }
    fn peak_gpu_bytes(&self) -> u64 {
        0
    }
    fn take_stats(&mut self) -> StepStats {
        self.inner.take_stats()
    }
    fn poses(&mut self) -> Vec<Rigid> {
        self.inner.poses()
    }
    fn splats(&mut self) -> Splats {
        self.inner.splats()
    }
    fn render(&mut self, intrinsics: &Intrinsics, pose: &Rigid, sh_degree: u8) -> Rendering {
        self.inner.render(intrinsics, pose, sh_degree)
    }
}

fn map_params(pose: PoseRefinement) -> MapParams {
    MapParams {
        pose,
        max_side: 64,
        seeds_per_keyframe: 20,
        // Reached by the seeds of the first views: none come later.
        max_splats: 100,
        holdout: 0,
        ..Settings::shipped().params().unwrap().map
    }
}

/// A map of the frames with these numbers, in batches of those that are given together.
fn map_of(engine: Pushed, pose: PoseRefinement, batches: &[&[usize]]) -> (SplatMap, Vec<Snapshot>) {
    let (frames, extent) = room();
    let mut model = known(Settings::shipped().params().unwrap().known, extent);
    let mut map = SplatMap::new(map_params(pose), 3, Scale::GIVEN, Box::new(engine));
    let mut after = Vec::new();
    for (id, numbers) in (0..).zip(batches) {
        let all: Vec<(u32, Frame)> = numbered(&frames, true);
        let chosen: Vec<_> = numbers.iter().map(|n| all[*n].clone()).collect();
        let batch = batch(id, 0, &chosen);
        let geometry = model.infer(&batch).unwrap();
        map.add(Some(&batch), geometry, None);
        after.push(Snapshot::clone(&map.snapshot()));
    }
    (map, after)
}

fn assert_poses(found: &Snapshot, wanted: &Snapshot) {
    for (found, wanted) in found.poses.iter().zip(&wanted.poses) {
        let (a, b) = (&found.map_from_cam, &wanted.map_from_cam);
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
    let engine = Pushed {
        wander: Some(wander),
        ..Pushed::default()
    };
    let (mut map, before) = map_of(engine, PoseRefinement::Direct, &[&[0, 1, 2, 3, 4]]);
    let before = &before[0];
    map.step(GAUGE_EVERY - 1, Phase::Streaming);
    let wandered = map.snapshot();
    let shift =
        wandered.poses[0].map_from_cam.translation - before.poses[0].map_from_cam.translation;
    assert!(shift.length() > 0.1, "the test moves nothing: {shift}");
    map.step(1, Phase::Streaming);
    let after = map.snapshot();
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
        let engine = Pushed {
            jump: Some((2, Rigid::new(turn, DVec3::ZERO))),
            ..Pushed::default()
        };
        let (mut map, before) = map_of(engine, PoseRefinement::Direct, &[&[0, 1, 2, 3, 4]]);
        map.step(GAUGE_EVERY, Phase::Streaming);
        assert_eq!(map.n_put_back(), n_put_back, "{degrees} degrees");
        let moved = map.snapshot().poses[2].map_from_cam;
        let angle = moved
            .angle_to(&before[0].poses[2].map_from_cam)
            .to_degrees();
        // Its share of what all have in common goes to all.
        let is_back = angle < 0.3 * degrees;
        assert_eq!(is_back, n_put_back == 1, "{angle} of {degrees} degrees");
    }
}

#[test]
fn cameras_that_spread_get_a_fresh_network_and_no_pose_jumps() {
    let engine = Pushed::default();
    let n_networks = Arc::clone(&engine.n_networks);
    let (_, after) = map_of(
        engine,
        PoseRefinement::Shared,
        &[&[0, 1], &[2, 3, 4, 5, 6, 7]],
    );
    assert_eq!(n_networks.load(Ordering::Relaxed), 2);
    assert_eq!(after[1].poses.len(), 8);
    assert_poses(&after[1], &after[0]);
}
