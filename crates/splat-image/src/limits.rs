//! How large an image from outside may be, and what is wrong with one that is refused.

use splat_types::image::RgbImage;

/// Longest side of an image; an 8K fisheye pair fits.
pub const MAX_SIDE: u32 = 16384;
/// Memory that any small file may ask for (22 megapixels), and how much more per byte of a larger file.
const FREE_BYTES: u64 = 64 << 20;
const BYTES_PER_FILE_BYTE: u64 = 64;
/// No image takes more, whatever the file's length.
const MAX_BYTES: u64 = 512 << 20;

#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum DecodeError {
    #[error(
        "encoding {found:?}, expected rgb8 bgr8 rgba8 bgra8 mono8 yuyv uyvy nv12 or an 8-bit Bayer pattern"
    )]
    Encoding { found: String },
    #[error("depth encoding {found:?}, expected 16UC1 (mm) or 32FC1 (m)")]
    DepthEncoding { found: String },
    #[error("image of {width}x{height} px in {encoding}, expected {expected}")]
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
    #[error("compressed image of {found_bytes} bytes: {reason}")]
    Compressed { found_bytes: usize, reason: String },
}

/// An image to decode into.
pub fn empty() -> RgbImage {
    RgbImage {
        width_px: 0,
        height_px: 0,
        pixels: Vec::new(),
    }
}

/// What a compressed image of so many bytes may take in memory.
pub(crate) fn memory_for(n_bytes: usize) -> u64 {
    (FREE_BYTES + BYTES_PER_FILE_BYTE * n_bytes as u64).min(MAX_BYTES)
}

/// A name from outside, short enough for a log line.
pub fn excerpt(name: &str) -> String {
    name.chars().take(40).collect()
}
