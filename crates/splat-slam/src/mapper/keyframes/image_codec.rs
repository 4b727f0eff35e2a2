//! A keyframe's image and depth <-> some 50 KiB, for map files and for what memory has no room for.
//!
//! The image is a JPEG, depth a PNG of logarithms in 16 bits, confidence one in 8 bits. Depth is at most
//! `MAX_DEPTH_SIDE` long: it guides a loss, nothing is seeded twice from it.

use std::io;
use std::sync::Arc;

use byteorder::{LittleEndian, ReadBytesExt};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use splat_image::codec;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::pages::Page;

/// Errors of a JPEG at this quality are below 40 dB, those of a map at 25 to 30 dB.
const JPEG_QUALITY: u8 = 92;
pub const MAX_DEPTH_SIDE: u32 = 160;
/// Largest code of a depth; 0 is none.
const MAX_CODE: f32 = 65_534.0;
/// `decode::depth_png` gives thousandths.
const CODES_PER_UNIT: f32 = 1000.0;

/// The image of a keyframe, wherever it is.
#[derive(Debug, Clone)]
pub struct SavedView {
    pub keyframe_id: u32,
    /// Kept out of optimisation, in later runs, too.
    pub is_held_out: bool,
    pub content: Content,
}

#[derive(Debug, Clone)]
pub enum Content {
    InMemory {
        image: Arc<RgbImage>,
        depth: Arc<DepthMap>,
    },
    Packed(Arc<[u8]>),
    OnDisk(Arc<dyn Page>),
}

impl SavedView {
    /// The image that splats were trained on, as a JPEG file.
    pub fn jpeg(&self) -> io::Result<Vec<u8>> {
        let packed = self.packed()?;
        let n = (&packed[..]).read_u32::<LittleEndian>()?;
        let jpeg = packed[4..].get(..n as usize);
        let cut_off = || io::Error::new(io::ErrorKind::InvalidData, "it is cut off");
        Ok(jpeg.ok_or_else(cut_off)?.to_vec())
    }

    /// As files have it.
    pub fn packed(&self) -> io::Result<Vec<u8>> {
        match &self.content {
            Content::InMemory { image, depth } => pack(image, depth),
            Content::Packed(bytes) => Ok(bytes.to_vec()),
            Content::OnDisk(page) => page.read(),
        }
    }

    /// Image and depth; the image must have this size.
    pub fn unpacked(&self, size_px: (u32, u32)) -> Result<(RgbImage, DepthMap), String> {
        let bytes = self.packed().map_err(|e| e.to_string())?;
        unpack(&bytes, size_px)
    }
}

/// Four parts, each behind its length: JPEG, nearest and farthest depth, PNG of depth, PNG of confidence.
pub fn pack(image: &RgbImage, depth: &DepthMap) -> io::Result<Vec<u8>> {
    let fail = |e: image::ImageError| io::Error::other(e.to_string());
    let mut jpeg = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut jpeg, JPEG_QUALITY);
    let (w, h) = (image.width_px, image.height_px);
    encoder
        .write_image(&image.pixels, w, h, ExtendedColorType::Rgb8)
        .map_err(fail)?;
    let codes = Codes::of(depth);
    let mut parts = vec![jpeg, [codes.near, codes.far].map(f32::to_le_bytes).concat()];
    if codes.width_px > 0 {
        let grey16: Vec<u8> = codes
            .depth
            .iter()
            .flat_map(|code| code.to_ne_bytes())
            .collect();
        let kinds = [
            (&grey16, ExtendedColorType::L16),
            (&codes.confidence, ExtendedColorType::L8),
        ];
        for (pixels, kind) in kinds {
            let mut png = Vec::new();
            PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Sub)
                .write_image(pixels, codes.width_px, codes.height_px, kind)
                .map_err(fail)?;
            parts.push(png);
        }
    }
    let mut bytes = Vec::new();
    for part in parts {
        bytes.extend_from_slice(&(part.len() as u32).to_le_bytes());
        bytes.extend_from_slice(&part);
    }
    Ok(bytes)
}

/// The way back, of bytes that may be arbitrary.
pub fn unpack(bytes: &[u8], size_px: (u32, u32)) -> Result<(RgbImage, DepthMap), String> {
    let mut rest = bytes;
    let mut part = || {
        let n = rest.read_u32::<LittleEndian>().map_err(|e| e.to_string())?;
        let split = rest.split_at_checked(n as usize);
        let (part, after) = split.ok_or("a part is cut off")?;
        rest = after;
        Ok::<&[u8], String>(part)
    };
    let image = codec::compressed(part()?).map_err(|e| e.to_string())?;
    if (image.width_px, image.height_px) != size_px {
        return Err(format!(
            "an image of {}x{}, its keyframe says {}x{}",
            image.width_px, image.height_px, size_px.0, size_px.1
        ));
    }
    let mut range = part()?;
    let mut number = || range.read_f32::<LittleEndian>().map_err(|e| e.to_string());
    let (near, far) = (number()?, number()?);
    let is_range = near > 0.0 && far >= near && far.is_finite();
    if !is_range {
        return Ok((image, DepthMap::none()));
    }
    let mut depth = codec::depth_png(part()?).map_err(|e| e.to_string())?;
    let confidence = codec::compressed(part()?).map_err(|e| e.to_string())?;
    let size = (depth.width_px, depth.height_px);
    if (confidence.width_px, confidence.height_px) != size {
        return Err("depth and confidence are of two sizes".to_owned());
    }
    for (value, sure) in depth.depth.iter_mut().zip(&mut depth.confidence) {
        let code = (*value * CODES_PER_UNIT).round();
        *value = if code > 0.0 {
            near * (far / near).powf((code - 1.0) / (MAX_CODE - 1.0))
        } else {
            0.0
        };
        *sure = 0.0;
    }
    let sure = confidence.pixels.chunks_exact(3);
    for (own, rgb) in depth.confidence.iter_mut().zip(sure) {
        *own = f32::from(rgb[0]) / 255.0;
    }
    Ok((image, depth))
}

/// No longer than `MAX_DEPTH_SIDE`.
pub fn subsampled(map: &DepthMap) -> DepthMap {
    let longest = f64::from(map.width_px.max(map.height_px));
    let share = (longest / f64::from(MAX_DEPTH_SIDE)).max(1.0);
    let side = |n: u32| match n {
        0 => 0,
        n => ((f64::from(n) / share).round() as u32).max(1),
    };
    map.subsampled(side(map.width_px), side(map.height_px))
}

/// Depth in whole numbers.
struct Codes {
    width_px: u32,
    height_px: u32,
    near: f32,
    far: f32,
    depth: Vec<u16>,
    confidence: Vec<u8>,
}

impl Codes {
    /// Of a depth map without any value: of no size.
    fn of(map: &DepthMap) -> Self {
        let map = subsampled(map);
        let verified = (0..map.depth.len()).filter_map(|at| map.verified(at));
        let (near, far) = verified.fold((f32::INFINITY, 0.0_f32), |(near, far), (z, _)| {
            (near.min(z), far.max(z))
        });
        let (w, h) = (map.width_px, map.height_px);
        if far <= 0.0 || w == 0 || h == 0 {
            return Self {
                width_px: 0,
                height_px: 0,
                near: 0.0,
                far: 0.0,
                depth: Vec::new(),
                confidence: Vec::new(),
            };
        }
        let span = (far / near).ln().max(f32::MIN_POSITIVE);
        let codes = (0..map.depth.len()).map(|at| {
            map.verified(at).map_or((0, 0), |(z, confidence)| {
                let share = (z / near).ln() / span;
                let code = 1.0 + share * (MAX_CODE - 1.0);
                let sure = (confidence * 255.0).round().clamp(1.0, 255.0);
                (code.round().clamp(1.0, MAX_CODE) as u16, sure as u8)
            })
        });
        let (depth, confidence) = codes.unzip();
        Self {
            width_px: w,
            height_px: h,
            near,
            far,
            depth,
            confidence,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn test_image() -> RgbImage {
        let pixels = (0..64 * 48).flat_map(|p| {
            let (x, y) = (p % 64, p / 64);
            [4 * x, 5 * y, 2 * (x + y)].map(|v| v as u8)
        });
        RgbImage {
            width_px: 64,
            height_px: 48,
            pixels: pixels.collect(),
        }
    }

    fn depth() -> DepthMap {
        let n = 320 * 240;
        DepthMap {
            width_px: 320,
            height_px: 240,
            depth: (0..n).map(|at| 0.5 + (at % 320) as f32 * 0.1).collect(),
            confidence: (0..n).map(|at| (at % 3) as f32 / 2.0).collect(),
        }
    }

    #[test]
    fn image_and_depth_come_back_nearly_as_they_were() {
        let bytes = pack(&test_image(), &depth()).unwrap();
        let (image, back) = unpack(&bytes, (64, 48)).unwrap();
        let before = test_image();
        let off = image.pixels.iter().zip(&before.pixels);
        let worst = off.map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst < Some(24), "{worst:?}");
        assert_eq!((back.width_px, back.height_px), (160, 120));
        let full = depth();
        let mut n = 0;
        for y in 0..120 {
            for x in 0..160 {
                let at = (2 * y + 1) * 320 + 2 * x + 1;
                let own = back.verified(y * 160 + x);
                assert_eq!(own.is_some(), full.verified(at).is_some());
                if let (Some((a, sure)), Some((b, wanted))) = (own, full.verified(at)) {
                    assert!((a / b - 1.0).abs() < 2e-4 && (sure - wanted).abs() < 0.01);
                    n += 1;
                }
            }
        }
        assert!(n > 5000);
    }

    #[test]
    fn a_view_without_depth_has_none_and_synthetic_bytes_are_refused() {
        let bytes = pack(&test_image(), &DepthMap::none()).unwrap();
        assert_eq!(unpack(&bytes, (64, 48)).unwrap().1, DepthMap::none());
        assert!(unpack(&bytes, (64, 49)).is_err(), "another size");
        let bytes = pack(&test_image(), &depth()).unwrap();
        for cut in (0..bytes.len()).step_by(97) {
            assert!(unpack(&bytes[..cut], (64, 48)).is_err(), "cut at {cut}");
        }
        for at in (0..bytes.len()).step_by(31) {
            let mut changed = bytes.clone();
            changed[at] ^= 0xff;
            drop(unpack(&changed, (64, 48)));
        }
    }
}
