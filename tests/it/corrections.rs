//! What the map makes of keyframes that the model moves: splats go along, clients receive of it.

use std::sync::Arc;

use glam::{DQuat, DVec3};

use crate::loops::{Filmed, film};
use crate::sfm::params;
use splat_engine::cpu::engine::CpuEngine;
use splat_geometry::answer::{GeometryBatch, PoseUpdate, View};
use splat_slam::mapper::mapper::Mapper;
use splat_types::correction::Reason;
use splat_types::frame::Batch;
use splat_types::image::RgbImage;
use splat_types::snapshot::Scale;
use splat_types::transform::Similarity;

/// Two renderings of the same splats from places that correspond; rounding of f32.
const SAME_DB: f64 = 45.0;

fn filmed() -> Filmed {
    film("room?frames=24&width=96&height=72&speed=2", 3)
}

fn map() -> Mapper {
    let mut map = params(&[]).mapper();
    map.map.holdout = 0;
    map.train.seeds_per_keyframe = 1500;
    Mapper::new(map, 1, Scale::UP_TO_SCALE, Box::new(CpuEngine::new()))
}

/// Keyframes `range` as views of a submap.
fn add(map: &mut Mapper, filmed: &Filmed, range: std::ops::Range<usize>, submap: u32) {
    let view = |v: &View| View {
        submap,
        ..v.clone()
    };
    let batch = Batch {
        id: range.start as u32,
        n_shared: 0,
        keyframes: filmed.keyframes[range.clone()].to_vec(),
    };
    let geometry = GeometryBatch {
        views: filmed.views[range].iter().map(view).collect(),
        ..GeometryBatch::default()
    };
    map.add(Some(&batch), &geometry, None).unwrap();
}

fn revised(views: &[View], new_from_old: &Similarity, submap: u32) -> GeometryBatch {
    let revision = |v: &View| PoseUpdate {
        keyframe_id: v.keyframe_id,
        submap,
        intrinsics: v.intrinsics,
        submap_from_cam: new_from_old.transform_pose(&v.submap_from_cam),
        depth_factor: new_from_old.scale,
    };
    GeometryBatch {
        revised: views.iter().map(revision).collect(),
        is_loop: true,
        ..GeometryBatch::default()
    }
}

fn shown(map: &mut Mapper, id: u32) -> RgbImage {
    let (rendering, photo) = map.render_keyframe(id).unwrap().unwrap();
    RgbImage {
        pixels: rendering
            .rgb
            .iter()
            .map(|c| (c * 255.0).round() as u8)
            .collect(),
        ..(*photo).clone()
    }
}

fn motion() -> Similarity {
    Similarity {
        scale: 1.3,
        rotation: DQuat::from_scaled_axis(DVec3::new(0.3, -0.5, 0.2)),
        translation: DVec3::new(1.0, -0.4, 0.7),
    }
}

fn assert_same_images(map: &mut Mapper, before: &[RgbImage]) {
    for (id, before) in (0..).zip(before) {
        let (rendering, _) = map.render_keyframe(id).unwrap().unwrap();
        let psnr = rendering.psnr(before);
        assert!(psnr > SAME_DB, "keyframe {id}: {psnr:.1} dB");
    }
}

#[test]
fn splats_move_turn_and_grow_with_their_keyframes() {
    let filmed = filmed();
    let mut map = map();
    add(&mut map, &filmed, 0..6, 0);
    let before: Vec<RgbImage> = (0..6).map(|id| shown(&mut map, id)).collect();
    let old = map.snapshot().unwrap();
    assert!(map.take_correction().is_none());
    map.add(None, &revised(&filmed.views[..6], &motion(), 0), None)
        .unwrap();
    assert_same_images(&mut map, &before);
    let new = map.snapshot().unwrap();
    assert_eq!(new.epoch, old.epoch + 1);
    let correction = map.take_correction().unwrap();
    assert_eq!(
        (correction.epoch, correction.revision),
        (new.epoch, new.revision)
    );
    assert_eq!(correction.reason, Reason::Loop);
    let found = correction.new_world_from_old_world;
    assert!((found.scale - 1.3).abs() < 1e-6, "{found:?}");
    assert!((motion().inverse() * found).angle() < 1e-6);
    assert!(correction.translation > 0.5 && correction.rotation_rad > 0.5);
    let (a, b) = (old.splats.log_scales[0], new.splats.log_scales[0]);
    assert!((b[0] - a[0] - 1.3f32.ln()).abs() < 1e-5);
    assert!(map.take_correction().is_none(), "reported once");
    let depth = |map: &mut Mapper| map.keyframe_views().unwrap()[2].depth.median().unwrap();
    let wanted = 1.3 * filmed.views[2].depth.median().unwrap();
    assert!((depth(&mut map) / wanted - 1.0).abs() < 1e-5);
}

#[test]
fn a_small_revision_is_no_correction() {
    let filmed = filmed();
    let mut map = map();
    add(&mut map, &filmed, 0..6, 0);
    let before = map.snapshot().unwrap();
    let little = Similarity {
        translation: DVec3::X * 0.004,
        ..Similarity::IDENTITY
    };
    map.add(None, &revised(&filmed.views[2..4], &little, 0), None)
        .unwrap();
    let after = map.snapshot().unwrap();
    assert_ne!(after.poses[2], before.poses[2]);
    assert_eq!(after.epoch, before.epoch);
    assert!(map.take_correction().is_none());
}

#[test]
fn two_corrections_that_nobody_asked_for_are_given_as_one() {
    let filmed = filmed();
    let mut map = map();
    add(&mut map, &filmed, 0..6, 0);
    map.add(None, &revised(&filmed.views[..6], &motion(), 0), None)
        .unwrap();
    let twice = motion() * motion();
    let mut second = revised(&filmed.views[..6], &twice, 0);
    // A revision states depth beside what was reported last.
    let updates = second.revised.iter_mut();
    updates.for_each(|r| r.depth_factor = motion().scale);
    map.add(None, &second, None).unwrap();
    let found = map.take_correction().unwrap().new_world_from_old_world;
    assert!((twice.inverse() * found).angle() < 1e-6);
    let at = filmed.views[5].submap_from_cam.translation;
    let off = twice
        .transform_point(at)
        .distance(found.transform_point(at));
    assert!(off < 1e-4, "{off}");
}

#[test]
fn a_submap_that_is_linked_joins_the_map_in_its_unit() {
    let filmed = filmed();
    let mut map = map();
    add(&mut map, &filmed, 0..4, 0);
    // The same room in another frame and unit.
    let own_from_world = motion().inverse();
    let mut elsewhere = Filmed {
        views: filmed.views.clone(),
        keyframes: filmed.keyframes.iter().map(Arc::clone).collect(),
    };
    for view in &mut elsewhere.views {
        view.submap_from_cam = own_from_world.transform_pose(&view.submap_from_cam);
        view.depth.scale(own_from_world.scale);
    }
    add(&mut map, &elsewhere, 4..8, 1);
    assert_eq!(map.submaps(), [4, 4]);
    let geometry = revised(&elsewhere.views[4..8], &motion(), 0);
    map.add(None, &geometry, None).unwrap();
    assert_eq!(map.submaps(), [8]);
    let snapshot = map.snapshot().unwrap();
    for (pose, truth) in snapshot.poses.iter().zip(&filmed.views) {
        let off = pose
            .world_from_cam
            .translation
            .distance(truth.submap_from_cam.translation);
        assert!(off < 1e-6, "keyframe {}: {off}", pose.keyframe_id);
    }
    let found = map.keyframe_views().unwrap()[6].depth.median().unwrap();
    let wanted = filmed.views[6].depth.median().unwrap();
    assert!((found / wanted - 1.0).abs() < 1e-5, "{found} {wanted}");
    let correction = map.take_correction().unwrap();
    assert_eq!(correction.reason, Reason::Merge);
    assert_eq!(correction.new_world_from_old_world, Similarity::IDENTITY);
}

#[test]
fn a_map_whose_submap_joins_another_stays_where_it_is() {
    let filmed = filmed();
    let mut map = map();
    add(&mut map, &filmed, 0..4, 3);
    let before: Vec<RgbImage> = (0..4).map(|id| shown(&mut map, id)).collect();
    let old = map.snapshot().unwrap();
    let geometry = revised(&filmed.views[..4], &motion(), 2);
    map.add(None, &geometry, None).unwrap();
    assert_same_images(&mut map, &before);
    let new = map.snapshot().unwrap();
    assert_eq!(new.epoch, old.epoch, "nothing moved");
    for (a, b) in old.poses.iter().zip(&new.poses) {
        assert!(
            a.world_from_cam
                .translation
                .distance(b.world_from_cam.translation)
                < 1e-6
        );
    }
    let mut moved = Filmed {
        views: filmed.views.clone(),
        keyframes: filmed.keyframes.iter().map(Arc::clone).collect(),
    };
    for view in &mut moved.views {
        view.submap_from_cam = motion().transform_pose(&view.submap_from_cam);
        view.depth.scale(motion().scale);
    }
    add(&mut map, &moved, 4..8, 2);
    assert_eq!(map.submaps(), [8]);
    let pose = map.snapshot().unwrap().poses[6].world_from_cam;
    let off = pose
        .translation
        .distance(filmed.views[6].submap_from_cam.translation);
    assert!(off < 1e-6, "{off}");
}
