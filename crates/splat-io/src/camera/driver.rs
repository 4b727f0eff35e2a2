//! A camera that is open, whatever drives it: what it sends, and each image in its memory.

use std::time::Duration;

use crate::camera::stamps::ClockReading;
use crate::camera_error::CameraError;
use splat_image::jpeg::decoder::Jpeg;
use splat_image::limits::DecodeError;
use splat_image::pixel_format::{PixelFormat, Pixels, YuvColour, to_rgb};
use splat_types::image::RgbImage;

/// What the images of an open camera are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layout {
    pub width_px: u32,
    pub height_px: u32,
    pub coding: Coding,
    /// Bytes from one row to the next; 0 = rows are packed.
    pub step: u32,
    /// As the camera states it.
    pub rate_hz: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coding {
    Mjpeg,
    Raw(PixelFormat, YuvColour),
}

/// One image, in memory that the camera fills again once this is gone.
#[derive(Debug, Clone, Copy)]
pub struct CapturedImage<'a> {
    pub bytes: &'a [u8],
    /// Counts all images that the camera made, and wraps.
    pub sequence: Option<u32>,
    /// When it was taken, by the camera's clock.
    pub taken_nanos: Option<i64>,
    /// The driver says that its content is wrong.
    pub is_damaged: bool,
    /// Both clocks when it was handed out.
    pub now: ClockReading,
}

/// A camera that is open and sends images.
pub trait Camera: Send {
    fn layout(&self) -> Layout;

    /// The next image; `None` when none came within `wait`.
    fn next(&mut self, wait: Duration) -> Result<Option<CapturedImage<'_>>, CameraError>;

    fn read_clocks(&self) -> ClockReading;
}

/// A camera's image as RGB.
pub fn decode(
    layout: &Layout,
    bytes: &[u8],
    jpeg: &mut Jpeg,
    out: &mut RgbImage,
) -> Result<(), DecodeError> {
    match layout.coding {
        Coding::Mjpeg => jpeg
            .to_rgb(bytes, out)
            .map_err(|reason| DecodeError::Compressed {
                found_bytes: bytes.len(),
                reason,
            }),
        Coding::Raw(format, colour) => {
            let pixels = Pixels {
                width_px: layout.width_px,
                height_px: layout.height_px,
                format,
                colour,
                step: layout.step,
                bytes,
            };
            to_rgb(&pixels, out)
        }
    }
}
