//! An image as features are found on it, and what was found: points with descriptors of one kind.

use fast_image_resize as fir;

use crate::features::scale_space::Grey;
use splat_types::image::RgbImage;

/// Length of every SIFT descriptor: with 16 bits for a product, 256 is the most there is, and rounding takes some.
pub const SIFT_LENGTH: f32 = 250.0;

/// Length of every XFeat descriptor; their products have a sign.
pub const XFEAT_LENGTH: f32 = 176.0;

/// Highest submap: AVX2 takes one factor for signed and keeps sums of two products below 2^15.
pub const MAX_SUBMAP: u8 = 127;

/// Descriptors in a signature.
const SIGNATURE: usize = 192;

/// Of one image, in the order of its points.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Descriptors {
    Sift(Vec<[u8; 128]>),
    Orb(Vec<[u64; 4]>),
    Xfeat(Vec<[i16; 64]>),
}

impl Default for Descriptors {
    fn default() -> Self {
        Self::Sift(Vec::new())
    }
}

impl Descriptors {
    /// Those with the given numbers.
    pub fn picked(&self, numbers: &[usize]) -> Self {
        match self {
            Self::Sift(all) => Self::Sift(numbers.iter().map(|&i| all[i]).collect()),
            Self::Orb(all) => Self::Orb(numbers.iter().map(|&i| all[i]).collect()),
            Self::Xfeat(all) => Self::Xfeat(numbers.iter().map(|&i| all[i]).collect()),
        }
    }
}

/// Points of one image, the strongest first.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Features {
    /// In pixels of the working image, centres at +0.5.
    pub pixels: Vec<glam::DVec2>,
    /// Size of what was found, in pixels of the working image; only the order means anything across kinds.
    pub sigmas: Vec<f32>,
    pub descriptors: Descriptors,
}

impl Features {
    /// The coarsest descriptors of an image: they survive the largest changes of view.
    pub fn signature(&self) -> Descriptors {
        let mut order: Vec<usize> = (0..self.len()).collect();
        order.sort_by(|&a, &b| self.sigmas[b].total_cmp(&self.sigmas[a]));
        order.truncate(SIGNATURE);
        self.descriptors.picked(&order)
    }

    pub fn len(&self) -> usize {
        self.pixels.len()
    }

    pub fn is_empty(&self) -> bool {
        self.pixels.is_empty()
    }
}

/// The grey image that features are found on: the longer side is at most `max_side`.
pub fn working_image(image: &RgbImage, max_side: u32) -> Grey {
    let luma = |p: &[u8]| {
        (77 * u32::from(p[0]) + 150 * u32::from(p[1]) + 29 * u32::from(p[2])) as f32
            / (256.0 * 255.0)
    };
    let (w, h) = (image.width_px, image.height_px);
    let pixels: Vec<f32> = image.pixels.chunks_exact(3).map(luma).collect();
    let full = Grey {
        width: w as usize,
        height: h as usize,
        pixels,
    };
    let (small_w, small_h) = working_size(w, h, max_side);
    if (small_w, small_h) == (w, h) || !full.is_whole() {
        return full;
    }
    resized(&full, small_w, small_h).unwrap_or(full)
}

pub fn working_size(width_px: u32, height_px: u32, max_side: u32) -> (u32, u32) {
    let longest = width_px.max(height_px);
    if longest <= max_side {
        return (width_px, height_px);
    }
    let scaled = |side: u32| {
        ((f64::from(side) * f64::from(max_side) / f64::from(longest)).round() as u32).max(1)
    };
    (scaled(width_px), scaled(height_px))
}

/// `None` where one of the sizes is zero.
pub(crate) fn resized(full: &Grey, width: u32, height: u32) -> Option<Grey> {
    use fir::images::{TypedImage, TypedImageRef};
    use fir::pixels::F32;
    let bytes = bytemuck::cast_slice(&full.pixels);
    let (full_width, full_height) = (full.width as u32, full.height as u32);
    let source = TypedImageRef::<F32>::from_buffer(full_width, full_height, bytes).ok()?;
    let mut pixels = vec![0.0_f32; width as usize * height as usize];
    let bytes = bytemuck::cast_slice_mut(&mut pixels);
    let mut target = TypedImage::<F32>::from_buffer(width, height, bytes).ok()?;
    let options =
        fir::ResizeOptions::new().resize_alg(fir::ResizeAlg::Convolution(fir::FilterType::Hamming));
    // Typed: `Resizer::resize` would compile the kernels of all thirteen pixel types into this crate.
    fir::Resizer::new()
        .resize_typed(&source, &mut target, &options)
        .ok()?;
    Some(Grey {
        width: width as usize,
        height: height as usize,
        pixels,
    })
}
