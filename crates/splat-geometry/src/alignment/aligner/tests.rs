//! A toy world with exact matches: points before cameras on an arc.

use crate::alignment::{register_window, rescale_depth};
use glam::{DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::alignment::aligner::*;
use crate::alignment::matched::{Pair, camera_spread};
use crate::alignment::params::Registration;
use crate::answer::PoseQuality;
use crate::ground_truth::noise::normal3;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

const LENS: Intrinsics = Intrinsics {
    width_px: 640,
    height_px: 480,
    fx: 520.0,
    fy: 530.0,
    cx: 320.0,
    cy: 240.0,
};

/// `n` views of 150 points, turned and shifted by noise but for the first, and the true poses (cam_from_submap).
pub(crate) fn toy(n: usize, noise_deg: f64, shift: f64) -> (Matched, Vec<Rigid>, Vec<Vec<f64>>) {
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let mut uniform = |half: f64| half * (2.0 * rng.random::<f64>() - 1.0);
    let points: Vec<DVec3> = (0..150)
        .map(|_| DVec3::new(uniform(1.2), uniform(0.9), 3.0 + uniform(0.8)))
        .collect();
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    let (mut views, mut truth, mut depths) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..n {
        let along = i as f64 * 0.25;
        let pose = Rigid::exp(
            DVec3::new(-along, 0.05 * along, 0.02),
            DVec3::Y * 0.06 * along,
        );
        let in_cam: Vec<DVec3> = points.iter().map(|p| pose.transform_point(*p)).collect();
        let off = if i == 0 { 0.0 } else { 1.0 };
        let (rho, theta) = (
            normal3(&mut rng) * shift,
            normal3(&mut rng) * noise_deg.to_radians(),
        );
        views.push(WindowView {
            cam_from_submap: Rigid::exp(rho * off, theta * off) * pose,
            lens: LENS,
            is_held: false,
            pixels: in_cam.iter().map(|p| LENS.project(*p).unwrap()).collect(),
        });
        depths.push(in_cam.iter().map(|p| p.z).collect());
        truth.push(pose);
    }
    let all: Vec<(u32, u32)> = (0..150).map(|k| (k, k)).collect();
    let pairs = (0..n).flat_map(|first| {
        let all = &all;
        (first + 1..n).map(move |second| Pair {
            first,
            second,
            features: all.clone(),
        })
    });
    let matched = Matched {
        pairs: pairs.collect(),
        views,
    };
    (matched, truth, depths)
}

fn worst_turn_deg(matched: &Matched, truth: &[Rigid]) -> f64 {
    let angles = matched.views.iter().zip(truth);
    angles
        .map(|(view, pose)| view.cam_from_submap.angle_to(pose).to_degrees())
        .fold(0.0, f64::max)
}

#[test]
fn least_epipolar_error_finds_the_headings_again() {
    let (mut matched, truth, _) = toy(5, 1.0, 0.05);
    let spread = |m: &Matched| {
        let poses: Vec<Rigid> = m.views.iter().map(|s| s.cam_from_submap).collect();
        camera_spread(&poses)
    };
    let (before_px, width) = (
        epipolar::median_error_px(&matched).unwrap(),
        spread(&matched),
    );
    let settings = epipolar::Settings {
        steps: 300,
        moves_focal: false,
        moves_centre: false,
        unit: 3.0,
    };
    epipolar::align(&mut matched, &settings);
    let after_px = epipolar::median_error_px(&matched).unwrap();
    assert!(
        before_px > 5.0 && after_px < 1.0,
        "{before_px} -> {after_px}"
    );
    assert!(
        (spread(&matched) / width - 1.0).abs() < 1e-9,
        "scale is held"
    );
    assert_eq!(
        matched.views[0].cam_from_submap, truth[0],
        "the first is held"
    );
}

#[test]
fn depth_of_an_unknown_unit_gives_exact_poses_and_its_scale() {
    let (mut matched, truth, depths) = toy(5, 1.0, 0.05);
    let tracks = tracks(&matched);
    assert_eq!(tracks.len(), 150);
    let depths: Depths = depths
        .iter()
        .enumerate()
        .map(|(view, all)| {
            let unit = 1.0 + 0.05 * (view as f64 - 2.0);
            all.iter().map(|d| Some(d * unit)).collect()
        })
        .collect();
    let settings = depth_bundle::Settings {
        depth_error: 0.05,
        moves_focal: false,
        turns: true,
    };
    let scales = depth_bundle::align(&mut matched, &tracks, &depths, &settings);
    assert!(worst_turn_deg(&matched, &truth) < 0.02);
    for (view, scale) in scales.iter().enumerate() {
        let unit = 1.0 + 0.05 * (view as f64 - 2.0);
        let common = scales[2];
        // log z - log (z * unit).
        assert!((scale - common + unit.ln()).abs() < 2e-3, "{view}: {scale}");
    }
}

#[test]
fn held_views_stay_and_the_others_come_to_their_frame() {
    let (mut matched, truth, depths) = toy(5, 1.0, 0.05);
    matched.views[1].cam_from_submap = truth[1];
    matched.views[1].is_held = true;
    matched.views[0].is_held = true;
    let tracks = tracks(&matched);
    let depths: Depths = depths
        .iter()
        .map(|all| all.iter().map(|d| Some(d * 0.9)).collect())
        .collect();
    let settings = depth_bundle::Settings {
        depth_error: 0.05,
        moves_focal: false,
        turns: true,
    };
    depth_bundle::align(&mut matched, &tracks, &depths, &settings);
    assert_eq!(matched.views[1].cam_from_submap, truth[1]);
    for (view, pose) in matched.views.iter().zip(&truth) {
        let shift = view.cam_from_submap.inverse().translation - pose.inverse().translation;
        assert!(shift.length() < 2e-3, "{shift}");
    }
}

/// A view of a slanted wall.
fn wall(id: u32, pose: Rigid) -> View {
    let (width_px, height_px) = (64, 48);
    let lens = LENS.resized(width_px, height_px);
    let n = width_px * height_px;
    let depth = |at: u32| {
        let pixel = DVec2::new(
            f64::from(at % width_px) + 0.5,
            f64::from(at / width_px) + 0.5,
        );
        let ray = pose.rotation * lens.ray_in_cam(pixel);
        // The wall z = 4 + 0.3 x + 0.2 sin of the row is not quite plane, so that a turn shows.
        ((4.0 + 0.3 * pose.translation.x - pose.translation.z) / (ray.z - 0.3 * ray.x)) as f32
    };
    View {
        keyframe_id: id,
        submap: 0,
        intrinsics: LENS,
        lens: None,
        submap_from_cam: pose,
        depth: DepthMap {
            width_px,
            height_px,
            depth: (0..n).map(depth).collect(),
            confidence: vec![0.5; n as usize],
        },
        health: PoseQuality::default(),
    }
}

fn walk(ids: std::ops::Range<u32>) -> Vec<View> {
    let pose = |id: u32| {
        let t = f64::from(id);
        Rigid::exp(
            DVec3::new(0.2 * t, 0.02 * t, 0.01 * t * t),
            DVec3::Y * 0.02 * t,
        )
    };
    ids.map(|id| wall(id, pose(id))).collect()
}

/// The window in a frame of its own.
fn moved(views: &[View], scale: f64) -> Vec<View> {
    let frame = views[0].submap_from_cam.inverse();
    let own = |view: &View| {
        let mut view = view.clone();
        view.submap_from_cam = frame * view.submap_from_cam;
        register_window::rescaled(&view, scale)
    };
    views.iter().map(own).collect()
}

#[test]
fn windows_that_fit_share_one_frame_by_points_and_by_poses() {
    for registration in [Registration::Points, Registration::Poses] {
        let mut windows = Windows::new(&AlignParams {
            registration,
            ..AlignParams::default()
        });
        let truth = walk(0..12);
        windows.join(truth[..6].to_vec());
        let second = windows.join(moved(&truth[4..10], 1.4));
        let third = windows.join(moved(&truth[8..12], 0.7));
        assert_eq!(second.shared, [4, 5]);
        for view in second.views.iter().chain(&third.views) {
            let exact = &truth[view.keyframe_id as usize];
            let shift = view.submap_from_cam.translation - exact.submap_from_cam.translation;
            assert!(
                shift.length() < 1e-4,
                "{registration:?} {}: {shift}",
                view.keyframe_id
            );
            assert!((view.depth.depth[7] / exact.depth.depth[7] - 1.0).abs() < 1e-4);
            assert_eq!(view.submap, 0);
        }
    }
}

/// Joins a second window after something was done to it; the submap it ends in, and why.
fn submap_after(change: impl Fn(&mut Vec<View>)) -> (u32, String) {
    let mut windows = Windows::new(&AlignParams::default());
    let truth = walk(0..12);
    windows.join(truth[..6].to_vec());
    let mut second = moved(&truth[4..10], 1.0);
    change(&mut second);
    let joined = windows.join(second);
    let submap = joined.views.last().map_or(9, |view| view.submap);
    (submap, joined.note.unwrap_or_default())
}

#[test]
fn windows_that_do_not_fit_are_submaps_of_their_own_and_say_why() {
    assert_eq!(submap_after(|_| ()), (0, String::new()));
    let check = |change: &dyn Fn(&mut Vec<View>), reason: &str| {
        let (submap, note) = submap_after(change);
        assert!(submap == 1 && note.contains(reason), "{submap}: {note}");
    };
    check(&|w| *w = moved(&walk(4..10), 4.0), "its scale is");
    check(&|w| w.drain(..2).for_each(drop), "shares no keyframe");
    check(
        &|w| w.iter_mut().for_each(|v| v.depth.confidence.fill(0.0)),
        "no depth in common",
    );
    let mirror = |depth: &mut DepthMap| {
        let n = depth.depth.len();
        let spoil = |(at, d): (usize, &mut f32)| *d *= 0.75 + 0.5 * at as f32 / n as f32;
        depth.depth.iter_mut().enumerate().for_each(spoil);
    };
    let (submap, _) = submap_after(|w| w.iter_mut().for_each(|v| mirror(&mut v.depth)));
    assert_eq!(submap, 0, "a third of the surface still agrees");
    let alternate = |depth: &mut DepthMap| {
        let values = depth.depth.iter_mut().enumerate();
        values.for_each(|(at, d)| *d *= [0.5, 1.0, 2.0, 4.0, 0.3][at % 5]);
    };
    check(
        &|w| w.iter_mut().for_each(|v| alternate(&mut v.depth)),
        "of the shared surface agree",
    );
}

#[test]
fn a_lost_shared_keyframe_is_outvoted_by_two_and_not_by_one() {
    let turn = Rigid::exp(DVec3::ZERO, DVec3::X * 0.6);
    let spoil = |w: &mut Vec<View>| w[1].submap_from_cam = w[1].submap_from_cam * turn;
    assert_eq!(submap_after(spoil).0, 1);
    let mut windows = Windows::new(&AlignParams::default());
    let truth = walk(0..12);
    windows.join(truth[..7].to_vec());
    let mut second = moved(&truth[4..10], 1.2);
    spoil(&mut second);
    let joined = windows.join(second);
    assert_eq!(joined.fit.unwrap().keyframe_ids, [4, 6]);
    let shift = joined.views[5].submap_from_cam.translation - truth[9].submap_from_cam.translation;
    assert!(shift.length() < 1e-4, "{shift}");
}

#[test]
fn broken_views_never_reach_the_running_frame() {
    let mut windows = Windows::new(&AlignParams::default());
    let mut views = walk(0..4);
    views[1].submap_from_cam.translation.x = f64::NAN;
    views[2].intrinsics.fx = 0.0;
    views[3].depth.confidence.pop();
    let joined = windows.join(views);
    assert_eq!(joined.views.len(), 1);
    assert!(joined.note.unwrap().contains("3 of 4"));
    assert!(windows.join(Vec::new()).views.is_empty());
}

#[test]
fn a_known_unit_makes_the_first_window_metric_and_all_that_follow() {
    let mut windows = Windows::new(&AlignParams::default());
    windows.set_metres_per_unit(2.0);
    let truth = walk(0..10);
    windows.join(truth[..6].to_vec());
    let second = windows.join(moved(&truth[4..10], 1.3));
    let last = &second.views[5];
    let exact = &truth[9].submap_from_cam.translation;
    assert!((last.submap_from_cam.translation - *exact * 2.0).length() < 1e-3);
    assert!((last.depth.depth[0] / truth[9].depth.depth[0] - 2.0).abs() < 1e-3);
}

#[test]
fn depth_that_others_see_through_loses_its_confidence() {
    let mut views = walk(0..4);
    let at = 24 * 64 + 32;
    views[1].depth.depth[at] *= 0.5;
    rescale_depth::confidence(&mut views, 0.05, 0);
    assert_eq!(views[1].depth.confidence[at], 0.0);
    assert_eq!(views[1].depth.confidence[at + 4], 0.5);
}

#[test]
fn floating_pixels_and_the_least_trusted_fifth_are_masked() {
    let mut depth = walk(0..1).remove(0).depth;
    let confidence = depth.confidence.iter_mut().enumerate();
    confidence.for_each(|(at, c)| *c = 0.2 + 0.01 * (at % 50) as f32);
    for row in 0..48 {
        // A jump from 2 to 4 with one pixel between.
        (0..64).for_each(|x| depth.depth[row * 64 + x] = [2.0, 4.0][usize::from(x > 30)]);
        depth.depth[row * 64 + 30] = 3.0;
    }
    rescale_depth::mask(&mut depth, 0.05);
    assert!((0..48).all(|row| depth.confidence[row * 64 + 30] == 0.0));
    let left = depth.confidence.iter().filter(|c| **c > 0.0).count() as f64;
    let share = left / (63.0 * 48.0);
    assert!((0.77..0.83).contains(&share), "{share}");
}
