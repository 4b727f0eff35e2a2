//! The tracker over synthetic scenes whose poses and depth are known exactly.

use std::sync::{Arc, OnceLock};

use glam::{DQuat, DVec3};
use nalgebra::{Matrix6, Vector6};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;
use splat_slam::track::landmarks::{KeyframeView, TriangulatedLandmarks};
use splat_slam::track::params::TrackParams;
use splat_slam::track::tracker::Tracker;
use splat_types::depth::DepthMap;
use splat_types::frame::{Frame, Keyframe};
use splat_types::image::RgbImage;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::tracking::{LostReason, TrackState, TrackedFrame};
use splat_types::transform::Rigid;

/// 10 Hz, at most 2 deg from frame to frame.
const ROOM: &str = "synthetic:room?frames=60&width=320&height=240&speed=0.5";
const FACADE: &str = "synthetic:facade?frames=6&width=320&height=240&speed=0.5";
const KEYFRAME_EVERY: usize = 4;
/// Shares of the depth of the scene, and degrees: half a pixel of 320 is 0.1 deg.
const MAX_SHIFT: f64 = 0.01;
const MAX_TURN_DEG: f64 = 0.3;

fn params() -> TrackParams {
    Settings::shipped().params().unwrap().track
}

fn frames_of(uri: &str) -> Vec<Frame> {
    let params = Settings::shipped().params().unwrap();
    let mut source = open_source::open(uri, &params.source, 0).unwrap();
    std::iter::from_fn(|| source.next()).collect()
}

fn room() -> &'static [Frame] {
    static FRAMES: OnceLock<Vec<Frame>> = OnceLock::new();
    FRAMES.get_or_init(|| frames_of(ROOM))
}

fn view(id: usize, frame: &Frame) -> KeyframeView {
    KeyframeView {
        keyframe: Arc::new(Keyframe {
            id: id as u32,
            frame: frame.clone(),
            age: Stopwatch::start(),
        }),
        world_from_cam: frame.truth.unwrap(),
        intrinsics: frame.intrinsics.unwrap(),
        lens: None,
        depth: Arc::clone(frame.sensor_depth.as_ref().unwrap()),
        landmarks: TriangulatedLandmarks::none(),
        covariance: None,
    }
}

fn views(frames: &[Frame]) -> Vec<KeyframeView> {
    let keyframes = frames.iter().step_by(KEYFRAME_EVERY).enumerate();
    keyframes.map(|(id, frame)| view(id, frame)).collect()
}

fn median_depth(frame: &Frame) -> f64 {
    f64::from(frame.sensor_depth.as_ref().unwrap().median().unwrap())
}

/// (shift as a share of the depth, degrees).
fn error(tracked: &TrackedFrame, frame: &Frame) -> (f64, f64) {
    let (pose, truth) = (tracked.pose.unwrap().world_from_cam, frame.truth.unwrap());
    let shift = (pose.translation - truth.translation).length();
    (
        shift / median_depth(frame),
        pose.angle_to(&truth).to_degrees(),
    )
}

fn is_right(tracked: &TrackedFrame, frame: &Frame) -> bool {
    let (shift, turn) = error(tracked, frame);
    tracked.is_measured() && shift < MAX_SHIFT && turn < MAX_TURN_DEG
}

/// The same image at another time.
fn at(frame: &Frame, seq: u64, secs: f64) -> Frame {
    Frame {
        seq,
        stamp: Stamp::from_nanos(
            frame.stamp.nanos / 1_000_000_000 * 1_000_000_000 + (secs * 1e9) as i64,
        ),
        ..frame.clone()
    }
}

fn black(frame: &Frame) -> Frame {
    let image = RgbImage {
        pixels: vec![0; frame.image.pixels.len()],
        ..(*frame.image).clone()
    };
    Frame {
        image: Arc::new(image),
        ..frame.clone()
    }
}

#[test]
fn every_frame_is_tracked_by_keyframes_that_come_late() {
    let frames = room();
    let all = views(frames);
    let mut tracker = Tracker::new(&params());
    let mut right = 0;
    for (i, frame) in frames.iter().enumerate() {
        // Keyframes get their pose when the camera has gone two keyframes further.
        if i % KEYFRAME_EVERY == 0 {
            let known = (i / KEYFRAME_EVERY).saturating_sub(1).min(all.len());
            tracker.update(&all[..known]);
        }
        let tracked = tracker.track(frame);
        if i >= 2 * KEYFRAME_EVERY {
            assert_eq!(
                tracked.state,
                TrackState::Tracking,
                "{i}: {:?}",
                tracked.reason
            );
            right += usize::from(is_right(&tracked, frame));
        } else {
            assert_eq!(
                (tracked.state, tracked.pose),
                (TrackState::Initialising, None)
            );
        }
    }
    assert!(right >= 50, "{right} of 52");
}

#[test]
fn frames_from_before_the_map_get_their_pose_on_a_second_look() {
    let frames = &room()[..17];
    // Odometry would give poses of its own before there is a map; this is about landmarks.
    let by_landmarks = TrackParams {
        odometry: false,
        ..params()
    };
    let mut tracker = Tracker::new(&by_landmarks);
    for frame in frames {
        assert!(tracker.track(frame).pose.is_none());
    }
    tracker.update(&views(frames));
    assert_eq!(tracker.retry(5), 5);
    let tracks = tracker.finish(|| true);
    assert_eq!((tracks.n_frames, tracks.n_tracked), (17, 0));
    for (track, frame) in tracks.frames.iter().zip(frames) {
        let (pose, truth) = (track.refined.unwrap(), frame.truth.unwrap());
        let shift = (pose.translation - truth.translation).length() / median_depth(frame);
        assert!(shift < MAX_SHIFT && track.live.is_none(), "{shift}");
    }
}

#[test]
fn a_second_look_waits_for_the_depth_of_the_keyframes_beside() {
    let frames = &room()[..25];
    let by_landmarks = TrackParams {
        odometry: false,
        ..params()
    };
    let mut tracker = Tracker::new(&by_landmarks);
    for frame in frames {
        tracker.track(frame);
    }
    // Live, depth comes to the newest keyframe first.
    let all = views(frames);
    let with_depth = |first: usize| -> Vec<KeyframeView> {
        let no_depth = || DepthMap {
            width_px: 0,
            height_px: 0,
            depth: Vec::new(),
            confidence: Vec::new(),
        };
        let views = all.iter().cloned().enumerate();
        let view = |(ix, view): (usize, KeyframeView)| KeyframeView {
            depth: if ix < first {
                Arc::new(no_depth())
            } else {
                view.depth
            },
            ..view
        };
        views.map(view).collect()
    };
    // Keyframes are every fourth: the last two have depth, which makes five frames with the first of them.
    tracker.update(&with_depth(5));
    assert_eq!(tracker.retry(usize::MAX), KEYFRAME_EVERY + 1);
    assert_eq!(tracker.retry(usize::MAX), 0);
    tracker.update(&with_depth(2));
    assert_eq!(tracker.retry(usize::MAX), 3 * KEYFRAME_EVERY);
    tracker.update(&with_depth(0));
    assert_eq!(tracker.retry(usize::MAX), 2 * KEYFRAME_EVERY);
    let tracks = tracker.finish(|| true);
    for (track, frame) in tracks.frames.iter().zip(frames) {
        let (pose, truth) = (track.refined.unwrap(), frame.truth.unwrap());
        let shift = (pose.translation - truth.translation).length() / median_depth(frame);
        assert!(shift < MAX_SHIFT, "{shift}");
    }
}

#[test]
fn a_blackout_is_declared_and_over_as_soon_as_there_is_light() {
    let frames = room();
    let mut tracker = Tracker::new(&params());
    tracker.update(&views(&frames[..40]));
    let first: Vec<TrackedFrame> = frames[..20].iter().map(|f| tracker.track(f)).collect();
    let before = first[19];
    assert!(is_right(&before, &frames[19]));
    let mut last_std = 0.0;
    for i in 0..30 {
        let secs = 2.0 + 0.1 * f64::from(i);
        let tracked = tracker.track(&at(&black(&frames[0]), 20 + i as u64, secs));
        let pose = tracked.pose.unwrap();
        assert!(pose.is_predicted && tracked.reason.is_some());
        let std = pose.covariance[0][0].sqrt();
        assert!(std > last_std, "{i}: {std} after {last_std}");
        last_std = std;
        if i >= 4 {
            assert_eq!(tracked.state, TrackState::Lost, "0.5 s have passed");
        }
    }
    // The camera has gone on in the dark.
    let back = tracker.track(&at(&frames[34], 50, 5.0));
    assert_eq!(back.state, TrackState::Relocalised, "{:?}", back.reason);
    assert!(
        is_right(&back, &frames[34]),
        "{:?}",
        error(&back, &frames[34])
    );
    let next = tracker.track(&at(&frames[35], 51, 5.1));
    assert_eq!(next.state, TrackState::Tracking);
    let tracks = tracker.finish(|| true);
    assert_eq!((tracks.n_lost, tracks.n_relocalised), (1, 1));
}

#[test]
fn an_image_that_comes_again_says_nothing_of_where_the_camera_is() {
    let frames = room();
    let mut tracker = Tracker::new(&params());
    tracker.update(&views(frames));
    frames[..12].iter().for_each(|frame| {
        tracker.track(frame);
    });
    let mut last_std = 0.0;
    // The camera goes on, and its driver hands out the last image; as a copy, as drivers do.
    for i in 12..18 {
        let image = Arc::new((*frames[11].image).clone());
        let tracked = tracker.track(&Frame {
            image,
            ..frames[i].clone()
        });
        let pose = tracked.pose.unwrap();
        assert!(pose.is_predicted && tracked.reason == Some(LostReason::Repeated));
        let std = pose.covariance[0][0].sqrt();
        assert!(std > last_std, "{i}: {std} after {last_std}");
        last_std = std;
    }
    assert_eq!(tracker.state(), TrackState::Lost);
    let back = tracker.track(&frames[18]);
    assert!(
        is_right(&back, &frames[18]),
        "{:?}",
        error(&back, &frames[18])
    );
}

#[test]
fn a_kidnapped_camera_is_noticed_and_never_said_to_be_where_it_is_not() {
    let frames = room();
    let mut tracker = Tracker::new(&params());
    tracker.update(&views(frames));
    for frame in &frames[..10] {
        tracker.track(frame);
    }
    let mut declared = None;
    for i in 0..20 {
        let frame = &frames[34 + i];
        let secs = 1.0 + 0.1 * i as f64;
        let tracked = tracker.track(&at(frame, 10 + i as u64, secs));
        if tracked.is_measured() {
            assert!(
                is_right(&tracked, frame),
                "{i}: {:?}, {} inliers",
                error(&tracked, frame),
                tracked.n_inliers
            );
        }
        if matches!(tracked.state, TrackState::Lost | TrackState::Relocalised) {
            declared = declared.or(Some(i));
        }
    }
    assert!(declared.is_some_and(|i| i <= 4), "{declared:?}");
    assert_eq!(tracker.state(), TrackState::Tracking);
}

#[test]
fn a_place_that_no_keyframe_shows_gives_no_pose() {
    let facade = frames_of(FACADE);
    // Odometry follows a camera as fast as this one through the room, and knows nothing of a map of the facade.
    let walk = frames_of("synthetic:room?frames=25&width=320&height=240");
    for (mapped, seen) in [(room(), &facade), (&facade, &walk)] {
        let mut tracker = Tracker::new(&params());
        tracker.update(&views(mapped));
        for frame in seen {
            let tracked = tracker.track(frame);
            assert!(!tracked.is_measured(), "{} inliers", tracked.n_inliers);
        }
        assert_eq!(tracker.state(), TrackState::Initialising);
    }
}

#[test]
fn the_pose_follows_keyframes_that_the_map_moves_and_rescales() {
    let frames = room();
    let mut tracker = Tracker::new(&params());
    let mut all = views(&frames[..20]);
    tracker.update(&all);
    for frame in &frames[..9] {
        tracker.track(frame);
    }
    let turn = DQuat::from_rotation_z(0.7);
    let moved = |pose: Rigid| {
        Rigid::new(
            turn * pose.rotation,
            turn * pose.translation * 1.5 + DVec3::X,
        )
    };
    for view in &mut all {
        view.world_from_cam = moved(view.world_from_cam);
        let mut depth = (*view.depth).clone();
        depth.depth.iter_mut().for_each(|z| *z *= 1.5);
        view.depth = Arc::new(depth);
    }
    tracker.update(&all);
    let tracked = tracker.track(&frames[9]);
    assert_eq!(tracked.state, TrackState::Tracking, "{:?}", tracked.reason);
    let wanted = moved(frames[9].truth.unwrap());
    let found = tracked.pose.unwrap().world_from_cam;
    assert!(
        (found.translation - wanted.translation).length() < 0.03 && found.angle_to(&wanted) < 0.01
    );
    // Frames that nothing looks at again move with their keyframe, too.
    let tracks = tracker.finish(|| true);
    for (track, frame) in tracks.frames.iter().zip(frames) {
        let (found, wanted) = (track.refined.unwrap(), moved(frame.truth.unwrap()));
        assert!((found.translation - wanted.translation).length() < 0.03);
    }
}

fn gaussian(rng: &mut Pcg32) -> f32 {
    (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0
}

/// Sensor noise of 3 levels.
fn noisy(frame: &Frame, rng: &mut Pcg32) -> Frame {
    let pixels = frame.image.pixels.iter();
    let pixels = pixels.map(|v| (f32::from(*v) + 3.0 * gaussian(rng)).round() as u8);
    let image = RgbImage {
        pixels: pixels.collect(),
        ..(*frame.image).clone()
    };
    Frame {
        image: Arc::new(image),
        ..frame.clone()
    }
}

/// 1 % from pixel to pixel, and 1 % that is the same within each of 8 x 6 cells.
fn noisy_depth(depth: &DepthMap, rng: &mut Pcg32) -> DepthMap {
    let cells: Vec<f32> = (0..48).map(|_| gaussian(rng)).collect();
    let mut out = depth.clone();
    let (w, h) = (depth.width_px as usize, depth.height_px as usize);
    for (i, z) in out.depth.iter_mut().enumerate() {
        let cell = (i / w) * 6 / h * 8 + (i % w) * 8 / w;
        *z *= 1.0 + 0.01 * (cells[cell] + gaussian(rng));
    }
    out
}

/// e^T C^-1 e of the camera in its own axes.
fn nees(tracked: &TrackedFrame, frame: &Frame) -> f64 {
    let pose = tracked.pose.unwrap();
    let off = pose.world_from_cam.inverse() * frame.truth.unwrap();
    let short = if off.rotation.w < 0.0 {
        -off.rotation
    } else {
        off.rotation
    };
    let (rho, theta) = (off.translation, short.to_scaled_axis());
    let error = Vector6::new(rho.x, rho.y, rho.z, theta.x, theta.y, theta.z);
    let covariance = Matrix6::from_fn(|i, j| pose.covariance[i][j]);
    error.dot(&(covariance.try_inverse().unwrap() * error))
}

/// 95 % of chi squared with six degrees of freedom lies between these.
const BAND: (f64, f64) = (1.24, 14.45);
const N_RUNS: u64 = 5;

#[test]
fn stated_covariances_cover_the_errors() {
    let frames = &room()[..40];
    let (mut inside, mut all, mut sum) = (0, 0, 0.0);
    let mut runs_inside = 0;
    for seed in 0..N_RUNS {
        let mut rng = Pcg32::seed_from_u64(seed);
        let mut views = views(frames);
        for view in &mut views {
            let mut keyframe = (*view.keyframe).clone();
            keyframe.frame = noisy(&keyframe.frame, &mut rng);
            view.keyframe = Arc::new(keyframe);
            view.depth = Arc::new(noisy_depth(&view.depth, &mut rng));
        }
        let mut tracker = Tracker::new(&params());
        let (mut of_run, mut n) = (0.0, 0);
        for (i, frame) in frames.iter().enumerate().step_by(3) {
            if i % KEYFRAME_EVERY == 0 {
                continue;
            }
            tracker.update(&views[..(i / KEYFRAME_EVERY).max(1)]);
            let tracked = tracker.track(&noisy(frame, &mut rng));
            if tracked.is_measured() {
                let value = nees(&tracked, frame);
                inside += usize::from((BAND.0..BAND.1).contains(&value));
                (sum, of_run, n, all) = (sum + value, of_run + value, n + 1, all + 1);
            }
        }
        // The mean of n frames, were they independent; those that share a keyframe are not quite.
        let n = f64::from(n);
        runs_inside += usize::from((of_run / n - 6.0).abs() < 1.96 * (12.0 / n).sqrt());
    }
    let (share, mean) = (inside as f64 / all as f64, sum / all as f64);
    eprintln!(
        "NEES {mean:.2} of 6, {share:.3} of frames and {runs_inside} of {N_RUNS} runs in the band"
    );
    assert!(
        share >= 0.85 && (3.0..8.0).contains(&mean),
        "{share} {mean}"
    );
    assert!(
        runs_inside * 10 >= N_RUNS as usize * 8,
        "{runs_inside} of {N_RUNS}"
    );
}

#[test]
fn frames_that_are_no_images_of_the_camera_are_refused_with_a_reason() {
    let frames = room();
    let mut tracker = Tracker::new(&params());
    assert_eq!(
        tracker.track(&frames[0]).reason.unwrap().to_string(),
        "no keyframe has a pose and depth yet"
    );
    tracker.update(&views(&frames[..20]));
    tracker.track(&frames[1]);
    let image = RgbImage {
        width_px: 1,
        height_px: 1,
        pixels: vec![7; 3],
    };
    let mut broken = at(&frames[2], 2, 0.2);
    broken.image = Arc::new(image);
    assert!(!tracker.track(&broken).is_measured());
    let mut unknown = at(&frames[3], 3, 0.3);
    unknown.intrinsics = None;
    assert!(
        is_right(&tracker.track(&unknown), &frames[3]),
        "the keyframes' camera"
    );
    unknown.image = Arc::new(unknown.image.shrunk(200));
    let reason = tracker.track(&unknown).reason.unwrap().to_string();
    assert_eq!(reason, "no calibration for images of 200x150 is known");
    // Stamps that stand still or jump back are no reason to fall over.
    assert!(is_right(
        &tracker.track(&at(&frames[4], 4, 0.3)),
        &frames[4]
    ));
    assert!(tracker.track(&at(&frames[5], 5, -900.0)).pose.is_some());
    tracker.update(&[]);
    assert!(!tracker.track(&frames[6]).is_measured());
}

/// The worst pose of frames in the dark, in standard deviations, where a sensor beside the camera goes on.
fn worst_bridged(frames: &[Frame], dark: std::ops::Range<usize>) -> f64 {
    let all = views(frames);
    let mut tracker = Tracker::new(&params());
    let (mut n_bridged, mut worst) = (0, 0.0_f64);
    for (ix, frame) in frames.iter().enumerate() {
        if ix % KEYFRAME_EVERY == 0 && ix < dark.start {
            tracker.update(&all[..=ix / KEYFRAME_EVERY]);
        }
        let is_dark = dark.contains(&ix);
        let tracked = if is_dark {
            tracker.track(&black(frame))
        } else {
            tracker.track(frame)
        };
        if !is_dark {
            continue;
        }
        let pose = tracked.pose.expect("the sensor goes on");
        assert_eq!(tracked.state, TrackState::Tracking, "frame {ix}");
        assert!(pose.is_predicted && tracked.reason.is_some());
        let off = pose
            .world_from_cam
            .translation
            .distance(frame.truth.unwrap().translation);
        assert!(off < 0.05, "frame {ix}: off by {off} m");
        worst = worst.max(nees(&tracked, frame).sqrt());
        n_bridged += 1;
    }
    assert_eq!(n_bridged, dark.len());
    worst
}

/// A blackout of 1.5 s with odometry that is wrong by a percent of each step: the pose goes on, within what is stated of it, and no
/// frame is without one in the end.
#[test]
fn odometry_bridges_a_blackout_within_its_covariance() {
    let frames = frames_of(&format!("{ROOM}&odometry=0.01"));
    let worst = worst_bridged(&frames, 24..39);
    // Six axes: 4.5 is exceeded once in 400 times where the covariance is right.
    assert!(worst < 4.5, "{worst} standard deviations");
    eprintln!("at most {worst:.1} standard deviations off");
}

/// The same with a MEMS sensor's rates and forces, which are integrated twice.
#[test]
fn an_imu_bridges_a_blackout_within_its_covariance() {
    let frames = frames_of("synthetic:room?frames=75&width=320&height=240&imu=1");
    let worst = worst_bridged(&frames, 60..75);
    assert!(worst < 4.5, "{worst} standard deviations");
    eprintln!("at most {worst:.1} standard deviations off");
}
