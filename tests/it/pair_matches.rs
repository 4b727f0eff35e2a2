//! Matches between pairs of keyframes that models of windows and of known poses report, and what the epipolar loss makes of them.

use glam::DVec2;

use crate::ground_truth::{batch, known, numbered, room};
use splat_geometry::answer::PairMatches;
use splat_geometry::ground_truth::params::GroundTruthParams;
use splat_geometry::model::GeometryModel as _;
use splat_mapper::params::params::Params;
use splat_mapper::params::settings::Settings;
use splat_types::frame::Frame;

/// Median distance of a match from where the true depth of the first image lands in the second, px of 320: corners lie on whole pixels
/// of coarser levels too.
const MAX_MEDIAN_PX: f64 = 1.0;

fn params() -> Params {
    Settings::shipped().params().unwrap()
}

/// Distances of matches from the truth, where it has depth.
fn errors_px(found: &[PairMatches], frames: &[Frame]) -> Vec<f64> {
    let mut errors = Vec::new();
    for pair in found {
        let [first, second] = pair.keyframe_ids.map(|id| &frames[id as usize]);
        let (lens, depth) = (
            first.intrinsics.unwrap(),
            first.sensor_depth.as_ref().unwrap(),
        );
        let second_from_first = second.truth.unwrap().inverse() * first.truth.unwrap();
        for &[p, q] in &pair.pixels {
            let px = DVec2::new(f64::from(p[0]), f64::from(p[1]));
            let at = |px: f64, of: u32, side: u32| (px * f64::from(side) / f64::from(of)) as usize;
            let x = at(px.x, lens.width_px, depth.width_px);
            let cell = at(px.y, lens.height_px, depth.height_px) * depth.width_px as usize + x;
            let point = lens.ray_in_cam(px) * f64::from(depth.depth[cell]);
            let there = second_from_first.transform_point(point);
            let landed = second.intrinsics.unwrap().project(there).unwrap();
            errors.push(landed.distance(DVec2::new(f64::from(q[0]), f64::from(q[1]))));
        }
    }
    errors.sort_by(f64::total_cmp);
    errors
}

pub fn check(found: &[PairMatches], frames: &[Frame], what: &str) {
    assert!(!found.is_empty(), "{what}: no pairs");
    for pair in found {
        let [first, second] = pair.keyframe_ids;
        assert!(first < second, "{what}: {first}, {second}");
        assert!(
            (8..=64).contains(&pair.pixels.len()),
            "{what}: {}",
            pair.pixels.len()
        );
    }
    let errors = errors_px(found, frames);
    let median = errors[errors.len() / 2];
    assert!(median < MAX_MEDIAN_PX, "{what}: median {median:.2} px");
}

fn ids(found: &[PairMatches]) -> Vec<[u32; 2]> {
    found.iter().map(|pair| pair.keyframe_ids).collect()
}

#[test]
fn known_poses_report_each_pair_once_and_link_batches() {
    let (frames, extent) = room();
    let mut known = known(params().ground_truth, extent)
        .with_matches(&params().sfm)
        .unwrap();
    let numbered = numbered(&frames, true);
    let first = known
        .infer(&batch(0, 0, &numbered[..4]))
        .unwrap()
        .pair_matches;
    check(&first, &frames, "first");
    let second = known
        .infer(&batch(1, 0, &numbered[4..]))
        .unwrap()
        .pair_matches;
    check(&second, &frames, "second");
    let is_link = |pair: &[u32; 2]| pair[0] < 4 && pair[1] >= 4;
    assert!(ids(&second).iter().any(is_link), "{:?}", ids(&second));
    assert!(ids(&second).iter().all(|pair| !ids(&first).contains(pair)));
}

#[test]
fn known_poses_whose_depth_comes_late_report_their_matches_then() {
    let (frames, extent) = room();
    let mut known = known(params().ground_truth, extent)
        .with_matches(&params().sfm)
        .unwrap();
    let bare = numbered(&frames, false);
    let mut found = known.infer(&batch(0, 0, &bare[..5])).unwrap().pair_matches;
    found.extend(known.infer(&batch(1, 2, &bare[3..])).unwrap().pair_matches);
    check(&found, &frames, "by stereo");
}

#[test]
fn windows_report_their_matches() {
    let (frames, extent) = room();
    let all = params();
    let noise = GroundTruthParams {
        windows: true,
        rotation_noise_deg: 0.3,
        translation_noise: 0.01,
        ..all.ground_truth
    };
    let mut known = known(noise, extent)
        .in_windows(&all.align, &all.sfm)
        .unwrap();
    let numbered = numbered(&frames, true);
    let first = known
        .infer(&batch(0, 0, &numbered[..5]))
        .unwrap()
        .pair_matches;
    check(&first, &frames, "first");
    let second = known
        .infer(&batch(1, 2, &numbered[3..]))
        .unwrap()
        .pair_matches;
    check(&second, &frames, "second");
    assert!(ids(&second).iter().all(|pair| !ids(&first).contains(pair)));
}
