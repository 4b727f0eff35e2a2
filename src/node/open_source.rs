//! A source URI -> the source that it names, opened.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::params::params::Params;
use splat_io::camera::live::{Live, Opener};
use splat_io::camera::source::CameraSource;
use splat_io::camera_info;
use splat_io::error::SourceError;
use splat_io::frame_source::Source;
use splat_io::images::{self, ImagesSource};
use splat_io::mcap::McapSource;
use splat_io::params::SourceParams;
use splat_io::recording::Input;
#[cfg(feature = "zenoh")]
use splat_ros::zenoh::source::ZenohSource;
use splat_synth::endless::EndlessSource;
use splat_synth::source::SyntheticSource;

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
    Ok(splat_io::v4l2::camera::opener(Path::new(path), params))
}

#[cfg(not(all(feature = "camera-v4l", target_os = "linux")))]
fn v4l2_opener(path: &str, _params: &SourceParams) -> Result<Opener, SourceError> {
    Err(SourceError::NotInBuild {
        uri: format!("v4l2:{path}"),
        way_out: "build with --features camera-v4l on Linux; elsewhere use webcam:0",
    })
}

#[cfg(any(feature = "camera-nokhwa", not(target_os = "linux")))]
fn webcam_opener(index: &str, params: &SourceParams) -> Result<Opener, SourceError> {
    splat_io::webcam::opener(index, params)
}

/// The camera that Linux gave this number.
#[cfg(all(
    feature = "camera-v4l",
    not(feature = "camera-nokhwa"),
    target_os = "linux"
))]
fn webcam_opener(index: &str, params: &SourceParams) -> Result<Opener, SourceError> {
    let uri = || format!("webcam:{index}");
    let index: u32 = index
        .parse()
        .map_err(|_not_a_number| SourceError::Uri { uri: uri() })?;
    v4l2_opener(&format!("/dev/video{index}"), params)
}

#[cfg(all(
    not(feature = "camera-v4l"),
    not(feature = "camera-nokhwa"),
    target_os = "linux"
))]
fn webcam_opener(index: &str, _params: &SourceParams) -> Result<Opener, SourceError> {
    Err(SourceError::NotInBuild {
        uri: format!("webcam:{index}"),
        way_out: "build with --features camera-v4l or camera-nokhwa",
    })
}

/// Opens `zenoh:TOPIC`, which connects as `publish.zenoh_*` says, or whatever else `open` does.
pub fn open_for(uri: &str, params: &Params) -> Result<Box<dyn Source>, SourceError> {
    #[cfg(feature = "zenoh")]
    if let Some(topic) = uri.strip_prefix("zenoh:") {
        let source = ZenohSource::open(topic, &params.source, &params.publish)?;
        return Ok(Box::new(source));
    }
    open(uri, &params.source, params.seed)
}

/// Opens a camera, `mcap:PATH`, `images:DIR`, `synthetic:SCENE`, or the bare path of a recording or a folder.
pub fn open(uri: &str, params: &SourceParams, seed: u64) -> Result<Box<dyn Source>, SourceError> {
    if let Some(opener) = camera_opener(uri, params) {
        let source = CameraSource::open(uri.to_owned(), opener?, params)?;
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
        Some(("ros2", topic)) => Ok(Box::new(splat_ros::ros2::subscriber::Ros2Source::open(
            topic, params,
        )?)),
        #[cfg(not(feature = "ros2"))]
        Some(("ros2", _)) => not_in_build(
            "build where ROS 2 is sourced, with --features ros2 (docs/ROS2.md), or record the topic with ros2 bag record -s mcap TOPIC and open that recording as mcap:PATH",
        ),
        Some(("zenoh", _)) => not_in_build(
            "run and localise take it, in builds with --features zenoh; else record the topic with ros2 bag record -s mcap TOPIC and open that recording as mcap:PATH",
        ),
        _ => open_path(uri, params, seed),
    }
}

fn open_mcap(path: &Path, params: &SourceParams) -> Result<Box<dyn Source>, SourceError> {
    Ok(Box::new(McapSource::open(path, params)?))
}

fn open_images(
    path: &Path,
    params: &SourceParams,
    seed: u64,
) -> Result<Box<dyn Source>, SourceError> {
    Ok(Box::new(ImagesSource::open(path, params, seed)?))
}

fn open_synthetic(
    scene: &str,
    params: &SourceParams,
    seed: u64,
) -> Result<Box<dyn Source>, SourceError> {
    if scene.split('?').next() == Some("endless") {
        return Ok(Box::new(EndlessSource::open(scene, params)?));
    }
    Ok(Box::new(SyntheticSource::open(scene, params, seed)?))
}

/// A folder is a recording when MCAP files lie in it, else images, else a scene with its recording in `rosbag2`.
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
    let images = if images::has_images(path) {
        Some(open_images(path, params, seed))
    } else {
        None
    };
    match images {
        Some(Ok(source)) => Ok(source),
        _ if holds_mcap(&inner) => open_mcap(&inner, params),
        Some(failed) => failed,
        None => open_mcap(path, params),
    }
}

/// Opens what is to be recorded: a camera as it comes, with its calibration, or the frames of any other source. It ends
/// when `asked`, a camera also after `duration_secs` of wall time.
pub fn open_input(
    uri: &str,
    params: &SourceParams,
    seed: u64,
    duration_secs: Option<f64>,
    asked: &Arc<AtomicBool>,
) -> Result<Input, SourceError> {
    let Some(opener) = camera_opener(uri, params) else {
        let mut source = open(uri, params, seed)?;
        source.end_when(asked);
        return Ok(Input::Frames(source));
    };
    let info = camera_info::of_url(&params.camera_info_url)?;
    let mut live = Live::open(uri.to_owned(), opener?)?;
    live.end_when(asked);
    if let Some(secs) = duration_secs {
        live.end_after(secs);
    }
    Ok(Input::Camera(
        Box::new(live),
        info.map(|(info, _)| Box::new(info)),
    ))
}
