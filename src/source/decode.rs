//! `sensor_msgs/Image`, JPEG and PNG -> RGB pictures and depth maps.
//!
//! Every size is checked against the bytes at hand before memory is taken for it.

use std::io::Cursor;

use image::{ImageDecoder, ImageFormat, ImageReader};
use kornia_image::color_spaces::BayerPattern;
use kornia_image::{Image as KorniaImage, ImageSize};
use yuv::{YuvBiPlanarImage, YuvConversionMode, YuvPackedImage, YuvRange, YuvStandardMatrix};

use crate::frame::{DepthMap, RgbImage};
use crate::ros::Image;

/// Longest side of a picture; an 8K fisheye pair fits.
const MAX_SIDE: u32 = 16384;
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

/// Rows of a raw picture without their padding.
struct Rows<'a> {
    data: &'a [u8],
    step: usize,
    row_bytes: usize,
    n_rows: usize,
}

impl<'a> Rows<'a> {
    /// `row_bytes` of every row carry pixels; the message's `step` says how far apart rows start.
    fn of(image: &'a Image, row_bytes: u64, n_rows: u64) -> Result<Self, DecodeError> {
        let short = |step: u32, expected_bytes| DecodeError::Short {
            found_bytes: image.data.len(),
            width: image.width,
            height: image.height,
            step,
            expected_bytes,
        };
        // Some drivers leave step 0; then rows are packed.
        let step = if image.step == 0 {
            row_bytes
        } else {
            u64::from(image.step)
        };
        if step < row_bytes {
            return Err(short(image.step, row_bytes));
        }
        // The last row may come without its padding.
        let needed = step * (n_rows - 1) + row_bytes;
        if (image.data.len() as u64) < needed {
            return Err(short(image.step, needed));
        }
        Ok(Self {
            data: &image.data,
            step: step as usize,
            row_bytes: row_bytes as usize,
            n_rows: n_rows as usize,
        })
    }

    /// Rows of packed pixels, as many as the picture is high.
    fn of_pixels(image: &'a Image, bytes_per_px: u64) -> Result<Self, DecodeError> {
        let row_bytes = u64::from(image.width) * bytes_per_px;
        Self::of(image, row_bytes, u64::from(image.height))
    }

    fn iter(&self) -> impl Iterator<Item = &'a [u8]> {
        let (step, row_bytes) = (self.step, self.row_bytes);
        let data = self.data;
        (0..self.n_rows).map(move |row| &data[row * step..row * step + row_bytes])
    }

    /// Each pixel of `N` bytes gives three.
    fn map<const N: usize>(&self, to_rgb: impl Fn(&[u8; N]) -> [u8; 3]) -> Vec<u8> {
        let mut pixels = Vec::with_capacity(self.n_rows * self.row_bytes / N * 3);
        for row in self.iter() {
            pixels.extend(row.as_chunks::<N>().0.iter().flat_map(&to_rgb));
        }
        pixels
    }
}

/// A raw picture as RGB. Names are those of `sensor_msgs/image_encodings.hpp` and of V4L2 drivers.
pub fn raw(image: &Image) -> Result<RgbImage, DecodeError> {
    check_sides(image)?;
    let rows = |bytes_per_px| Rows::of_pixels(image, bytes_per_px);
    let pixels = match image.encoding.as_str() {
        "rgb8" => rows(3)?.map(|&[r, g, b]| [r, g, b]),
        "bgr8" | "8UC3" => rows(3)?.map(|&[b, g, r]| [r, g, b]),
        "rgba8" => rows(4)?.map(|&[r, g, b, _]| [r, g, b]),
        "bgra8" | "8UC4" => rows(4)?.map(|&[b, g, r, _]| [r, g, b]),
        "mono8" | "8UC1" => rows(1)?.map(|&[v]| [v, v, v]),
        "yuyv" | "yuv422_yuy2" => packed_yuv(image, yuv::yuyv422_to_rgb)?,
        "uyvy" | "yuv422" => packed_yuv(image, yuv::uyvy422_to_rgb)?,
        "nv12" => nv12(image)?,
        "bayer_rggb8" => bayer(&rows(1)?, BayerPattern::Rggb),
        "bayer_gbrg8" => bayer(&rows(1)?, BayerPattern::Gbrg),
        "bayer_grbg8" => bayer(&rows(1)?, BayerPattern::Grbg),
        "bayer_bggr8" => bayer(&rows(1)?, BayerPattern::Bggr),
        found => {
            return Err(DecodeError::Encoding {
                found: excerpt(found),
            });
        }
    };
    Ok(RgbImage {
        width_px: image.width,
        height_px: image.height,
        pixels,
    })
}

/// JPEG or PNG, told by its first bytes: the `format` text of real drivers says too little.
pub fn compressed(bytes: &[u8]) -> Result<RgbImage, DecodeError> {
    let picture = picture_of(bytes)?.into_rgb8();
    Ok(RgbImage {
        width_px: picture.width(),
        height_px: picture.height(),
        pixels: picture.into_raw(),
    })
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
    match format {
        ImageFormat::Jpeg if !jpeg_is_whole(bytes) => {
            return Err(fail("JPEG is cut off".to_owned()));
        }
        ImageFormat::Jpeg | ImageFormat::Png => {}
        other => return Err(fail(format!("{other:?}, expected JPEG or PNG"))),
    }
    let budget = (FREE_BYTES + BYTES_PER_FILE_BYTE * bytes.len() as u64).min(MAX_BYTES);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(budget);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| fail(e.to_string()))?;
    let (width_px, height_px) = decoder.dimensions();
    // The JPEG decoder takes memory of its own before it asks for the limit of the output.
    if decoder.total_bytes() > budget || u64::from(width_px) * u64::from(height_px) * 3 > budget {
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

/// Depth in metres; 0 where the sensor had none. Exact by agreement, so confidence is 1 wherever there is a value.
pub fn depth(image: &Image) -> Result<DepthMap, DecodeError> {
    check_sides(image)?;
    let rows = |bytes_per_px| Rows::of_pixels(image, bytes_per_px);
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
    check_size(image, "1 to 16384 px a side", |w, h| {
        w > 0 && h > 0 && w <= MAX_SIDE && h <= MAX_SIDE
    })
}

fn check_size(
    image: &Image,
    expected: &'static str,
    fits: impl Fn(u32, u32) -> bool,
) -> Result<(), DecodeError> {
    let (width, height) = (image.width, image.height);
    if fits(width, height) {
        return Ok(());
    }
    Err(DecodeError::Size {
        width,
        height,
        encoding: excerpt(&image.encoding),
        expected,
    })
}

/// A name from outside, short enough for a log line.
fn excerpt(name: &str) -> String {
    name.chars().take(40).collect()
}

type PackedToRgb = fn(
    &YuvPackedImage<'_, u8>,
    &mut [u8],
    u32,
    YuvRange,
    YuvStandardMatrix,
) -> Result<(), yuv::YuvError>;

/// 4:2:2 in one plane. Cameras send BT.601 with limited range, which is also what cv_bridge takes it for.
fn packed_yuv(image: &Image, convert: PackedToRgb) -> Result<Vec<u8>, DecodeError> {
    let (width, height) = (image.width, image.height);
    check_size(image, "an even width", |w, _| w % 2 == 0)?;
    let rows = Rows::of(image, u64::from(width) * 2, u64::from(height))?;
    let packed: Vec<u8> = rows.iter().flatten().copied().collect();
    let yuy = YuvPackedImage {
        yuy: &packed,
        yuy_stride: width * 2,
        width,
        height,
    };
    let mut pixels = vec![0; width as usize * height as usize * 3];
    convert(
        &yuy,
        &mut pixels,
        width * 3,
        YuvRange::Limited,
        YuvStandardMatrix::Bt601,
    )
    .map_err(|e| refused(image, &e))?;
    Ok(pixels)
}

/// A luma plane, then a half-size plane of interleaved chroma with the same step.
fn nv12(image: &Image) -> Result<Vec<u8>, DecodeError> {
    let (width, height) = (image.width, image.height);
    check_size(image, "even sides", |w, h| w % 2 == 0 && h % 2 == 0)?;
    let rows = Rows::of(image, u64::from(width), u64::from(height) / 2 * 3)?;
    let packed: Vec<u8> = rows.iter().flatten().copied().collect();
    let (y_plane, uv_plane) = packed.split_at(width as usize * height as usize);
    let planes = YuvBiPlanarImage {
        y_plane,
        y_stride: width,
        uv_plane,
        uv_stride: width,
        width,
        height,
    };
    let mut pixels = vec![0; width as usize * height as usize * 3];
    let mode = YuvConversionMode::Balanced;
    yuv::yuv_nv12_to_rgb(
        &planes,
        &mut pixels,
        width * 3,
        YuvRange::Limited,
        YuvStandardMatrix::Bt601,
        mode,
    )
    .map_err(|e| refused(image, &e))?;
    Ok(pixels)
}

fn refused(image: &Image, error: &yuv::YuvError) -> DecodeError {
    DecodeError::Compressed {
        found_bytes: image.data.len(),
        reason: error.to_string(),
    }
}

fn bayer(rows: &Rows<'_>, pattern: BayerPattern) -> Vec<u8> {
    let size = ImageSize {
        width: rows.row_bytes,
        height: rows.n_rows,
    };
    let packed: Vec<u8> = rows.iter().flatten().copied().collect();
    let mosaic = KorniaImage::<u8, 1>::new(size, packed).expect("bytes fit the size");
    let mut picture = KorniaImage::<u8, 3>::from_size_val(size, 0).expect("memory for one picture");
    kornia_imgproc::color::rgb_from_bayer(&mosaic, pattern, &mut picture).expect("sizes agree");
    picture.into_vec()
}

/// Decoders fill what a cut JPEG lacks with grey, which would be mapped as if it were there. A whole one has an end
/// marker behind its last start of scan; drivers may pad after it.
fn jpeg_is_whole(bytes: &[u8]) -> bool {
    let last = |marker: [u8; 2]| bytes.windows(2).rposition(|pair| pair == marker);
    match (last([0xff, 0xda]), last([0xff, 0xd9])) {
        (Some(scan), Some(end)) => end > scan,
        _ => false,
    }
}
