//! Cameras without a driver: unplugged, hanging, damaged, skipped, stamped, in use; and the map goes on.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::camera_script::{Clock, Script, Step, layout, steps_of, test_image};
use splat_image::pixel_format::PixelFormat;
use splat_io::camera::driver::{Coding, Layout};
use splat_io::camera::live::{CameraStatus, CameraStatusWatch};
use splat_io::camera::source::CameraSource;
use splat_io::camera_error::CameraError;
use splat_io::frame_source::Source;
use splat_io::params::SourceParams;
use splat_mapper::node::engines::Engines;
use splat_mapper::node::job::Job;
use splat_mapper::node::stop::Stop;
use splat_mapper::node::{open_source, pipeline};
use splat_mapper::params::settings::Settings;
use splat_synth::settings::SynthSettings;
use splat_synth::take::Take;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::time::{Stamp, Stopwatch};

const SMALL: (u32, u32) = (32, 24);

pub fn params() -> SourceParams {
    Settings::shipped().params().unwrap().source
}

pub fn source_of(script: &Script, params: &SourceParams) -> CameraSource {
    CameraSource::open("/dev/video9".to_owned(), script.opener(), params).unwrap()
}

fn small(clock: Clock, steps: impl IntoIterator<Item = Step>) -> Script {
    Script::new(layout(PixelFormat::Rgb, SMALL), clock, steps)
}

/// Reads until `n` frames are there.
fn frames(source: &mut CameraSource, n: usize) -> Vec<Frame> {
    (0..n).map(|_| source.next().unwrap()).collect()
}

fn wait_for(
    health: &CameraStatusWatch,
    is_wanted: impl Fn(&CameraStatus) -> bool,
    within: f64,
) -> f64 {
    let watch = Stopwatch::start();
    while !is_wanted(&health.get()) {
        assert!(watch.secs() < within, "{:?} after {within} s", health.get());
        std::thread::yield_now();
    }
    watch.secs()
}

/// Reads on a thread of its own until the script is over; the source comes back.
fn in_background(mut source: CameraSource) -> (Arc<AtomicBool>, impl FnOnce() -> CameraSource) {
    let asked = Arc::new(AtomicBool::new(false));
    source.end_when(&asked);
    let reader = std::thread::Builder::new()
        .spawn(move || {
            while source.next().is_some() {}
            source
        })
        .unwrap();
    (asked, move || reader.join().unwrap())
}

#[test]
fn an_unplugged_camera_is_said_within_a_second_and_goes_on_within_two_of_its_return() {
    let away = 1.0;
    let mut steps: Vec<Step> = (0..5).map(test_image).collect();
    steps.push(Step::Unplugged { secs: away });
    steps.extend((0..5).map(test_image));
    let script = small(Clock::Real, steps);
    let source = source_of(&script, &params());
    let health = source.health();
    let (asked, join) = in_background(source);
    wait_for(&health, |health| !health.is_streaming, 1.0);
    let fault = health.get().fault.unwrap();
    assert!(fault.contains("/dev/video9"), "{fault}");
    let back = wait_for(&health, |health| health.is_streaming, away + 2.0);
    assert!(back > 0.5 * away, "it came back after {back} s");
    asked.store(true, Ordering::Relaxed);
    let counts = join().counts();
    assert_eq!((counts.interruptions, script.n_openings()), (1, 2));
    assert!((6..=10).contains(&counts.received), "{counts:?}");
    assert_eq!((counts.dropped, counts.fault), (0, None));
}

#[test]
fn a_hanging_camera_is_said_within_three_seconds_and_opened_again() {
    let steps = (0..3)
        .map(test_image)
        .chain([Step::Hang])
        .chain((0..3).map(test_image));
    let script = small(Clock::Real, steps);
    let source = source_of(&script, &params());
    let health = source.health();
    let (asked, join) = in_background(source);
    let said = wait_for(&health, |health| !health.is_streaming, 3.0);
    assert!(said > 1.0, "a camera may pause: {said} s");
    assert!(health.get().fault.unwrap().contains("no image for 2."));
    wait_for(&health, |health| health.is_streaming, 2.0);
    asked.store(true, Ordering::Relaxed);
    assert_eq!(join().counts().interruptions, 1);
}

#[test]
fn the_end_comes_soon_after_it_is_asked_for_while_the_camera_is_away() {
    let script = small(
        Clock::Real,
        [test_image(0), Step::Unplugged { secs: 1000.0 }],
    );
    let source = source_of(&script, &params());
    let health = source.health();
    let (asked, join) = in_background(source);
    wait_for(&health, |health| !health.is_streaming, 2.0);
    let watch = Stopwatch::start();
    asked.store(true, Ordering::Relaxed);
    let counts = join().counts();
    assert!(watch.secs() < 0.5, "{} s", watch.secs());
    assert_eq!(counts.received, 1);
}

#[test]
fn damaged_images_and_skipped_numbers_are_counted_and_repeats_are_not() {
    let numbers = [u32::MAX - 1, u32::MAX, 2, 2, 3, 10];
    let mut steps: Vec<Step> = numbers.into_iter().map(test_image).collect();
    steps.insert(
        4,
        Step::Image {
            sequence: 2,
            age_nanos: 0,
            is_damaged: true,
            bytes: None,
        },
    );
    let script = small(Clock::Nanos(0), steps);
    let mut source = source_of(&script, &params());
    assert_eq!(frames(&mut source, 6).len(), 6);
    let counts = source.counts();
    // Two numbers across the wrap, six before the last.
    assert_eq!((counts.dropped, counts.undecodable), (2 + 6, 1));
    assert_eq!((counts.received, counts.out_of_order), (7, 0));
}

#[test]
fn stamps_are_wall_time_and_never_lie_in_the_future() {
    let aged = |age_nanos| Step::Image {
        sequence: 0,
        age_nanos,
        is_damaged: false,
        bytes: None,
    };
    let steps = [aged(40_000_000), aged(-34_000_000), aged(20_000_000_000)];
    let script = small(Clock::Nanos(5), steps);
    let mut source = source_of(&script, &params());
    let stamps: Vec<i64> = frames(&mut source, 3)
        .iter()
        .map(|f| f.stamp.nanos)
        .collect();
    // The script's clock goes on by 100 ms an image, and its wall clock is 1000 s ahead of it.
    let at = |n: i64| 1_000_000_000_000 + 5 + n * 100_000_000;
    assert_eq!(stamps, [at(1) - 40_000_000, at(2), at(3)]);
}

#[test]
fn a_camera_in_use_is_an_error_at_the_start_that_names_the_way_out() {
    let busy = || CameraError::Busy {
        path: "/dev/video9".into(),
    };
    let opener = Box::new(move || Err(busy()));
    let error = CameraSource::open("camera".to_owned(), opener, &params()).unwrap_err();
    let text = error.to_string();
    assert!(
        text.contains("in use") && text.contains("fuser -v /dev/video9"),
        "{text}"
    );
}

#[test]
fn images_that_are_too_short_or_no_jpeg_are_counted_and_the_rest_goes_on() {
    let short = Step::Image {
        sequence: 1,
        age_nanos: 0,
        is_damaged: false,
        bytes: Some(vec![7; 100]),
    };
    let full = |sequence| Step::Image {
        sequence,
        age_nanos: 0,
        is_damaged: false,
        bytes: Some(vec![7; (SMALL.0 * SMALL.1 * 3) as usize]),
    };
    let script = small(Clock::Nanos(0), [full(0), short.clone(), full(2)]);
    let mut source = source_of(&script, &params());
    assert_eq!(frames(&mut source, 2).len(), 2);
    assert_eq!(source.counts().undecodable, 1);
    let jpeg = Layout {
        coding: Coding::Mjpeg,
        ..layout(PixelFormat::Rgb, SMALL)
    };
    let script = Script::new(jpeg, Clock::Nanos(0), [short]);
    let mut source = source_of(
        &script,
        &SourceParams {
            max_frames: 1,
            ..params()
        },
    );
    let asked = Arc::new(AtomicBool::new(false));
    source.end_when(&asked);
    let reader = std::thread::Builder::new()
        .spawn(move || (source.next().is_none(), source.counts().undecodable))
        .unwrap();
    while !script.is_played() {
        std::thread::yield_now();
    }
    asked.store(true, Ordering::Relaxed);
    assert_eq!(reader.join().unwrap(), (true, 1));
}

#[test]
fn uris_of_cameras_that_are_not_there_say_what_to_do() {
    let message = |uri: &str| {
        open_source::open(uri, &params(), 0)
            .err()
            .unwrap()
            .to_string()
    };
    #[cfg(all(feature = "camera-v4l", target_os = "linux"))]
    {
        assert!(message("v4l2:/dev/video4711").contains("no camera is there"));
        assert!(message("v4l2:/dev/null").contains("not a camera"));
    }
    #[cfg(all(
        feature = "camera-v4l",
        not(feature = "camera-nokhwa"),
        target_os = "linux"
    ))]
    {
        let absent = message("webcam:4711");
        assert!(absent.contains("no camera is there") && absent.contains("/dev/video4711"));
        assert!(message("webcam:first").contains("is no source URI"));
    }
    assert!(message("camera:0").contains("v4l2:/dev/video0"));
}

/// Images of a walk through a room.
pub fn room(n_frames: u32) -> Vec<RgbImage> {
    let text = format!("room?frames={n_frames}&width=192&height=144&speed=3");
    let take = Take::new(SynthSettings::parse(&text).unwrap()).unwrap();
    (0..n_frames).map(|ix| take.image(ix)).collect()
}

#[test]
fn a_camera_unplugged_in_the_middle_of_a_run_leaves_the_same_map() {
    let images = room(12);
    let map = |unplugged| {
        let size = layout(PixelFormat::Rgb, (192, 144));
        let script = Script::new(size, Clock::Nanos(0), steps_of(&images, unplugged));
        let mut settings = Settings::shipped();
        // Small and quick: what matters is whether both runs agree.
        for setting in [
            "sequential=true",
            "train.steps=10",
            "source.max_frames=12",
            "backend=cpu",
            "mvs.backend=cpu",
            "mvs.max_side=96",
            "mvs.depth_planes=32",
            "sfm.max_features=600",
            "track.enabled=false",
        ] {
            settings.merge_setting(setting).unwrap();
        }
        let params = settings.params().unwrap();
        let job = Job {
            source: Box::new(source_of(&script, &params.source)),
            params,
            is_live: false,
            stop: Stop::default(),
            out: None,
            output: None,
            engines: Engines::default(),
        };
        let outcome = pipeline::run(job, &mut |_| {}).unwrap();
        let stamps: Vec<Stamp> = outcome
            .snapshot
            .poses
            .iter()
            .map(|pose| pose.stamp)
            .collect();
        (outcome.input.counts.interruptions, stamps, outcome.snapshot)
    };
    let (none, expected_stamps, expected) = map(None);
    let (one, stamps, found) = map(Some(7));
    assert_eq!((none, one), (0, 1));
    assert!(
        expected_stamps.len() > 3,
        "{} keyframes",
        expected_stamps.len()
    );
    assert_eq!(stamps, expected_stamps);
    assert!(found.splats == expected.splats, "the maps differ");
}
