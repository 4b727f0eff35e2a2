//! Inputs that go wrong for a while: a frozen image, the dark, a camera that is carried elsewhere, frames that are lost or
//! late, few and many of them. Afterwards frames are tracked again, and no reported pose is wrong.
//!
//! The node runs on its threads as in a replay, where nothing depends on how fast they are, and once live.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::{Arc, OnceLock};

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use splat_geometry::similarity;
use splat_io::frame_source::{Source, SourceCounts};
use splat_io::intake::{Extras, Intake};
use splat_mapper::node::engines::Engines;
use splat_mapper::node::job::{Job, Outcome};
use splat_mapper::node::pipeline;
use splat_mapper::node::stop::Stop;
use splat_mapper::params::params::Params;
use splat_mapper::params::settings::Settings;
use splat_slam::track::history::FrameTrack;
use splat_synth::settings::{SceneKind, SynthSettings};
use splat_synth::take::Take;
use splat_types::camera::{CameraModel, Distortion};
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::time::Stamp;
use splat_types::tracking::TrackState;
use splat_types::transform::{Rigid, extent};

const RATE: u32 = 15;
/// A walk of eight seconds, half way round the table.
const N_FRAMES: u32 = 120;
/// Two seconds in the middle of it.
const DISTURBED: Range<usize> = 60..90;
/// From then on frames must be tracked again: a second after they show the room.
const AGAIN: usize = DISTURBED.end + RATE as usize;
/// Shares of the path's extent by which poses may be off.
#[derive(Clone, Copy)]
struct Limits {
    /// Reported when the frame came.
    reported: f64,
    /// Known in the end.
    known: f64,
}

/// Undisturbed both are 0.4 %.
const LIMITS: Limits = Limits {
    reported: 0.03,
    known: 0.03,
};
/// Early poses of a live run, by a map of few keyframes, are up to 4 % off on two cores that do other things besides.
const LIVE_LIMITS: Limits = Limits {
    reported: 0.1,
    known: 0.03,
};
/// Share of the frames that must have a pose when they come, where nothing is in the way.
const MIN_TRACKED: f64 = 0.9;

fn settings(seed: u64, rate: u32) -> SynthSettings {
    SynthSettings {
        width_px: 320,
        height_px: 240,
        noise: 2.0,
        speed: 0.5,
        rate: Some(rate.into()),
        seed,
        ..SynthSettings::of(SceneKind::Room)
    }
}

fn frames(settings: SynthSettings, numbers: Range<u32>) -> Vec<Frame> {
    let take = Take::new(settings).unwrap();
    let frame = |ix: u32| Frame {
        seq: ix.into(),
        stamp: take.stamp(ix),
        image: Arc::new(take.image(ix)),
        intrinsics: Some(take.settings().lens().intrinsics),
        truth: Some(take.pose(ix)),
        odometry: None,
        imu: None,
        sensor_depth: None,
        second: None,
        is_held_out: false,
    };
    numbers.map(frame).collect()
}

fn walk() -> Vec<Frame> {
    static FRAMES: OnceLock<Vec<Frame>> = OnceLock::new();
    FRAMES
        .get_or_init(|| frames(settings(0, RATE), 0..N_FRAMES))
        .clone()
}

/// The walk with another image while it is disturbed.
fn walk_showing(image: &Arc<RgbImage>) -> Vec<Frame> {
    let mut frames = walk();
    for frame in &mut frames[DISTURBED] {
        frame.image = Arc::clone(image);
    }
    frames
}

/// Hands out images as they come, by the rules that all sources share.
struct Camera {
    images: VecDeque<Frame>,
    intake: Intake,
}

impl Source for Camera {
    fn next(&mut self) -> Option<Frame> {
        loop {
            let image = self.images.pop_front()?;
            let Some(arrival) = self.intake.arrive(image.stamp) else {
                continue;
            };
            let extras = Extras {
                truth: image.truth,
                ..Extras::default()
            };
            return self.intake.frame(arrival, (*image.image).clone(), extras);
        }
    }

    fn counts(&self) -> SourceCounts {
        self.intake.counts()
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.images.len() as u64)
    }

    fn truth_extent(&self) -> Option<f64> {
        None
    }
}

fn params() -> Params {
    let mut settings = Settings::shipped();
    // Poses are what matters here: a few steps, on small images.
    for setting in [
        "backend=cpu",
        "map.holdout=0",
        "train.steps=20",
        "train.max_side=64",
        "train.seeds_per_keyframe=100",
    ] {
        settings.merge_setting(setting).unwrap();
    }
    settings.params().unwrap()
}

fn run(images: &[Frame], is_live: bool) -> Outcome {
    let mut params = params();
    params.source.rate = f64::from(u8::from(is_live));
    let lens = CameraModel {
        intrinsics: images[0].intrinsics.unwrap(),
        distortion: Distortion::None,
    };
    let source = Box::new(Camera {
        images: images.to_vec().into(),
        intake: Intake::new(&params.source, Some(lens)),
    });
    let job = Job {
        source,
        params,
        is_live,
        stop: Stop::default(),
        out: None,
        output: None,
        engines: Engines::default(),
    };
    let outcome = pipeline::run(job, &mut |_| ()).unwrap();
    assert_eq!(outcome.error, None);
    outcome
}

/// A reported pose, and where the camera was.
type Reported = (Stamp, Rigid, Rigid);

/// The largest distance from the truth after the best similarity, as a share of the extent of all that was filmed.
fn worst(images: &[Frame], reported: &[Reported]) -> (f64, Option<Stamp>) {
    let points: Vec<(DVec3, DVec3)> = reported
        .iter()
        .map(|(_, truth, pose)| (truth.translation, pose.translation))
        .collect();
    let Some(fit) = similarity::of_points(&points) else {
        return (0.0, None);
    };
    let way: Vec<DVec3> = images
        .iter()
        .map(|f| f.truth.unwrap().translation)
        .collect();
    let size = extent(&way);
    let off = |(truth, pose): &(DVec3, DVec3)| fit.transform_point(*pose).distance(*truth) / size;
    let errors = points
        .iter()
        .map(off)
        .zip(reported.iter().map(|reported| Some(reported.0)));
    errors.fold((0.0, None), |a, b| if b.0 > a.0 { b } else { a })
}

/// No pose is wrong: neither those reported when frames came, nor what is known of them in the end, nor those of keyframes.
fn assert_none_is_wrong(what: &str, images: &[Frame], outcome: &Outcome, limits: Limits) {
    let truth = |stamp: Stamp| {
        let shown = images.iter().find(|frame| frame.stamp == stamp);
        shown.unwrap().truth.unwrap()
    };
    let tracks = &outcome.tracking.tracks.frames;
    let reported = |pose: &dyn Fn(&FrameTrack) -> Option<Rigid>| -> Vec<Reported> {
        let reported = tracks.iter();
        reported
            .filter_map(|t| pose(t).map(|pose| (t.stamp, truth(t.stamp), pose)))
            .collect()
    };
    let keyframes = outcome.snapshot.poses.iter();
    let keyframes = keyframes.map(|k| (k.stamp, truth(k.stamp), k.world_from_cam));
    let all = [
        ("when it came", limits.reported, reported(&|t| t.live)),
        ("in the end", limits.known, reported(&|t| t.refined)),
        ("as a keyframe", limits.known, keyframes.collect()),
    ];
    for (when, limit, reported) in all {
        let (error, at) = worst(images, &reported);
        let n = reported.len();
        eprintln!(
            "{what}: {n} poses {when}, at most {:.2} % off",
            100.0 * error
        );
        assert!(
            error < limit,
            "{what}: a frame is {error} off {when}: {at:?}"
        );
    }
}

fn share_tracked(frames: &[FrameTrack]) -> f64 {
    let tracked = frames.iter().filter(|frame| frame.live.is_some());
    tracked.count() as f64 / frames.len() as f64
}

/// The frames from number `from` on have a pose when they come, in the one map that there is.
fn assert_tracked(what: &str, outcome: &Outcome, from: usize) {
    let frames = &outcome.tracking.tracks.frames[from..];
    let share = share_tracked(frames);
    assert!(share >= MIN_TRACKED, "{what}: {share} of {}", frames.len());
    assert_eq!(outcome.map.submaps().len(), 1, "{what}");
}

/// The loss was noticed, and so was its end; the first keyframes that see the place again may be few.
fn assert_lost_and_found(what: &str, outcome: &Outcome) {
    let tracks = &outcome.tracking.tracks;
    let (lost, found) = (tracks.n_lost, tracks.n_relocalised);
    assert!(
        lost == found && (1..=2).contains(&lost),
        "{what}: {lost} times lost, {found} times found"
    );
}

/// While there is nothing to see, nothing is said to be measured, and what is said gets less certain until it is lost.
fn assert_uncertain(what: &str, frames: &[FrameTrack]) {
    let mut last = 0.0;
    for (ix, frame) in frames.iter().enumerate() {
        assert_eq!(
            (frame.live, frame.refined),
            (None, None),
            "{what}: {frame:?}"
        );
        assert!(frame.reason.is_some());
        let (std, _) = frame.std.unwrap();
        assert!(std > last, "{what}, {ix}: {std} after {last}");
        last = std;
        if ix > RATE as usize / 2 {
            assert_eq!(frame.state, TrackState::Lost, "{what}: half a second");
        }
    }
}

#[test]
fn a_frozen_image_is_no_camera_at_rest() {
    let still = Arc::clone(&walk()[DISTURBED.start - 1].image);
    let images = walk_showing(&still);
    let outcome = run(&images, false);
    assert_none_is_wrong("frozen", &images, &outcome, LIMITS);
    assert_uncertain("frozen", &outcome.tracking.tracks.frames[DISTURBED]);
    assert_tracked("frozen", &outcome, AGAIN);
    assert_lost_and_found("frozen", &outcome);
}

fn black() -> Arc<RgbImage> {
    let mut image = (*walk()[0].image).clone();
    image.pixels.fill(0);
    Arc::new(image)
}

#[test]
fn two_seconds_in_the_dark_end_where_the_camera_has_gone_meanwhile() {
    let images = walk_showing(&black());
    let outcome = run(&images, false);
    assert_none_is_wrong("dark", &images, &outcome, LIMITS);
    assert_uncertain("dark", &outcome.tracking.tracks.frames[DISTURBED]);
    assert_tracked("dark", &outcome, AGAIN);
    assert_lost_and_found("dark", &outcome);
}

/// Of the walk up to there, then of another one (another hand, other noise) through a part of the first.
fn kidnapped() -> Vec<Frame> {
    let mut images = walk();
    let elsewhere = frames(settings(1, RATE), 15..45);
    for (image, other) in images[DISTURBED.end..].iter_mut().zip(elsewhere) {
        *image = Frame {
            stamp: image.stamp,
            ..other
        };
    }
    images
}

#[test]
fn a_camera_that_is_carried_to_a_known_place_is_found_there() {
    let images = kidnapped();
    let outcome = run(&images, false);
    assert_none_is_wrong("kidnapped", &images, &outcome, LIMITS);
    assert_tracked("kidnapped", &outcome, AGAIN);
    assert_lost_and_found("kidnapped", &outcome);
}

#[test]
fn three_of_ten_frames_may_be_lost() {
    let mut random = Pcg32::seed_from_u64(5);
    let mut images = walk();
    images.retain(|_| random.random_range(0.0..1.0) >= 0.3);
    assert!((75..95).contains(&images.len()), "{}", images.len());
    let outcome = run(&images, false);
    assert_none_is_wrong("30 % lost", &images, &outcome, LIMITS);
    assert_tracked("30 % lost", &outcome, RATE as usize);
}

#[test]
fn frames_that_come_late_are_counted_and_left_out() {
    let mut images = walk();
    // Each tenth changes places with the one after it, one comes a second late, and one comes twice.
    let swapped = (10..N_FRAMES as usize - 1).step_by(10);
    let n_late = swapped.len() + 2;
    swapped.for_each(|ix| images.swap(ix, ix + 1));
    let late = images.remove(33);
    images.insert(33 + RATE as usize, late);
    let twice = images[75].clone();
    images.insert(76, twice);
    let outcome = run(&images, false);
    let counts = outcome.input.counts.clone();
    assert_eq!(counts.out_of_order, n_late as u64);
    assert_eq!(counts.received, images.len() as u64);
    let tracks = &outcome.tracking.tracks;
    assert_eq!(tracks.n_frames, (images.len() - n_late) as u64);
    assert!(tracks.frames.is_sorted_by(|a, b| a.stamp < b.stamp));
    assert_none_is_wrong("late", &images, &outcome, LIMITS);
    assert_tracked("late", &outcome, RATE as usize + 5);
}

#[test]
fn five_frames_a_second_are_enough() {
    let images: Vec<Frame> = walk().into_iter().step_by(3).collect();
    let outcome = run(&images, false);
    assert_none_is_wrong("5 Hz", &images, &outcome, LIMITS);
    assert_tracked("5 Hz", &outcome, 8);
}

#[test]
fn sixty_frames_a_second_are_not_too_many() {
    let images = frames(settings(0, 60), 0..200);
    let outcome = run(&images, false);
    assert_none_is_wrong("60 Hz", &images, &outcome, LIMITS);
    assert_tracked("60 Hz", &outcome, 90);
}

/// Of the walk up to there, then of another world.
fn carried_away() -> Vec<Frame> {
    let mut images = walk();
    let settings = SynthSettings {
        scene: SceneKind::Facade,
        ..settings(0, RATE)
    };
    let elsewhere = frames(settings, DISTURBED.end as u32..N_FRAMES);
    images.truncate(DISTURBED.end);
    images.extend(elsewhere);
    images
}

#[test]
fn a_camera_that_is_carried_to_an_unknown_place_maps_it_on_its_own() {
    let images = carried_away();
    let outcome = run(&images, false);
    let frames = &outcome.tracking.tracks.frames;
    assert_uncertain("carried away", &frames[DISTURBED.end..]);
    let in_room = &images[..DISTURBED.end];
    let submaps = outcome.map.submaps();
    assert!(submaps.len() == 2 && submaps[1] >= 4, "{submaps:?}");
    let is_known = |stamp| in_room.iter().any(|frame| frame.stamp == stamp);
    let keyframes = &outcome.snapshot.poses;
    assert!(keyframes.iter().all(|keyframe| is_known(keyframe.stamp)));
    assert_none_is_wrong("carried away", in_room, &outcome, LIMITS);
}

#[test]
fn a_live_run_measures_nothing_in_the_dark_and_nothing_wrong_after_it() {
    let images = walk_showing(&black());
    let outcome = run(&images, true);
    let in_dark = |t: &&FrameTrack| images[DISTURBED].iter().any(|frame| frame.stamp == t.stamp);
    let mut dark = outcome.tracking.tracks.frames.iter().filter(in_dark);
    assert!(dark.all(|t| t.live.is_none() && t.refined.is_none()));
    assert_none_is_wrong("live, dark", &images, &outcome, LIVE_LIMITS);
}

#[test]
fn a_live_run_reports_nothing_wrong_of_a_camera_that_is_carried_elsewhere() {
    let mut images = kidnapped();
    images.truncate(AGAIN);
    let outcome = run(&images, true);
    assert_none_is_wrong("live, kidnapped", &images, &outcome, LIVE_LIMITS);
}
