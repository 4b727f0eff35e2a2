//! `sensor_msgs/Image` -> RGB images and depth maps.

use splat_image::codec::{depth_map, depth_of_millimetres};
use splat_image::jpeg::decoder::Jpeg;
use splat_image::limits::{DecodeError, MAX_SIDE, empty, excerpt};
use splat_image::pixel_format::{PixelFormat, Pixels, Rows, YuvColour, to_rgb};
use splat_msgs::ros::{self, CompressedImage, Image};
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;

/// A raw image as RGB. Names are those of `sensor_msgs/image_encodings.hpp` and of V4L2 drivers.
pub fn raw(image: &Image) -> Result<RgbImage, DecodeError> {
    let mut out = empty();
    raw_into(image, &mut out)?;
    Ok(out)
}

/// The same into an image whose memory is used again.
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

/// An `Image` or `CompressedImage` as RGB.
pub(crate) fn decode_into(
    payload: &[u8],
    is_compressed: bool,
    jpeg: &mut Jpeg,
    out: &mut RgbImage,
) -> Result<(), String> {
    if is_compressed {
        let message: CompressedImage = ros::decode(payload).map_err(|e| e.to_string())?;
        return splat_image::codec::compressed_into(&message.data, jpeg, out)
            .map_err(|e| e.to_string());
    }
    let message: Image = ros::decode(payload).map_err(|e| e.to_string())?;
    raw_into(&message, out).map_err(|e| e.to_string())
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
