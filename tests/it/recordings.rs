//! `record`: what comes in comes back from the file, whole or cut short.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

use crate::camera_script::{Clock, Script, Step, layout, steps_of};
use crate::cameras::{params, room, source_of};
use crate::sources::frames_of;
use splat_image::pixel_format::PixelFormat;
use splat_io::camera::driver::{Coding, Layout};
use splat_io::camera::live::Live;
use splat_io::camera_info;
use splat_io::frame_source::Source;
use splat_io::params::{RecordParams, SourceParams};
use splat_io::recording::item::RecordError;
use splat_io::recording::{Input, Progress, Wanted, record};
use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;
use splat_slam::select::selector::Selector;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;

const CALIBRATION: &str = "image_width: 192
image_height: 144
camera_matrix: {rows: 3, cols: 3, data: [150, 0, 95.5, 0, 150, 71.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.05, 0, 0, 0]}
";

fn record_params() -> RecordParams {
    Settings::shipped().params().unwrap().record
}

/// Records a script, all of it.
fn recorded(script: &Script, url: &str, out: &Path, params: &RecordParams) -> Progress {
    let info = camera_info::of_url(url).unwrap();
    let mut live = Live::open("script".to_owned(), script.opener()).unwrap();
    let asked = Arc::default();
    live.end_when(&asked);
    live.end_after(1.5);
    let input = Input::Camera(Box::new(live), info.map(|(info, _)| Box::new(info)));
    let wanted = Wanted {
        out: out.to_owned(),
        duration_secs: None,
    };
    record(input, &wanted, params, &asked, &mut |_| {}).unwrap()
}

fn jpeg_of(image: &RgbImage) -> Vec<u8> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 90)
        .encode(
            &image.pixels,
            image.width_px,
            image.height_px,
            ExtendedColorType::Rgb8,
        )
        .unwrap();
    bytes
}

fn keyframes(frames: &[Frame]) -> Vec<u64> {
    let mut selector = Selector::new(Settings::shipped().params().unwrap().select);
    let kept = frames
        .iter()
        .filter_map(|frame| selector.push(frame.clone()));
    kept.map(|keyframe| keyframe.frame.seq).collect()
}

fn same_frames(found: &[Frame], expected: &[Frame]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert_eq!((found.seq, found.stamp), (expected.seq, expected.stamp));
        assert!(found.image == expected.image, "frame {}", found.seq);
        assert_eq!(found.intrinsics, expected.intrinsics);
    }
}

#[test]
fn a_replay_of_a_recorded_camera_has_the_frames_and_keyframes_of_a_run_on_it() {
    let folder = tempfile::tempdir().unwrap();
    let url = folder.path().join("camera.yaml");
    std::fs::write(&url, CALIBRATION).unwrap();
    let url = url.to_str().unwrap().to_owned();
    let calibrated = SourceParams {
        camera_info_url: url.clone(),
        max_frames: 12,
        ..params()
    };
    let images = room(12);
    let raw = layout(PixelFormat::Rgb, (192, 144));
    let jpeg = Layout {
        coding: Coding::Mjpeg,
        ..raw
    };
    let jpegs = || {
        let packed = |step: Step, image: &RgbImage| match step {
            Step::Image {
                sequence,
                age_nanos,
                is_damaged,
                ..
            } => Step::Image {
                sequence,
                age_nanos,
                is_damaged,
                bytes: Some(jpeg_of(image)),
            },
            other => other,
        };
        let steps = steps_of(&images, None).into_iter().zip(&images);
        steps
            .map(|(step, image)| packed(step, image))
            .collect::<Vec<_>>()
    };
    for (name, layout, steps) in [
        ("raw", raw, steps_of(&images, None)),
        ("jpeg", jpeg, jpegs()),
    ] {
        let script = || Script::new(layout, Clock::Nanos(0), steps.clone());
        let mut live = source_of(&script(), &calibrated);
        let run: Vec<Frame> = std::iter::from_fn(|| live.next()).collect();
        let out = folder.path().join(format!("{name}.mcap"));
        let done = recorded(&script(), &url, &out, &record_params());
        assert_eq!((done.n_images, done.n_dropped, done.n_files), (12, 0, 1));
        let (replayed, counts) = frames_of(&out, &params());
        assert_eq!(counts.fault, None);
        same_frames(&replayed, &run);
        assert!(keyframes(&run).len() > 2);
        assert_eq!(keyframes(&replayed), keyframes(&run), "{name}");
    }
}

#[test]
fn a_replay_of_any_recorded_source_has_its_frames() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("room.mcap");
    let uri = "synthetic:room?frames=6&width=96&height=72&lens=radial";
    let wanted = Wanted {
        out: out.clone(),
        duration_secs: None,
    };
    let asked = Arc::default();
    let input = || open_source::open_input(uri, &params(), 0, None, &asked).unwrap();
    let done = record(input(), &wanted, &record_params(), &asked, &mut |_| {}).unwrap();
    assert_eq!((done.n_images, done.n_damaged), (6, 0));
    let mut synthetic = open_source::open(uri, &params(), 0).unwrap();
    let expected: Vec<Frame> = std::iter::from_fn(|| synthetic.next()).collect();
    let (found, _) = frames_of(&out, &params());
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(&expected) {
        assert_eq!(found.stamp, expected.stamp);
        assert!(found.image == expected.image);
        let (found, expected) = (found.intrinsics.unwrap(), expected.intrinsics.unwrap());
        assert!((found.cx - expected.cx).abs() < 1e-9 && found.fx == expected.fx);
    }
    // Another recording never takes its place.
    let again = record(input(), &wanted, &record_params(), &asked, &mut |_| {});
    assert!(
        matches!(again, Err(RecordError::Exists { .. })),
        "{again:?}"
    );
}

#[test]
fn files_split_and_old_ones_go() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("drive.mcap");
    let images = room(40);
    let steps = steps_of(&images, None);
    let script = Script::new(layout(PixelFormat::Rgb, (192, 144)), Clock::Nanos(0), steps);
    let limited = RecordParams {
        max_file_mib: 1,
        max_files: 2,
        chunk_kib: 128,
        ..record_params()
    };
    let done = recorded(&script, "", &out, &limited);
    // 83 kB an image: thirteen fill a file.
    assert_eq!(done.n_files, 4);
    let mut names: Vec<String> = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(names, ["drive_2.mcap", "drive_3.mcap"]);
    let (frames, counts) = frames_of(folder.path(), &params());
    assert_eq!((counts.fault, frames.len()), (None, 40 - 2 * 13));
}

#[test]
fn a_recording_that_is_cut_anywhere_loses_at_most_its_last_chunk() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("drive.mcap");
    let steps = steps_of(&room(12), None);
    let script = Script::new(layout(PixelFormat::Rgb, (192, 144)), Clock::Nanos(0), steps);
    // 83 kB an image: a chunk of two.
    let small = RecordParams {
        chunk_kib: 128,
        ..record_params()
    };
    recorded(&script, "", &out, &small);
    let whole = std::fs::read(&out).unwrap();
    let cut = folder.path().join("cut.mcap");
    let mut last = 0;
    for length in (0..whole.len()).step_by(whole.len() / 97) {
        std::fs::write(&cut, &whole[..length]).unwrap();
        let Ok(mut replay) = open_source::open(cut.to_str().unwrap(), &params(), 0) else {
            assert!(last == 0, "{length} of {} bytes", whole.len());
            continue;
        };
        let n_frames = std::iter::from_fn(|| replay.next()).count();
        assert!(n_frames >= last, "{n_frames} frames, {last} with less");
        // In proportion, less the chunk that was under way.
        let share = 12.0 * length as f64 / whole.len() as f64;
        assert!(n_frames as f64 >= share - 4.0, "{n_frames} of {share}");
        last = n_frames;
    }
    assert!(last >= 10, "{last}");
}

fn program(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    command.args(args);
    command
}

#[test]
fn the_program_records_and_says_what_it_has() {
    let folder = tempfile::tempdir().unwrap();
    let out: PathBuf = folder.path().join("room.mcap");
    let uri = "synthetic:room?frames=20&width=96&height=72";
    let path = out.to_str().unwrap();
    let run = |args: &[&str]| program(args).output().unwrap();
    let done = run(&[
        "record",
        "--source",
        uri,
        "--out",
        path,
        "--duration",
        "0.35",
    ]);
    let text = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let n_frames = frames_of(&out, &params()).0.len();
    assert!(
        text.starts_with(&format!("{n_frames} images in ")),
        "{text}"
    );
    assert!(
        (2..20).contains(&n_frames),
        "{n_frames} within 0.35 s of the scene"
    );
    let again = run(&["record", "--source", uri, "--out", path]);
    assert_eq!(again.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&again.stderr).contains("a file of that name is there"));
    let usage = run(&["record", "--source", uri, "--out", path, "--duration", "-1"]);
    assert_eq!(usage.status.code(), Some(2));
}
