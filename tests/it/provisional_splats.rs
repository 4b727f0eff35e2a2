//! A keyframe whose depth is still to come is in the map at once, as coarse splats that its depth replaces.

use std::collections::BTreeSet;

use glam::DVec3;

use crate::ground_truth::{batch, known, numbered, room};
use splat_engine::cpu::engine::CpuEngine;
use splat_geometry::answer::{GeometryBatch, Observations, SeenLandmark, View};
use splat_geometry::model::GeometryModel as _;
use splat_mapper::params::settings::Settings;
use splat_slam::mapper::mapper::Mapper;
use splat_slam::mapper::params::{MapParams, MapperParams};
use splat_types::depth::DepthMap;
use splat_types::snapshot::Scale;

/// Every so many pixels of the depth map are landmarks.
const STRIDE: usize = 7;

/// What a view's landmarks would be: some of what its depth says, in pixels of its image.
fn landmarks(view: &View) -> Observations {
    let depth = &view.depth;
    let per_px = view.intrinsics.width_px as f32 / depth.width_px as f32;
    let width = depth.width_px as usize;
    let seen = (0..depth.depth.len()).step_by(STRIDE).filter_map(|at| {
        let place = [(at % width) as f32 + 0.5, (at / width) as f32 + 0.5];
        Some(SeenLandmark {
            id: at as u32,
            pixel: place.map(|v| v * per_px),
            depth: depth.verified(at)?.0,
        })
    });
    Observations {
        keyframe_id: view.keyframe_id,
        landmarks: seen.collect(),
    }
}

/// Whether a view has verified a surface within 3 % of a place.
fn is_on_surface(view: &View, place: DVec3) -> bool {
    let in_cam = view.submap_from_cam.inverse().transform_point(place);
    let depth = &view.depth;
    let lens = view.intrinsics.resized(depth.width_px, depth.height_px);
    let at = lens.project(in_cam).and_then(|pixel| depth.pixel_at(pixel));
    at.and_then(|at| depth.verified(at))
        .is_some_and(|(z, _)| (in_cam.z / f64::from(z) - 1.0).abs() < 0.03)
}

#[test]
fn splats_from_landmarks_come_at_once_and_go_when_depth_comes() {
    let (frames, extent) = room();
    let settings = Settings::shipped().params().unwrap();
    let mut model = known(settings.ground_truth, extent);
    let params = MapperParams {
        map: MapParams {
            holdout: 0,
            ..MapParams::default()
        },
        ..MapperParams::default()
    };
    let mut map = Mapper::new(params, 3, Scale::GIVEN, Box::new(CpuEngine::new()));
    let chosen = &numbered(&frames, true)[..3];
    let batch = batch(0, 0, chosen);
    let dense = model.infer(&batch).unwrap();
    let without_depth = |view: &View| View {
        depth: DepthMap::none(),
        ..view.clone()
    };
    let sparse = GeometryBatch {
        views: dense.views.iter().map(without_depth).collect(),
        observations: dense.views.iter().map(landmarks).collect(),
        ..GeometryBatch::default()
    };

    map.add(Some(&batch), &sparse, None).unwrap();
    let coarse = map.snapshot().unwrap();
    assert!(coarse.splats.len() > 300, "{}", coarse.splats.len());
    let centre = frames[0].truth.unwrap().translation;
    let far = coarse.splats.means.iter();
    let farthest = far
        .map(|mean| glam::Vec3::from(*mean).as_dvec3().distance(centre))
        .fold(0.0, f64::max);
    assert!(farthest < 20.0, "the room is no larger: {farthest} m");

    let first = GeometryBatch {
        views: dense.views[..1].to_vec(),
        ..GeometryBatch::default()
    };
    map.add(None, &first, None).unwrap();
    let some = map.snapshot().unwrap();
    let left: BTreeSet<u32> = some.splat_ids.iter().copied().collect();
    let n_left = coarse
        .splat_ids
        .iter()
        .filter(|id| left.contains(id))
        .count();
    assert!(
        n_left > 0 && n_left < coarse.splats.len(),
        "those of one keyframe have gone: {n_left} of {}",
        coarse.splats.len()
    );

    let rest = GeometryBatch {
        views: dense.views[1..].to_vec(),
        ..GeometryBatch::default()
    };
    map.add(None, &rest, None).unwrap();
    let whole = map.snapshot().unwrap();
    let guessed = |ix: &usize| coarse.splat_ids.contains(&whole.splat_ids[*ix]);
    let stayed: Vec<usize> = (0..whole.splats.len()).filter(guessed).collect();
    assert!(stayed.len() < n_left, "{} of {n_left}", stayed.len());
    for ix in stayed {
        let mean = glam::Vec3::from(whole.splats.means[ix]).as_dvec3();
        let is_right = |view: &View| is_on_surface(view, mean);
        assert!(dense.views.iter().any(is_right), "a wrong guess: {mean}");
    }
    assert!(whole.splats.len() > 1000, "{}", whole.splats.len());
}

#[test]
fn landmarks_without_numbers_or_of_unknown_keyframes_seed_nothing() {
    let (frames, extent) = room();
    let settings = Settings::shipped().params().unwrap();
    let mut model = known(settings.ground_truth, extent);
    let engine = Box::new(CpuEngine::new());
    let mut map = Mapper::new(MapperParams::default(), 3, Scale::GIVEN, engine);
    let chosen = &numbered(&frames, true)[..1];
    let batch = batch(0, 0, chosen);
    let mut geometry = model.infer(&batch).unwrap();
    geometry.observations = geometry.views.iter().map(landmarks).collect();
    for view in &mut geometry.views {
        view.depth = DepthMap::none();
    }
    for seen in &mut geometry.observations {
        for landmark in &mut seen.landmarks {
            landmark.depth = f32::NAN;
        }
    }
    let unknown = Observations {
        keyframe_id: 99,
        landmarks: Vec::new(),
    };
    geometry.observations.push(unknown);
    map.add(Some(&batch), &geometry, None).unwrap();
    assert_eq!((map.n_keyframes(), map.n_splats()), (1, 0));
}
