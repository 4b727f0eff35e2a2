//! The capture devices of this machine, and where one of them has gone.

use std::path::{Path, PathBuf};

use crate::camera::modes::{FORMATS, Offer};
use crate::camera_error::CameraError;
use crate::small_file::natural_order;
use crate::v4l2::answers::Caps;
use crate::v4l2::controls;
use crate::v4l2::probe::{can_capture, letters, offers, open_device};
use crate::v4l2::sys::Device;

/// A capture device of this machine.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    pub path: PathBuf,
    /// The camera's own name.
    pub card: String,
    pub bus: String,
    pub driver: String,
    /// Of the formats that can be decoded.
    pub offers: Vec<Offer>,
    /// Of all others, by their four letters.
    pub others: Vec<String>,
    /// Names and ranges of what can be set.
    pub controls: Vec<String>,
}

/// All capture devices, in the order of their numbers; those that cannot be opened with the reason.
pub fn list() -> Vec<(PathBuf, Result<Found, CameraError>)> {
    let wish = (640, 480);
    let devices = nodes().into_iter().map(|path| {
        let found = look_at(&path, wish);
        (path, found)
    });
    // Cameras have further nodes for metadata, and other devices are no cameras at all.
    let is_camera =
        |found: &Result<Found, CameraError>| !matches!(found, Err(CameraError::NotCamera { .. }));
    devices.filter(|(_, found)| is_camera(found)).collect()
}

/// The nodes that video devices have.
fn nodes() -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir("/dev") else {
        return Vec::new();
    };
    let is_video = |name: &str| {
        name.strip_prefix("video")
            .is_some_and(|rest| !rest.is_empty() && rest.bytes().all(|b| b.is_ascii_digit()))
    };
    let mut names: Vec<String> = entries
        .flatten()
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| is_video(name))
        .collect();
    names.sort_by(|a, b| natural_order(a, b));
    names
        .iter()
        .map(|name| Path::new("/dev").join(name))
        .collect()
}

/// The node asked for while a camera of that name is there, else the one where the same camera is plugged in.
/// Never another camera: two of one make are common.
pub(crate) fn place_of(path: &Path, (card, bus): &(String, String)) -> PathBuf {
    let caps_of = |path: &Path| Device::open(path).and_then(|device| device.caps()).ok();
    if caps_of(path).is_some_and(|caps| caps.card == *card) {
        return path.to_owned();
    }
    let is_it = |caps: Caps| caps.card == *card && caps.bus == *bus && can_capture(&caps);
    let elsewhere = nodes()
        .into_iter()
        .find(|node| caps_of(node).is_some_and(is_it));
    elsewhere.unwrap_or_else(|| path.to_owned())
}

fn look_at(path: &Path, wish: (u32, u32)) -> Result<Found, CameraError> {
    let (device, caps) = open_device(path)?;
    let codes = device.formats();
    let is_known = |code: &u32| {
        FORMATS
            .iter()
            .any(|f| u32::from_le_bytes(f.fourcc) == *code)
    };
    Ok(Found {
        path: path.to_owned(),
        card: caps.card,
        bus: caps.bus,
        driver: caps.driver,
        offers: offers(&device, wish, 30.0),
        others: codes
            .iter()
            .filter(|code| !is_known(code))
            .map(|code| letters(*code))
            .collect(),
        controls: controls::listing(&device.controls()),
    })
}
