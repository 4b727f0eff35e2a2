//! Raw pixels of cameras and `sensor_msgs/Image` -> RGB images.
//!
//! Every size is checked against the bytes at hand before a pixel is touched. Writes into the caller's image, whose
//! memory is used again.

use std::borrow::Cow;

use yuv::{YuvBiPlanarImage, YuvConversionMode, YuvPackedImage, YuvRange, YuvStandardMatrix};

use crate::demosaic::{BayerPattern, demosaic};
use crate::limits::{DecodeError, MAX_SIDE, excerpt};
use splat_types::image::RgbImage;

/// How the bytes of a raw image stand for colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelFormat {
    Rgb,
    Bgr,
    Rgba,
    Bgra,
    Grey,
    /// 4:2:2 in one plane: Y U Y V.
    Yuyv,
    /// 4:2:2 in one plane: U Y V Y.
    Uyvy,
    /// 4:2:0: a plane of luma, then one of U V at half size.
    Nv12,
    BayerRggb,
    BayerGbrg,
    BayerGrbg,
    BayerBggr,
}

/// What YUV numbers mean. Webcams send BT.601 with limited range, which is also what `cv_bridge` takes them for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct YuvColour {
    pub matrix: YuvMatrix,
    pub is_full_range: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum YuvMatrix {
    #[default]
    Bt601,
    Bt709,
    Bt2020,
}

/// A raw image, its bytes as they came.
#[derive(Clone, Copy)]
pub struct Pixels<'a> {
    pub width_px: u32,
    pub height_px: u32,
    pub format: PixelFormat,
    pub colour: YuvColour,
    /// Bytes from one row to the next; 0 = rows are packed.
    pub step: u32,
    pub bytes: &'a [u8],
}

impl std::fmt::Debug for Pixels<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let name = self.format.ros_name();
        write!(f, "Pixels({}x{} {name})", self.width_px, self.height_px)
    }
}

impl PixelFormat {
    /// By the names of `sensor_msgs/image_encodings.hpp` and of V4L2 drivers.
    pub fn of_ros(name: &str) -> Option<Self> {
        Some(match name {
            "rgb8" => Self::Rgb,
            "bgr8" | "8UC3" => Self::Bgr,
            "rgba8" => Self::Rgba,
            "bgra8" | "8UC4" => Self::Bgra,
            "mono8" | "8UC1" => Self::Grey,
            "yuyv" | "yuv422_yuy2" => Self::Yuyv,
            "uyvy" | "yuv422" => Self::Uyvy,
            "nv12" => Self::Nv12,
            "bayer_rggb8" => Self::BayerRggb,
            "bayer_gbrg8" => Self::BayerGbrg,
            "bayer_grbg8" => Self::BayerGrbg,
            "bayer_bggr8" => Self::BayerBggr,
            _ => return None,
        })
    }

    /// The name under which `sensor_msgs/Image` carries it.
    pub fn ros_name(self) -> &'static str {
        match self {
            Self::Rgb => "rgb8",
            Self::Bgr => "bgr8",
            Self::Rgba => "rgba8",
            Self::Bgra => "bgra8",
            Self::Grey => "mono8",
            Self::Yuyv => "yuv422_yuy2",
            Self::Uyvy => "yuv422",
            Self::Nv12 => "nv12",
            Self::BayerRggb => "bayer_rggb8",
            Self::BayerGbrg => "bayer_gbrg8",
            Self::BayerGrbg => "bayer_grbg8",
            Self::BayerBggr => "bayer_bggr8",
        }
    }

    /// Whether the colour of its numbers hangs on `YuvColour`.
    pub fn is_yuv(self) -> bool {
        matches!(self, Self::Yuyv | Self::Uyvy | Self::Nv12)
    }

    /// Bytes of a packed row; of the luma, where planes follow each other.
    pub fn row_bytes(self, width_px: u32) -> u32 {
        let bytes_per_px = match self {
            Self::Rgb | Self::Bgr => 3,
            Self::Rgba | Self::Bgra => 4,
            Self::Yuyv | Self::Uyvy => 2,
            _ => 1,
        };
        width_px.saturating_mul(bytes_per_px)
    }

    /// Rows in memory, those of chroma included.
    pub fn n_rows(self, height_px: u32) -> u32 {
        if self == Self::Nv12 {
            height_px / 2 * 3
        } else {
            height_px
        }
    }
}

/// A raw image as RGB.
pub fn to_rgb(pixels: &Pixels<'_>, out: &mut RgbImage) -> Result<(), DecodeError> {
    use PixelFormat as F;
    check_size(pixels, "1 to 16384 px a side", |w, h| {
        w > 0 && h > 0 && w <= MAX_SIDE && h <= MAX_SIDE
    })?;
    if pixels.format.is_yuv() {
        check_size(pixels, "an even width", |w, _| w % 2 == 0)?;
    }
    if pixels.format == F::Nv12 {
        check_size(pixels, "even sides", |_, h| h % 2 == 0)?;
    }
    let row_bytes = u64::from(pixels.format.row_bytes(pixels.width_px));
    let n_rows = u64::from(pixels.format.n_rows(pixels.height_px));
    let rows = Rows::of(pixels, row_bytes, n_rows)?;
    resize(out, pixels.width_px, pixels.height_px);
    let target = &mut out.pixels;
    match pixels.format {
        F::Rgb => rows.map(target, |&[r, g, b]| [r, g, b]),
        F::Bgr => rows.map(target, |&[b, g, r]| [r, g, b]),
        F::Rgba => rows.map(target, |&[r, g, b, _]| [r, g, b]),
        F::Bgra => rows.map(target, |&[b, g, r, _]| [r, g, b]),
        F::Grey => rows.map(target, |&[v]| [v, v, v]),
        F::Yuyv => packed_yuv(pixels, &rows, target, yuv::yuyv422_to_rgb)?,
        F::Uyvy => packed_yuv(pixels, &rows, target, yuv::uyvy422_to_rgb)?,
        F::Nv12 => nv12(pixels, &rows, target)?,
        F::BayerRggb => bayer(&rows, target, BayerPattern::Rggb),
        F::BayerGbrg => bayer(&rows, target, BayerPattern::Gbrg),
        F::BayerGrbg => bayer(&rows, target, BayerPattern::Grbg),
        F::BayerBggr => bayer(&rows, target, BayerPattern::Bggr),
    }
    Ok(())
}

/// Gives an image another size; what its pixels show is then anything.
pub fn resize(image: &mut RgbImage, width_px: u32, height_px: u32) {
    image.width_px = width_px;
    image.height_px = height_px;
    let n_bytes = 3 * width_px as usize * height_px as usize;
    image.pixels.resize(n_bytes, 0);
}

fn check_size(
    pixels: &Pixels<'_>,
    expected: &'static str,
    fits: impl Fn(u32, u32) -> bool,
) -> Result<(), DecodeError> {
    let (width, height) = (pixels.width_px, pixels.height_px);
    if fits(width, height) {
        return Ok(());
    }
    let encoding = excerpt(pixels.format.ros_name());
    Err(DecodeError::Size {
        width,
        height,
        encoding,
        expected,
    })
}

/// Rows of a raw image without their padding.
#[derive(Debug)]
pub struct Rows<'a> {
    data: &'a [u8],
    step: usize,
    row_bytes: usize,
    n_rows: usize,
}

impl<'a> Rows<'a> {
    /// `row_bytes` of every row carry pixels; `step` says how far apart rows start.
    pub fn of(pixels: &Pixels<'a>, row_bytes: u64, n_rows: u64) -> Result<Self, DecodeError> {
        let short = |expected_bytes| DecodeError::Short {
            found_bytes: pixels.bytes.len(),
            width: pixels.width_px,
            height: pixels.height_px,
            step: pixels.step,
            expected_bytes,
        };
        // Some drivers leave step 0; then rows are packed.
        let step = match pixels.step {
            0 => row_bytes,
            step => u64::from(step),
        };
        if step < row_bytes {
            return Err(short(row_bytes));
        }
        // The last row may come without its padding.
        let needed = step * (n_rows - 1) + row_bytes;
        if (pixels.bytes.len() as u64) < needed {
            return Err(short(needed));
        }
        Ok(Self {
            data: pixels.bytes,
            step: step as usize,
            row_bytes: row_bytes as usize,
            n_rows: n_rows as usize,
        })
    }

    pub fn iter(&self) -> impl Iterator<Item = &'a [u8]> {
        let (step, row_bytes) = (self.step, self.row_bytes);
        let data = self.data;
        (0..self.n_rows).map(move |row| &data[row * step..row * step + row_bytes])
    }

    /// Each pixel of `N` bytes gives three.
    fn map<const N: usize>(&self, target: &mut [u8], to_rgb: impl Fn(&[u8; N]) -> [u8; 3]) {
        let row_bytes = self.row_bytes / N * 3;
        for (row, out) in self.iter().zip(target.chunks_exact_mut(row_bytes)) {
            let pixels = row.as_chunks::<N>().0.iter();
            for (pixel, out) in pixels.zip(out.as_chunks_mut::<3>().0) {
                *out = to_rgb(pixel);
            }
        }
    }

    /// All rows with the padding of the last one, which is copied where it is missing.
    fn padded(&self) -> Cow<'a, [u8]> {
        let whole = self.step * self.n_rows;
        match self.data.get(..whole) {
            Some(bytes) => Cow::Borrowed(bytes),
            None => {
                let mut bytes = self.data.to_vec();
                bytes.resize(whole, 0);
                Cow::Owned(bytes)
            }
        }
    }
}

impl YuvColour {
    fn range(self) -> YuvRange {
        if self.is_full_range {
            YuvRange::Full
        } else {
            YuvRange::Limited
        }
    }

    fn matrix(self) -> YuvStandardMatrix {
        match self.matrix {
            YuvMatrix::Bt601 => YuvStandardMatrix::Bt601,
            YuvMatrix::Bt709 => YuvStandardMatrix::Bt709,
            YuvMatrix::Bt2020 => YuvStandardMatrix::Bt2020,
        }
    }
}

type PackedToRgb = fn(
    &YuvPackedImage<'_, u8>,
    &mut [u8],
    u32,
    YuvRange,
    YuvStandardMatrix,
) -> Result<(), yuv::YuvError>;

fn packed_yuv(
    pixels: &Pixels<'_>,
    rows: &Rows<'_>,
    target: &mut [u8],
    convert: PackedToRgb,
) -> Result<(), DecodeError> {
    let (width, height) = (pixels.width_px, pixels.height_px);
    let bytes = rows.padded();
    let yuy = YuvPackedImage {
        yuy: &bytes,
        yuy_stride: rows.step as u32,
        width,
        height,
    };
    let colour = pixels.colour;
    convert(&yuy, target, width * 3, colour.range(), colour.matrix())
        .map_err(|e| refused(pixels, &e))
}

/// A luma plane, then a half-size plane of interleaved chroma with the same step.
fn nv12(pixels: &Pixels<'_>, rows: &Rows<'_>, target: &mut [u8]) -> Result<(), DecodeError> {
    let (width, height) = (pixels.width_px, pixels.height_px);
    let bytes = rows.padded();
    let (y_plane, uv_plane) = bytes.split_at(rows.step * height as usize);
    let step = rows.step as u32;
    let planes = YuvBiPlanarImage {
        y_plane,
        y_stride: step,
        uv_plane,
        uv_stride: step,
        width,
        height,
    };
    let (range, matrix) = (pixels.colour.range(), pixels.colour.matrix());
    let mode = YuvConversionMode::Balanced;
    yuv::yuv_nv12_to_rgb(&planes, target, width * 3, range, matrix, mode)
        .map_err(|e| refused(pixels, &e))
}

fn refused(pixels: &Pixels<'_>, error: &yuv::YuvError) -> DecodeError {
    DecodeError::Compressed {
        found_bytes: pixels.bytes.len(),
        reason: error.to_string(),
    }
}

fn bayer(rows: &Rows<'_>, target: &mut [u8], pattern: BayerPattern) {
    let packed: Vec<u8> = rows.iter().flatten().copied().collect();
    demosaic(&packed, rows.row_bytes, pattern, target);
}
