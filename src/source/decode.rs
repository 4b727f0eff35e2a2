//! `sensor_msgs/Image`, JPEG and PNG -> RGB pictures and depth maps.
//!
//! Every size is checked against the bytes at hand before memory is taken for it.

use std::io::Cursor;

use crate::frame::{DepthMap, RgbImage};
use crate::ros::Image;
use crate::source::jpeg::Jpeg;
use crate::source::pixels::{PixelFormat, Pixels, Rows, YuvColour, to_rgb};
use image::{ImageDecoder, ImageFormat, ImageReader};

/// Longest side of a picture; an 8K fisheye pair fits.
pub(super) const MAX_SIDE: u32 = 16384;
/// Memory that any small file may ask for (22 megapixels), and how much more per byte of a larger file.
const FREE_BYTES: u64 = 64 << 20;
const BYTES_PER_FILE_BYTE: u64 = 64;
/// No picture takes more, whatever the file's length.
const MAX_BYTES: u64 = 512 << 20;

#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum DecodeError {
    #[error(
        "encoding {found:?}, expected rgb8 bgr8 rgba8 bgra8 mono8 yuyv uyvy nv12 or an 8-bit Bayer pattern"
    )]
    Encoding { found: String },
    #[error("depth encoding {found:?}, expected 16UC1 (mm) or 32FC1 (m)")]
    DepthEncoding { found: String },
    #[error("picture of {width}x{height} px in {encoding}, expected {expected}")]
    Size {
        width: u32,
        height: u32,
        encoding: String,
        expected: &'static str,
    },
    #[error(
        "{found_bytes} bytes for {width}x{height} px with rows of {step}, expected {expected_bytes}"
    )]
    Short {
        found_bytes: usize,
        width: u32,
        height: u32,
        step: u32,
        expected_bytes: u64,
    },
    #[error("compressed picture of {found_bytes} bytes: {reason}")]
    Compressed { found_bytes: usize, reason: String },
}

/// A raw picture as RGB. Names are those of `sensor_msgs/image_encodings.hpp` and of V4L2 drivers.
pub fn raw(image: &Image) -> Result<RgbImage, DecodeError> {
    let mut out = empty();
    raw_into(image, &mut out)?;
    Ok(out)
}

/// The same into a picture whose memory is used again.
pub fn raw_into(image: &Image, out: &mut RgbImage) -> Result<(), DecodeError> {
    let format = PixelFormat::of_ros(&image.encoding).ok_or_else(|| DecodeError::Encoding {
        found: excerpt(&image.encoding),
    })?;
    to_rgb(&pixels_of(image, format), out)
}

fn pixels_of(image: &Image, format: PixelFormat) -> Pixels<'_> {
    Pixels {
        width_px: image.width,
        height_px: image.height,
        format,
        colour: YuvColour::default(),
        step: image.step,
        bytes: &image.data,
    }
}

/// A picture to decode into.
pub fn empty() -> RgbImage {
    RgbImage {
        width_px: 0,
        height_px: 0,
        pixels: Vec::new(),
    }
}

/// JPEG or PNG, told by its first bytes: the `format` text of real drivers says too little.
pub fn compressed(bytes: &[u8]) -> Result<RgbImage, DecodeError> {
    let mut out = empty();
    compressed_into(bytes, &mut Jpeg::default(), &mut out)?;
    Ok(out)
}

/// The same into a picture whose memory is used again.
pub fn compressed_into(
    bytes: &[u8],
    jpeg: &mut Jpeg,
    out: &mut RgbImage,
) -> Result<(), DecodeError> {
    if bytes.starts_with(&[0xff, 0xd8]) {
        return jpeg
            .to_rgb(bytes, out)
            .map_err(|reason| DecodeError::Compressed {
                found_bytes: bytes.len(),
                reason,
            });
    }
    let picture = picture_of(bytes)?.into_rgb8();
    (out.width_px, out.height_px) = picture.dimensions();
    out.pixels = picture.into_raw();
    Ok(())
}

/// A 16-bit grey PNG of millimetres.
pub fn depth_png(bytes: &[u8]) -> Result<DepthMap, DecodeError> {
    let image::DynamicImage::ImageLuma16(picture) = picture_of(bytes)? else {
        return Err(DecodeError::Compressed {
            found_bytes: bytes.len(),
            reason: "depth that is no 16-bit grey PNG".to_owned(),
        });
    };
    let depth = picture.pixels().map(|p| depth_of_millimetres(p.0[0]));
    Ok(depth_map(
        picture.width(),
        picture.height(),
        depth.collect(),
    ))
}

fn picture_of(bytes: &[u8]) -> Result<image::DynamicImage, DecodeError> {
    let fail = |reason: String| DecodeError::Compressed {
        found_bytes: bytes.len(),
        reason,
    };
    let format = image::guess_format(bytes).map_err(|e| fail(e.to_string()))?;
    if format != ImageFormat::Png {
        return Err(fail(format!("{format:?}, expected JPEG or PNG")));
    }
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(memory_for(bytes.len()));
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| fail(e.to_string()))?;
    let (width_px, height_px) = decoder.dimensions();
    let needed = decoder
        .total_bytes()
        .max(u64::from(width_px) * u64::from(height_px) * 3);
    if needed > memory_for(bytes.len()) {
        return Err(fail(format!(
            "{width_px}x{height_px} px, more than its length can hold"
        )));
    }
    let picture = image::DynamicImage::from_decoder(decoder).map_err(|e| fail(e.to_string()))?;
    if width_px == 0 || height_px == 0 {
        return Err(fail("picture without pixels".to_owned()));
    }
    Ok(picture)
}

/// What a compressed picture of so many bytes may take in memory.
pub(super) fn memory_for(n_bytes: usize) -> u64 {
    (FREE_BYTES + BYTES_PER_FILE_BYTE * n_bytes as u64).min(MAX_BYTES)
}

/// Depth in metres; 0 where the sensor had none. Exact by agreement, so confidence is 1 wherever there is a value.
pub fn depth(image: &Image) -> Result<DepthMap, DecodeError> {
    check_sides(image)?;
    let rows = |bytes_per_px| {
        let pixels = pixels_of(image, PixelFormat::Grey);
        let row_bytes = u64::from(image.width) * bytes_per_px;
        Rows::of(&pixels, row_bytes, u64::from(image.height))
    };
    let is_big = image.is_bigendian != 0;
    let depth: Vec<f32> = match image.encoding.as_str() {
        "16UC1" | "mono16" => {
            let metres = |b: &[u8; 2]| {
                depth_of_millimetres(if is_big {
                    u16::from_be_bytes(*b)
                } else {
                    u16::from_le_bytes(*b)
                })
            };
            rows(2)?
                .iter()
                .flat_map(|row| row.as_chunks::<2>().0)
                .map(metres)
                .collect()
        }
        "32FC1" => {
            let metres = |b: &[u8; 4]| {
                if is_big {
                    f32::from_be_bytes(*b)
                } else {
                    f32::from_le_bytes(*b)
                }
            };
            let rows = rows(4)?;
            rows.iter()
                .flat_map(|row| row.as_chunks::<4>().0)
                .map(|b| depth_or_none(metres(b)))
                .collect()
        }
        found => {
            return Err(DecodeError::DepthEncoding {
                found: excerpt(found),
            });
        }
    };
    Ok(depth_map(image.width, image.height, depth))
}

fn depth_map(width_px: u32, height_px: u32, depth: Vec<f32>) -> DepthMap {
    let confidence = depth
        .iter()
        .map(|&d| if d > 0.0 { 1.0 } else { 0.0 })
        .collect();
    DepthMap {
        width_px,
        height_px,
        depth,
        confidence,
    }
}

fn depth_of_millimetres(millimetres: u16) -> f32 {
    // Kinect drivers write 65535 for "none", everyone else 0.
    if millimetres == u16::MAX {
        0.0
    } else {
        f32::from(millimetres) * 0.001
    }
}

fn depth_or_none(metres: f32) -> f32 {
    if metres.is_finite() && metres > 0.0 {
        metres
    } else {
        0.0
    }
}

fn check_sides(image: &Image) -> Result<(), DecodeError> {
    let (width, height) = (image.width, image.height);
    if width > 0 && height > 0 && width <= MAX_SIDE && height <= MAX_SIDE {
        return Ok(());
    }
    Err(DecodeError::Size {
        width,
        height,
        encoding: excerpt(&image.encoding),
        expected: "1 to 16384 px a side",
    })
}

/// A name from outside, short enough for a log line.
pub(super) fn excerpt(name: &str) -> String {
    name.chars().take(40).collect()
}
