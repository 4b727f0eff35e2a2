//! Frames from the world: cameras, recordings, image folders, made-up scenes.
//!
//! A source hands out decoded, undistorted frames in order of arrival and counts what it could not use.

pub mod bag_writer;
pub mod calibration;
pub mod camera;
pub mod camera_info;
pub mod decode;
pub mod images;
pub mod intake;
pub mod jpeg;
pub mod mcap;
pub mod pixels;
pub mod recording;
pub mod rectify;
pub mod ros2;
pub mod scene_formats;
pub mod synthetic;
#[cfg(all(feature = "camera-v4l", target_os = "linux"))]
pub mod v4l2;
#[cfg(feature = "camera-nokhwa")]
pub mod webcam;

mod bag;
mod bag_file;
mod pool;
mod survey;
mod topics;
mod truth;

use std::cmp::Ordering;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use crate::config::SourceParams;
use crate::frame::Frame;
use crate::pose::Rigid;
use crate::source::camera::CameraError;
use crate::source::camera::live::Opener;

/// What a source met so far; copied into `report.json`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SourceCounts {
    /// Messages or files that should have been frames.
    pub received: u64,
    pub undecodable: u64,
    /// Stamps that did not increase; such frames are left out.
    pub out_of_order: u64,
    /// Made and never looked at: the driver skipped their numbers, or they came faster than they were taken.
    pub dropped: u64,
    /// Times that a camera stopped and was opened again.
    pub interruptions: u64,
    /// The fault that ended the input early, for example a truncated recording. Frames before it stay in use.
    pub fault: Option<String>,
}

#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    #[error("cannot open {what}: {reason}; {way_out}: {}", path.display())]
    Open {
        what: &'static str,
        reason: String,
        way_out: &'static str,
        path: PathBuf,
    },
    #[error(
        "{uri:?} is no source URI; expected v4l2:/dev/video0, webcam:0, mcap:PATH, images:DIR, synthetic:SCENE, ros2:/TOPIC or the path of a recording or folder"
    )]
    Uri { uri: String },
    #[error("no topic of type sensor_msgs/msg/Image or CompressedImage; found {found}; name one with --set source.image_topic=/TOPIC: {}", path.display())]
    NoImageTopic { found: String, path: PathBuf },
    #[error("{topic:?} carries {found}, expected sensor_msgs/msg/Image or CompressedImage as cdr: {}", path.display())]
    TopicType {
        topic: String,
        found: String,
        path: PathBuf,
    },
    #[error("{uri:?} is not in this build; {way_out}")]
    NotInBuild { uri: String, way_out: &'static str },
    #[error(transparent)]
    Camera(#[from] CameraError),
    #[cfg(feature = "ros2")]
    #[error("cannot subscribe to {topic:?}: {reason}")]
    Subscribe { topic: String, reason: String },
}

/// What a look for the next frame found.
#[derive(Debug)]
pub enum Polled {
    Frame(Box<Frame>),
    /// None yet; more may come.
    Waiting,
    Ended,
}

/// Hands out frames one at a time.
pub trait Source: Send {
    /// The next frame; `None` at the end of the input. A fault in the middle ends the input and stands in `counts`.
    fn next(&mut self) -> Option<Frame>;

    /// The next frame, if one comes within `patience`. Sources that wait for the world override it.
    fn poll(&mut self, _patience: Duration) -> Polled {
        self.next()
            .map_or(Polled::Ended, |frame| Polled::Frame(Box::new(frame)))
    }

    /// How the camera is mounted on the robot, `base_from_cam` in metres, where the input says so.
    fn mount(&self) -> Option<Rigid> {
        None
    }

    /// Name of the camera's frame, optical axes; empty where the input names none.
    fn camera_frame(&self) -> &str {
        ""
    }

    /// What keeps pictures from coming, a line each.
    fn warnings(&self) -> Vec<String> {
        Vec::new()
    }

    fn counts(&self) -> SourceCounts;

    /// Frames still to come, where the source knows (for the progress bar).
    fn len_hint(&self) -> Option<u64>;

    /// Largest distance between two true camera positions of the whole input, where they are known beforehand.
    fn truth_extent(&self) -> Option<f64>;

    /// Pictures come when the world makes them: those not taken in time are lost, so nothing may wait.
    fn is_live(&self) -> bool {
        false
    }

    /// A source that waits for the world ends `next` with `None` soon after the end is asked for.
    fn end_when(&mut self, _asked: &Arc<AtomicBool>) {}
}

/// Opens the camera of `v4l2:PATH` or `webcam:INDEX`; `None` for a URI that names no camera.
pub fn camera_opener(uri: &str, params: &SourceParams) -> Option<Result<Opener, SourceError>> {
    match uri.split_once(':')? {
        ("v4l2", path) => Some(v4l2_opener(path, params)),
        ("webcam", index) => Some(webcam_opener(index, params)),
        _ => None,
    }
}

#[cfg(all(feature = "camera-v4l", target_os = "linux"))]
#[allow(clippy::unnecessary_wraps, reason = "builds without it refuse")]
fn v4l2_opener(path: &str, params: &SourceParams) -> Result<Opener, SourceError> {
    Ok(v4l2::opener(Path::new(path), params))
}

#[cfg(not(all(feature = "camera-v4l", target_os = "linux")))]
fn v4l2_opener(path: &str, _params: &SourceParams) -> Result<Opener, SourceError> {
    Err(SourceError::NotInBuild {
        uri: format!("v4l2:{path}"),
        way_out: "build with --features camera-v4l on Linux, or with camera-nokhwa elsewhere",
    })
}

#[cfg(feature = "camera-nokhwa")]
fn webcam_opener(index: &str, params: &SourceParams) -> Result<Opener, SourceError> {
    webcam::opener(index, params)
}

#[cfg(not(feature = "camera-nokhwa"))]
fn webcam_opener(index: &str, _params: &SourceParams) -> Result<Opener, SourceError> {
    Err(SourceError::NotInBuild {
        uri: format!("webcam:{index}"),
        way_out: "build with --features camera-nokhwa, or on Linux use v4l2:/dev/video0",
    })
}

/// Opens a camera, `mcap:PATH`, `images:DIR`, `synthetic:SCENE`, or the bare path of a recording or a folder.
pub fn open(uri: &str, params: &SourceParams, seed: u64) -> Result<Box<dyn Source>, SourceError> {
    if let Some(opener) = camera_opener(uri, params) {
        let source = camera::CameraSource::open(uri.to_owned(), opener?, params)?;
        return Ok(Box::new(source));
    }
    let not_in_build = |way_out| {
        Err(SourceError::NotInBuild {
            uri: uri.to_owned(),
            way_out,
        })
    };
    match uri.split_once(':') {
        Some(("mcap", path)) => open_mcap(Path::new(path), params),
        Some(("images", path)) => open_images(Path::new(path), params, seed),
        Some(("synthetic", scene)) => open_synthetic(scene, params, seed),
        #[cfg(feature = "ros2")]
        Some(("ros2", topic)) => Ok(Box::new(ros2::subscriber::Ros2Source::open(topic, params)?)),
        #[cfg(not(feature = "ros2"))]
        Some(("ros2", _)) => not_in_build(
            "build where ROS 2 is sourced, with --features ros2 (docs/ROS2.md), or record the topic with ros2 bag record -s mcap TOPIC and open that recording as mcap:PATH",
        ),
        Some(("zenoh", _)) => not_in_build(
            "record the topic with ros2 bag record -s mcap TOPIC and open that recording as mcap:PATH",
        ),
        _ => open_path(uri, params, seed),
    }
}

fn open_mcap(path: &Path, params: &SourceParams) -> Result<Box<dyn Source>, SourceError> {
    Ok(Box::new(mcap::McapSource::open(path, params)?))
}

fn open_images(
    path: &Path,
    params: &SourceParams,
    seed: u64,
) -> Result<Box<dyn Source>, SourceError> {
    Ok(Box::new(images::ImagesSource::open(path, params, seed)?))
}

fn open_synthetic(
    scene: &str,
    params: &SourceParams,
    seed: u64,
) -> Result<Box<dyn Source>, SourceError> {
    if scene.split('?').next() == Some("endless") {
        return Ok(Box::new(synthetic::endless::EndlessSource::open(scene)?));
    }
    Ok(Box::new(synthetic::SyntheticSource::open(
        scene, params, seed,
    )?))
}

/// A folder is a recording when MCAP files lie in it, else pictures, else a scene with its recording in `rosbag2`.
fn open_path(uri: &str, params: &SourceParams, seed: u64) -> Result<Box<dyn Source>, SourceError> {
    let path = Path::new(uri);
    let is_json = path
        .extension()
        .is_some_and(|extension| extension == "json");
    if path.is_file() && is_json {
        return open_images(path, params, seed);
    }
    if path.is_file() {
        return open_mcap(path, params);
    }
    if !path.is_dir() {
        return Err(SourceError::Uri {
            uri: uri.to_owned(),
        });
    }
    let holds_mcap = |folder: &Path| {
        let is_mcap = |name: PathBuf| {
            name.extension()
                .is_some_and(|extension| extension == "mcap")
        };
        folder.join("metadata.yaml").is_file()
            || std::fs::read_dir(folder)
                .is_ok_and(|entries| entries.flatten().any(|entry| is_mcap(entry.path())))
    };
    if holds_mcap(path) {
        return open_mcap(path, params);
    }
    let inner = path.join("rosbag2");
    let pictures = if images::has_pictures(path) {
        Some(open_images(path, params, seed))
    } else {
        None
    };
    match pictures {
        Some(Ok(source)) => Ok(source),
        _ if holds_mcap(&inner) => open_mcap(&inner, params),
        Some(failed) => failed,
        None => open_mcap(path, params),
    }
}

/// A whole file that must be small; devices and pipes are none.
fn read_small(path: &Path, max_bytes: u64) -> Result<Vec<u8>, String> {
    let metadata = std::fs::metadata(path).map_err(|e| e.to_string())?;
    if !metadata.is_file() {
        return Err("not a regular file".to_owned());
    }
    if metadata.len() > max_bytes {
        return Err(format!(
            "a file of {} bytes, at most {max_bytes} are read",
            metadata.len()
        ));
    }
    let mut bytes = Vec::new();
    let file = std::fs::File::open(path).map_err(|e| e.to_string())?;
    file.take(max_bytes)
        .read_to_end(&mut bytes)
        .map_err(|e| e.to_string())?;
    Ok(bytes)
}

/// Orders names as people count: `frame9` before `frame10`.
fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a, b);
    loop {
        let (digits_a, digits_b) = (leading_digits(a), leading_digits(b));
        let (char_a, char_b) = (a.chars().next(), b.chars().next());
        let order = if digits_a.is_empty() || digits_b.is_empty() {
            char_a.cmp(&char_b)
        } else {
            let (number_a, number_b) = (
                digits_a.trim_start_matches('0'),
                digits_b.trim_start_matches('0'),
            );
            number_a
                .len()
                .cmp(&number_b.len())
                .then_with(|| number_a.cmp(number_b))
        };
        let (Ordering::Equal, Some(char_a), Some(char_b)) = (order, char_a, char_b) else {
            return order;
        };
        a = &a[digits_a.len().max(char_a.len_utf8())..];
        b = &b[digits_b.len().max(char_b.len_utf8())..];
    }
}

fn leading_digits(text: &str) -> &str {
    &text[..text
        .find(|c: char| !c.is_ascii_digit())
        .unwrap_or(text.len())]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_as_people_count() {
        let mut names = [
            "f10.png",
            "f9.png",
            "f1.png",
            "e99.png",
            "f010b.png",
            "f.png",
            "f9",
        ];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(
            names,
            [
                "e99.png",
                "f.png",
                "f1.png",
                "f9",
                "f9.png",
                "f10.png",
                "f010b.png"
            ]
        );
    }
}
