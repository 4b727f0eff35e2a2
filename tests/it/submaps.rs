//! Submaps without a known relation: each is mapped, the one that is not worked on is parked, and both are one when they join.

use std::sync::Arc;

use glam::{DQuat, DVec3};

use crate::loops::{Filmed, film};
use crate::sfm::params;
use splat_engine::cpu::engine::CpuEngine;
use splat_geometry::answer::{GeometryBatch, PoseUpdate, View};
use splat_mapper::node::page_file::PageFile;
use splat_slam::mapper::mapper::Mapper;
use splat_slam::mapper::mapper::reports::SubmapReport;
use splat_slam::mapper::params::MapperParams;
use splat_slam::mapper::train::schedule::End;
use splat_types::correction::Reason;
use splat_types::frame::Batch;
use splat_types::snapshot::{Scale, Snapshot};
use splat_types::transform::Similarity;

/// Keyframes of the first part, and of both.
const FIRST: usize = 12;
const ALL: usize = 24;
/// Of the place of a splat, relative to its distance from the origin.
const SAME_PLACE: f64 = 1e-4;
/// What a view of the old part may lose by being parked and joined.
const MAX_LOSS_DB: f64 = 1.0;

fn filmed() -> Filmed {
    film("room?frames=24&width=96&height=72&speed=3", 1)
}

fn small() -> MapperParams {
    let mut map = params(&[]).mapper();
    map.map.holdout = 0;
    map.train.seeds_per_keyframe = 800;
    map
}

fn map(params: MapperParams) -> Mapper {
    Mapper::new(params, 1, Scale::UP_TO_SCALE, Box::new(CpuEngine::new()))
}

/// The second part has axes and a unit of its own: this from that of the first.
fn second_from_first() -> Similarity {
    Similarity {
        scale: 1.4,
        rotation: DQuat::from_scaled_axis(DVec3::new(0.3, -0.5, 0.2)),
        translation: DVec3::new(1.0, -0.4, 0.7),
    }
}

fn in_submap(view: &View, submap: u32, from_first: &Similarity) -> View {
    let mut view = View {
        submap,
        submap_from_cam: from_first.transform_pose(&view.submap_from_cam),
        ..view.clone()
    };
    view.depth.scale(from_first.scale);
    view
}

fn add(
    map: &mut Mapper,
    filmed: &Filmed,
    range: std::ops::Range<usize>,
    (submap, from_first): (u32, &Similarity),
) {
    let batch = Batch {
        id: range.start as u32,
        n_shared: 0,
        keyframes: filmed.keyframes[range.clone()].to_vec(),
    };
    let views = filmed.views[range].iter();
    let geometry = GeometryBatch {
        views: views.map(|v| in_submap(v, submap, from_first)).collect(),
        ..GeometryBatch::default()
    };
    map.add(Some(&batch), &geometry, None).unwrap();
}

/// The first part, then the second, four keyframes at a time, as a live run gets them.
fn add_both(map: &mut Mapper, filmed: &Filmed, steps: u64) {
    for from in (0..ALL).step_by(4) {
        if from < FIRST {
            add(map, filmed, from..from + 4, (0, &Similarity::IDENTITY));
        } else {
            add(map, filmed, from..from + 4, (1, &second_from_first()));
        }
        map.step(steps, End::Unknown).unwrap();
    }
}

/// Views of the second part's submap are by now in the first one's.
fn gone_over(views: &[View]) -> Vec<PoseUpdate> {
    let update = |view: &View| PoseUpdate {
        keyframe_id: view.keyframe_id,
        submap: 0,
        intrinsics: view.intrinsics,
        submap_from_cam: view.submap_from_cam,
        depth_factor: 1.0 / second_from_first().scale,
    };
    views.iter().map(update).collect()
}

/// A loop: all of the second part is by now in the first one's submap.
fn join(map: &mut Mapper, filmed: &Filmed) {
    let geometry = GeometryBatch {
        revised: gone_over(&filmed.views[FIRST..]),
        is_loop: true,
        ..GeometryBatch::default()
    };
    map.add(None, &geometry, None).unwrap();
}

fn parked(map: &Mapper) -> Vec<(u32, Arc<Snapshot>)> {
    let submaps = map.submap_reports().into_iter();
    submaps
        .filter_map(|submap| Some((submap.id, submap.parked?)))
        .collect()
}

fn of_first(anchor: u32) -> bool {
    (anchor as usize) < FIRST
}

fn psnr(map: &mut Mapper, id: u32) -> f64 {
    let (rendering, photo) = map.render_keyframe(id).unwrap().unwrap();
    rendering.psnr(&photo)
}

#[test]
fn both_submaps_are_mapped_and_the_larger_throws_nothing_away() {
    let filmed = filmed();
    let mut map = map(small());
    for from in (0..FIRST).step_by(4) {
        add(
            &mut map,
            &filmed,
            from..from + 4,
            (0, &Similarity::IDENTITY),
        );
    }
    let first = map.snapshot().unwrap();
    assert!(map.take_correction().is_none());
    add(&mut map, &filmed, 12..16, (1, &second_from_first()));
    assert!(parked(&map).is_empty(), "four keyframes may be a mistake");
    add(&mut map, &filmed, 16..20, (1, &second_from_first()));
    assert_eq!(map.take_correction().unwrap().reason, Reason::Reset);
    add(&mut map, &filmed, 20..24, (1, &second_from_first()));
    let second = map.snapshot().unwrap();
    assert!(
        second
            .splats
            .anchors
            .iter()
            .all(|anchor| !of_first(*anchor))
    );
    assert!(second.splats.len() > 1000, "{}", second.splats.len());
    assert_ne!(second.map_id, first.map_id);
    let submaps: Vec<(u32, usize, bool)> = map
        .submap_reports()
        .iter()
        .map(
            |SubmapReport {
                 id,
                 n_keyframes,
                 is_active,
                 ..
             }| (*id, *n_keyframes, *is_active),
        )
        .collect();
    assert_eq!(submaps, [(1, 12, true), (0, 12, false)]);
    let [(0, old)] = &parked(&map)[..] else {
        panic!("one is parked")
    };
    assert_eq!((old.map_id, &old.poses), (first.map_id, &first.poses));
    assert_eq!(
        (&old.splats, &old.splat_ids),
        (&first.splats, &first.splat_ids)
    );
}

#[test]
fn after_they_join_the_splats_of_both_are_in_the_right_place() {
    let filmed = filmed();
    let mut map = map(small());
    add_both(&mut map, &filmed, 0);
    let [(0, old)] = &parked(&map)[..] else {
        panic!("one is parked")
    };
    let before = map.snapshot().unwrap();
    map.take_correction();
    join(&mut map, &filmed);
    assert!(parked(&map).is_empty());
    let after = map.snapshot().unwrap();
    assert_eq!(after.map_id, old.map_id, "that of its first keyframe");
    let correction = map.take_correction().unwrap();
    assert_eq!(
        (correction.reason, correction.epoch),
        (Reason::Merge, after.epoch)
    );
    assert!(after.epoch > before.epoch && after.revision > before.revision);
    assert_eq!(after.splats.len(), old.splats.len() + before.splats.len());
    assert!(after.splat_ids.is_sorted());
    let back: Vec<usize> = (0..after.splats.len())
        .filter(|ix| of_first(after.splats.anchors[*ix]))
        .collect();
    assert_eq!(back.len(), old.splats.len());
    // The map stays where it was: the first part has come to the second.
    let motion = second_from_first();
    for (was, is) in back.into_iter().enumerate() {
        let point = |mean: [f32; 3]| DVec3::from(mean.map(f64::from));
        let wanted = motion.transform_point(point(old.splats.means[was]));
        let found = point(after.splats.means[is]);
        assert!(
            found.distance(wanted) < SAME_PLACE * wanted.length(),
            "{found} {wanted}"
        );
        let grown = after.splats.log_scales[is][0] - old.splats.log_scales[was][0];
        assert!((grown - 1.4f32.ln()).abs() < 1e-4, "{grown}");
    }
    for (view, pose) in filmed.views.iter().zip(&after.poses) {
        let wanted = motion.transform_pose(&view.submap_from_cam);
        assert!(wanted.translation.distance(pose.world_from_cam.translation) < 1e-4);
        assert!(wanted.angle_to(&pose.world_from_cam) < 1e-4);
    }
    let depth = map.keyframe_views().unwrap()[2].depth.median().unwrap();
    let wanted = 1.4 * filmed.views[2].depth.median().unwrap();
    assert!((depth / wanted - 1.0).abs() < 1e-4, "{depth} {wanted}");
}

/// Two parts of a walk that hardly see the same, each trained on before they join.
#[test]
fn a_view_of_the_old_part_is_as_good_after_parking_and_joining() {
    let filmed = film("corridor?frames=96&speed=0.8&width=96&height=72", 4);
    let mut map = map(small());
    for from in (0..FIRST).step_by(4) {
        add(
            &mut map,
            &filmed,
            from..from + 4,
            (0, &Similarity::IDENTITY),
        );
        map.step(60, End::Unknown).unwrap();
    }
    let of_old = |map: &mut Mapper| [1, 3, 5].map(|id| psnr(map, id));
    let before = of_old(&mut map);
    for from in (FIRST..ALL).step_by(4) {
        add(&mut map, &filmed, from..from + 4, (1, &second_from_first()));
        map.step(60, End::Unknown).unwrap();
    }
    assert!(map.render_keyframe(3).unwrap().is_none(), "it is parked");
    join(&mut map, &filmed);
    let joined = of_old(&mut map);
    map.step(120, End::Unknown).unwrap();
    let trained = of_old(&mut map);
    eprintln!("before {before:.2?} dB, joined {joined:.2?} dB, trained on {trained:.2?} dB");
    for (before, joined) in before.iter().zip(&joined) {
        assert!(
            *joined > before - MAX_LOSS_DB,
            "{before:.2} -> {joined:.2} dB"
        );
    }
    let mean = |all: &[f64]| all.iter().sum::<f64>() / all.len() as f64;
    assert!(
        mean(&trained) > mean(&before),
        "views of the old part are trained on again"
    );
}

#[test]
fn a_camera_that_comes_back_to_a_parked_submap_goes_on_with_it() {
    let filmed = filmed();
    let mut map = map(small());
    // The last eight keyframes are of the first submap again, as geometry found it anew.
    add(&mut map, &filmed, 0..8, (0, &Similarity::IDENTITY));
    let first = map.snapshot().unwrap();
    add(&mut map, &filmed, 8..16, (1, &second_from_first()));
    assert_eq!(parked(&map)[0].0, 0);
    add(&mut map, &filmed, 16..24, (0, &Similarity::IDENTITY));
    assert_eq!(parked(&map)[0].0, 1);
    let again = map.snapshot().unwrap();
    assert_eq!(again.map_id, first.map_id);
    assert_eq!(again.poses.len(), 16);
    assert_eq!(again.poses[..8], first.poses[..]);
    assert!(again.splats.len() > first.splats.len());
    assert_eq!(
        again.splats.means[..first.splats.len()],
        first.splats.means[..]
    );
}

#[test]
fn at_the_end_the_map_is_the_largest_submap() {
    let filmed = filmed();
    let mut map = map(small());
    add(&mut map, &filmed, 0..16, (0, &Similarity::IDENTITY));
    let first = map.snapshot().unwrap();
    add(&mut map, &filmed, 16..24, (1, &second_from_first()));
    assert_eq!((map.n_keyframes(), map.n_mapped_keyframes()), (8, 24));
    map.settle_on_largest().unwrap();
    assert_eq!(map.n_keyframes(), 16);
    assert_eq!(map.snapshot().unwrap().splats, first.splats);
    let [(1, _)] = &parked(&map)[..] else {
        panic!("the smaller one is parked")
    };
    map.settle_on_largest().unwrap();
    assert_eq!(map.n_keyframes(), 16, "it stays");
}

#[test]
fn the_cap_on_splats_is_for_all_submaps_together() {
    let filmed = filmed();
    let mut params = small();
    params.map.max_splats = 3000;
    let mut map = map(params);
    add_both(&mut map, &filmed, 0);
    let [(0, old)] = &parked(&map)[..] else {
        panic!("one is parked")
    };
    let (old, new) = (old.splats.len(), map.n_splats());
    assert!(old + new <= 3000, "{old} + {new}");
    // Each has half of the keyframes.
    assert!((1400..=1600).contains(&old) && new > 1000, "{old} + {new}");
    join(&mut map, &filmed);
    assert!(map.n_splats() <= 3000 && map.n_splats() > 2000);
}

#[test]
fn parked_submaps_that_join_each_other_are_parked_as_one() {
    let filmed = filmed();
    let mut map = map(small());
    add(&mut map, &filmed, 0..8, (0, &Similarity::IDENTITY));
    add(&mut map, &filmed, 8..16, (1, &second_from_first()));
    add(&mut map, &filmed, 16..24, (2, &Similarity::IDENTITY));
    let [(0, a), (1, b)] = &parked(&map)[..] else {
        panic!("two are parked")
    };
    let geometry = GeometryBatch {
        revised: gone_over(&filmed.views[8..16]),
        ..GeometryBatch::default()
    };
    map.add(None, &geometry, None).unwrap();
    let [(0, both)] = &parked(&map)[..] else {
        panic!("one is parked")
    };
    assert_eq!(both.map_id, a.map_id);
    assert_eq!(both.splats.len(), a.splats.len() + b.splats.len());
    assert!(both.splat_ids.is_sorted());
    let back = second_from_first().inverse();
    let of_second = (0..both.splats.len()).filter(|ix| both.splats.anchors[*ix] >= 8);
    for (was, is) in of_second.enumerate() {
        let point = |mean: [f32; 3]| DVec3::from(mean.map(f64::from));
        let wanted = back.transform_point(point(b.splats.means[was]));
        assert!(point(both.splats.means[is]).distance(wanted) < 1e-3);
    }
}

#[test]
fn a_device_that_is_lost_costs_no_parked_submap() {
    let filmed = filmed();
    let mut map = map(small());
    add_both(&mut map, &filmed, 10);
    let before = parked(&map);
    map.recover(Box::new(CpuEngine::new())).unwrap();
    assert_eq!(parked(&map), before);
    map.step(5, End::Unknown).unwrap();
    join(&mut map, &filmed);
    assert!(parked(&map).is_empty());
    let after = map.snapshot().unwrap();
    let n_back = after
        .splats
        .anchors
        .iter()
        .filter(|anchor| of_first(**anchor));
    assert_eq!(n_back.count(), before[0].1.splats.len());
    let old = psnr(&mut map, 2);
    map.step(60, End::Unknown).unwrap();
    let new = psnr(&mut map, 2);
    assert!(
        new > old,
        "views of the old part are trained on: {old:.2}, {new:.2} dB"
    );
}

#[test]
fn images_of_parked_keyframes_leave_memory_first_and_come_back_in_the_units_of_the_map() {
    let filmed = filmed();
    let mut params = small();
    params.map.max_resident_keyframes = 14;
    let pages = PageFile::new(None, params.map.max_page_file_mib << 20);
    let mut map = map(params).paging_to(Box::new(pages));
    add_both(&mut map, &filmed, 20);
    let budgets = map.budgets();
    assert_eq!(budgets.images_lost, 0);
    assert!(map.has_all_images(), "those of the map stay");
    join(&mut map, &filmed);
    assert!(map.budgets().peak_keyframes_in_ram <= 14);
    let (before, n) = (psnr(&mut map, 2), map.n_splats());
    // They take turns: depth of another unit would push splats away.
    for _ in 0..8 {
        map.step(50, End::Unknown).unwrap();
    }
    let after = psnr(&mut map, 2);
    eprintln!(
        "{before:.2} -> {after:.2} dB, {n} -> {} splats",
        map.n_splats()
    );
    assert!(after > before, "{before:.2} -> {after:.2} dB");
    assert_eq!(map.budgets().images_lost, 0);
}
