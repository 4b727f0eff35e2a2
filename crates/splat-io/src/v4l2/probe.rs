//! A device -> whether it is a camera, and what it offers.

use std::io;
use std::path::Path;
use std::sync::Arc;

use crate::camera::driver::{Coding, Layout};
use crate::camera::modes::{FORMATS, Offer, interval_between, stepped};
use crate::camera_error::CameraError;
use crate::v4l2::answers::{Caps, Intervals, Sizes};
use crate::v4l2::sys::Device;

const CAN_CAPTURE: u32 = 0x1;
const CAN_CAPTURE_PLANES: u32 = 0x1000;
const CAN_STREAM: u32 = 0x0400_0000;

pub(crate) fn letters(fourcc: u32) -> String {
    // The highest bit gives the byte order.
    let bytes = (fourcc & 0x7fff_ffff).to_le_bytes();
    bytes
        .iter()
        .map(|b| char::from(*b))
        .collect::<String>()
        .trim()
        .to_owned()
}

pub(crate) fn can_capture(caps: &Caps) -> bool {
    caps.flags & CAN_CAPTURE != 0 && caps.flags & CAN_STREAM != 0
}

pub(crate) fn open_device(path: &Path) -> Result<(Arc<Device>, Caps), CameraError> {
    let not_camera = |reason: String| CameraError::NotCamera {
        reason,
        path: path.to_owned(),
    };
    let device = Device::open(path).map_err(|e| fault("open the camera", &e, path))?;
    let caps = device.caps().map_err(|e| match e.raw_os_error() {
        Some(libc::ENOTTY | libc::EINVAL) => not_camera("it is no video device".to_owned()),
        _ => fault("ask the camera what it is", &e, path),
    })?;
    if !can_capture(&caps) {
        let reason = if caps.flags & CAN_CAPTURE_PLANES != 0 {
            format!(
                "{} captures in several planes only, which this version does not read",
                caps.card
            )
        } else {
            format!("{} does not capture images", caps.card)
        };
        return Err(not_camera(reason));
    }
    Ok((Arc::new(device), caps))
}

/// What an error of the kernel means for a camera.
pub(crate) fn fault(what: &'static str, error: &io::Error, path: &Path) -> CameraError {
    let path = path.to_owned();
    match error.raw_os_error() {
        Some(libc::ENOENT | libc::ENXIO) => CameraError::Absent { path },
        Some(libc::EBUSY) => CameraError::Busy { path },
        Some(libc::EACCES | libc::EPERM) => CameraError::Permission { path },
        Some(libc::ENODEV) => CameraError::Gone {
            reason: error.to_string(),
            path,
        },
        _ => CameraError::Io {
            what,
            reason: error.to_string(),
            path,
        },
    }
}

/// Sizes and intervals of the formats that can be decoded. Of a range of sizes the one nearest to the wish.
pub(crate) fn offers(device: &Device, (width, height): (u32, u32), rate: f64) -> Vec<Offer> {
    let mut offers = Vec::new();
    for code in device.formats() {
        let Some(format) = FORMATS
            .iter()
            .find(|f| u32::from_le_bytes(f.fourcc) == code)
        else {
            continue;
        };
        let mut sizes = device.sizes(code);
        if sizes.is_empty() {
            // Drivers that list none may still take the wish.
            sizes.push(Sizes::Fixed { width, height });
        }
        for size in sizes {
            let (width_px, height_px) = match size {
                Sizes::Fixed { width, height } => (width, height),
                Sizes::Stepwise {
                    width: w,
                    height: h,
                } => (stepped(width, w), stepped(height, h)),
            };
            let intervals = device.intervals(code, width_px, height_px);
            let intervals = intervals.into_iter().flat_map(|interval| match interval {
                Intervals::Fixed(interval) => vec![interval],
                Intervals::Between(short, long) => {
                    vec![short, interval_between(rate, short, long), long]
                }
            });
            offers.push(Offer {
                format: *format,
                width_px,
                height_px,
                intervals: intervals.filter(|(secs, n)| *secs > 0 && *n > 0).collect(),
            });
        }
    }
    offers
}

pub(crate) fn name_of(layout: &Layout) -> &'static str {
    match layout.coding {
        Coding::Mjpeg => "mjpeg",
        Coding::Raw(format, _) => format.ros_name(),
    }
}
