//! Visual odometry alone, without a map, on synthetic scenes: how soon it begins, how far it strays, and what it says when
//! it cannot know.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};

use crate::scenes::scene;
use splat_geometry::similarity;
use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;
use splat_slam::visual_odometry::odometry::{OdometryFrame, OdometryState, VisualOdometry};
use splat_slam::working_camera::WorkingCamera;
use splat_types::camera::Intrinsics;
use splat_types::frame::Frame;
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, extent};

fn frames(scene: &str) -> Vec<Frame> {
    let params = Settings::shipped().params().unwrap();
    let mut source = open_source::open(scene, &params.source, 0).unwrap();
    std::iter::from_fn(|| source.next()).collect()
}

fn odometry_of(frames: &[Frame]) -> Vec<OdometryFrame> {
    let mut odometry = VisualOdometry::default();
    let found = frames.iter().map(|frame| {
        let camera = frame.intrinsics.as_ref();
        let camera = camera.and_then(|i| WorkingCamera::of(i, None, (i.width_px, i.height_px)));
        odometry.push(frame, camera.as_ref())
    });
    found.collect()
}

/// RMSE after the best similarity, as a share of the true path's extent, by segment.
fn errors(frames: &[Frame], found: &[OdometryFrame]) -> BTreeMap<u32, (usize, f64)> {
    let mut segments: BTreeMap<u32, Vec<(Rigid, Rigid)>> = BTreeMap::new();
    for (frame, found) in frames.iter().zip(found) {
        if let Some(pose) = found.pose {
            let pair = (frame.truth.unwrap(), pose.odometry_from_cam);
            segments.entry(pose.segment).or_default().push(pair);
        }
    }
    let error = |pairs: &Vec<(Rigid, Rigid)>| {
        let points = pairs.iter().map(|(t, o)| (t.translation, o.translation));
        let points: Vec<_> = points.collect();
        let Some(fit) = similarity::of_points(&points) else {
            return (pairs.len(), f64::INFINITY);
        };
        let squares = points
            .iter()
            .map(|(t, o)| fit.transform_point(*o).distance_squared(*t));
        let rmse = (squares.sum::<f64>() / points.len() as f64).sqrt();
        let way: Vec<_> = points.iter().map(|(t, _)| *t).collect();
        (pairs.len(), rmse / extent(&way))
    };
    let errors = segments.iter().map(|(id, pairs)| (*id, error(pairs)));
    errors.collect()
}

/// What is asked of a run that is followed from its beginning.
#[derive(Clone, Copy)]
struct Bounds {
    /// The first frame with a pose, at the latest.
    first: usize,
    /// Of the frames from there on, so many have a pose.
    percent: usize,
    /// Less than this share of the path's extent.
    error: f64,
}

const BOUNDS: Bounds = Bounds {
    first: 15,
    percent: 95,
    error: 0.03,
};

/// One segment, within the bounds.
fn assert_followed(what: &str, frames: &[Frame], bounds: Bounds) -> Vec<OdometryFrame> {
    let found = odometry_of(frames);
    let first = found.iter().position(|f| f.pose.is_some());
    let first = first.unwrap_or_else(|| panic!("{what}: no frame has a pose"));
    assert!(first <= bounds.first, "{what}: begins with frame {first}");
    let errors = errors(frames, &found);
    assert_eq!(errors.len(), 1, "{what}: one segment: {errors:?}");
    let (n, error) = errors[&1];
    let n_asked = bounds.percent * (frames.len() - first);
    assert!(100 * n >= n_asked, "{what}: {n} poses");
    assert!(
        error < bounds.error,
        "{what}: {:.2} % of the path",
        100.0 * error
    );
    found
}

#[test]
fn a_walk_through_a_room_is_followed_from_the_first_parallax_on() {
    let frames = frames("synthetic:room?frames=90&width=320&height=240");
    let bounds = Bounds {
        error: 0.02,
        ..BOUNDS
    };
    let found = assert_followed("a walk", &frames, bounds);
    for found in found.iter().filter_map(|f| f.pose) {
        assert!((0..6).all(|i| found.covariance[i][i] > 0.0));
    }
    assert_eq!(
        odometry_of(&frames),
        found,
        "the same frames, the same poses"
    );
}

/// The same place, by a camera that was turned half about its axis.
fn upside_down(frame: &Frame) -> Frame {
    let mut image = (*frame.image).clone();
    image.pixels = image
        .pixels
        .chunks_exact(3)
        .rev()
        .flatten()
        .copied()
        .collect();
    let turned = |i: Intrinsics| Intrinsics {
        cx: f64::from(i.width_px) - i.cx,
        cy: f64::from(i.height_px) - i.cy,
        ..i
    };
    let half_turn = Rigid::new(DQuat::from_rotation_z(std::f64::consts::PI), DVec3::ZERO);
    Frame {
        image: image.into(),
        intrinsics: frame.intrinsics.map(turned),
        truth: frame.truth.map(|truth| truth * half_turn),
        ..frame.clone()
    }
}

#[test]
fn after_a_jump_another_segment_begins() {
    let all = frames("synthetic:room?frames=120&width=320&height=240");
    // The camera is lifted from one place of its way and put down at another, upside down.
    let rest = all[80..].iter().map(upside_down);
    let frames: Vec<Frame> = all[..40].iter().cloned().chain(rest).collect();
    let found = odometry_of(&frames);
    let errors = errors(&frames, &found);
    assert!(errors.len() >= 2, "{errors:?}");
    for (segment, (n, error)) in &errors {
        let is_short = *n < 10;
        assert!(
            is_short || *error < 0.03,
            "segment {segment}: {n} frames, {error}"
        );
    }
    let last = found.last().unwrap();
    assert_eq!(last.state, OdometryState::Tracking, "it is tracked again");
}

#[test]
fn a_standing_camera_and_a_blank_wall_have_no_pose_and_the_reason() {
    let frames = frames("synthetic:room?frames=8&width=320&height=240");
    let still: Vec<Frame> = std::iter::repeat_n(frames[0].clone(), 8).collect();
    let found = odometry_of(&still);
    assert!(found.iter().all(|f| f.pose.is_none()));
    assert_eq!(found[7].state, OdometryState::NoParallax);

    let mut blank = frames[0].clone();
    let mut image = (*blank.image).clone();
    image.pixels.fill(90);
    blank.image = image.into();
    let found = odometry_of(&[blank.clone(), blank.clone()]);
    assert_eq!(found[1].state, OdometryState::Blank);

    let mut uncalibrated = frames[0].clone();
    uncalibrated.intrinsics = None;
    let found = odometry_of(&[uncalibrated]);
    assert_eq!(found[0].state, OdometryState::NoCamera);
}

#[test]
fn dim_stripes_that_pass_quickly_are_followed() {
    // Windows on stripes are nearly flat, and repeat; many are dark.
    let frames = frames("synthetic:endless?frames=90&width=640&height=480&step=0.033");
    let bounds = Bounds {
        error: 0.05,
        ..BOUNDS
    };
    assert_followed("stripes", &frames, bounds);
}

#[test]
fn a_drive_of_a_car_is_followed_in_wide_images() {
    let Some(folder) = scene("kitti_vo1") else {
        return;
    };
    let frames = frames(&format!("images:{}", folder.display()));
    let bounds = Bounds {
        first: 6,
        percent: 100,
        error: 0.05,
    };
    assert_followed("a drive", &frames, bounds);
}

#[test]
fn lost_frames_other_rates_and_a_frozen_image_do_not_end_a_segment() {
    let all = frames("synthetic:room?frames=90&width=320&height=240");
    let dropped = all.iter().filter(|f| f.seq * 7 % 10 >= 3);
    let dropped: Vec<Frame> = dropped.cloned().collect();
    assert_eq!(dropped.len(), 63);
    assert_followed("30 % of the frames dropped", &dropped, BOUNDS);
    let half: Vec<Frame> = all.iter().step_by(2).cloned().collect();
    assert_followed("half the rate", &half, BOUNDS);

    // The camera goes on sending its image of frame 40 for a second and a half, then what it sees from there.
    let period = all[1].stamp.secs_since(all[0].stamp);
    let later = |frame: &Frame, n: usize| Frame {
        stamp: Stamp::from_secs(frame.stamp.secs() + n as f64 * period),
        ..frame.clone()
    };
    let frozen = (0..15).map(|n| later(&all[40], n));
    let frozen = all[..40].iter().cloned().chain(frozen);
    let frozen: Vec<Frame> = frozen
        .chain(all[41..].iter().map(|frame| later(frame, 14)))
        .collect();
    assert_followed("a frozen image", &frozen, BOUNDS);
}

#[test]
fn after_a_blackout_another_segment_begins_and_none_is_wrong() {
    let mut frames = frames("synthetic:room?frames=90&width=320&height=240");
    for frame in &mut frames[40..60] {
        let mut dark = (*frame.image).clone();
        dark.pixels.fill(3);
        frame.image = dark.into();
    }
    let found = odometry_of(&frames);
    assert!(
        found[41..60].iter().all(|f| f.pose.is_none()),
        "in the dark nothing is known"
    );
    assert!(found[70..].iter().all(|f| f.pose.is_some()), "light again");
    for (segment, (n, error)) in &errors(&frames, &found) {
        assert!(*n < 5 || *error < 0.03, "segment {segment}: {error}");
    }
}
