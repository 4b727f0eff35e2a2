//! JPEG and PNG -> RGB images and depth maps.
//!
//! Every size is checked against the bytes at hand before memory is taken for it.

use std::io::Cursor;

use image::{ImageDecoder, ImageFormat, ImageReader};

use crate::jpeg::decoder::Jpeg;
use crate::limits::{DecodeError, MAX_SIDE, empty, memory_for};
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;

/// JPEG or PNG, recognised by its first bytes: the `format` text of real drivers says too little.
pub fn compressed(bytes: &[u8]) -> Result<RgbImage, DecodeError> {
    let mut out = empty();
    compressed_into(bytes, &mut Jpeg::default(), &mut out)?;
    Ok(out)
}

/// The same into an image whose memory is used again.
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
    let image = image_of(bytes)?.into_rgb8();
    (out.width_px, out.height_px) = image.dimensions();
    out.pixels = image.into_raw();
    Ok(())
}

/// A 16-bit grey PNG of millimetres.
pub fn depth_png(bytes: &[u8]) -> Result<DepthMap, DecodeError> {
    let (width, height, values) = grey16_png(bytes)?;
    let depth = values.into_iter().map(depth_of_millimetres);
    Ok(depth_map(width, height, depth.collect()))
}

/// Width, height and values of a 16-bit grey PNG.
pub fn grey16_png(bytes: &[u8]) -> Result<(u32, u32, Vec<u16>), DecodeError> {
    let image::DynamicImage::ImageLuma16(image) = image_of(bytes)? else {
        return Err(DecodeError::Compressed {
            found_bytes: bytes.len(),
            reason: "depth that is no 16-bit grey PNG".to_owned(),
        });
    };
    Ok((image.width(), image.height(), image.into_raw()))
}

fn image_of(bytes: &[u8]) -> Result<image::DynamicImage, DecodeError> {
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
    let image = image::DynamicImage::from_decoder(decoder).map_err(|e| fail(e.to_string()))?;
    if width_px == 0 || height_px == 0 {
        return Err(fail("image without pixels".to_owned()));
    }
    Ok(image)
}

/// Depth in metres, 0 where there is none. Exact by agreement: confidence is 1 wherever there is a value.
pub fn depth_map(width_px: u32, height_px: u32, depth: Vec<f32>) -> DepthMap {
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

pub fn depth_of_millimetres(millimetres: u16) -> f32 {
    // Kinect drivers write 65535 for "none", everyone else 0.
    if millimetres == u16::MAX {
        0.0
    } else {
        f32::from(millimetres) * 0.001
    }
}
