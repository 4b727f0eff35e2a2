//! 8-bit RGB images.

/// 8-bit sRGB, rows top to bottom, `pixels.len() == 3 * width_px * height_px`.
#[derive(Clone, PartialEq, Eq)]
pub struct RgbImage {
    pub width_px: u32,
    pub height_px: u32,
    pub pixels: Vec<u8>,
}

impl std::fmt::Debug for RgbImage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "RgbImage({}x{})", self.width_px, self.height_px)
    }
}

impl RgbImage {
    /// The size of an image whose pixels are elsewhere.
    pub fn unloaded(width_px: u32, height_px: u32) -> Self {
        Self {
            width_px,
            height_px,
            pixels: Vec::new(),
        }
    }

    /// Whether its pixels are elsewhere.
    pub fn is_unloaded(&self) -> bool {
        self.pixels.is_empty()
    }

    /// Scaled down so that the longer side is at most `max_side_px`; a smaller image is copied.
    pub fn shrunk(&self, max_side_px: u32) -> Self {
        let longest = self.width_px.max(self.height_px);
        if longest <= max_side_px {
            return self.clone();
        }
        let scaled = |side: u32| {
            let side = f64::from(side) * f64::from(max_side_px) / f64::from(longest);
            (side.round() as u32).max(1)
        };
        self.resized(scaled(self.width_px), scaled(self.height_px))
    }

    /// Low-passed to another size, which may change the aspect. Not `FilterType::Box`: at fractional scales it moves
    /// edges by a sixth of a pixel, Hamming by a fiftieth.
    pub fn resized(&self, width_px: u32, height_px: u32) -> Self {
        self.filtered(width_px, height_px, Filter::Hamming)
    }

    /// The same by a cubic filter (a = -0.5), as networks have seen their images: sharper, and it overshoots at edges.
    pub fn resized_cubic(&self, width_px: u32, height_px: u32) -> Self {
        self.filtered(width_px, height_px, Filter::CatmullRom)
    }

    fn filtered(&self, width_px: u32, height_px: u32, filter: Filter) -> Self {
        let mut target = Self {
            width_px,
            height_px,
            pixels: vec![0; 3 * width_px as usize * height_px as usize],
        };
        Resampler::default().resize(self, &mut target, filter);
        target
    }
}

/// Low-pass filters of `Resampler`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Filter {
    /// Keeps edges to a fiftieth of a pixel at fractional scales.
    Hamming,
    /// Cubic, a = -0.5.
    CatmullRom,
    /// The sharpest, three lobes.
    Lanczos3,
}

/// Resizes images, and keeps its buffers from one to the next. The only place that resizes three bytes a pixel: each
/// place compiles kernels of its own.
#[derive(Debug, Default)]
pub struct Resampler(fast_image_resize::Resizer);

impl Resampler {
    /// Fills `target`, whose size says the scale. Both images must have three bytes for each pixel.
    pub fn resize(&mut self, source: &RgbImage, target: &mut RgbImage, filter: Filter) {
        use fast_image_resize::images::{TypedImage, TypedImageRef};
        use fast_image_resize::pixels::U8x3;
        use fast_image_resize::{FilterType, ResizeAlg, ResizeOptions};
        let filter = match filter {
            Filter::Hamming => FilterType::Hamming,
            Filter::CatmullRom => FilterType::CatmullRom,
            Filter::Lanczos3 => FilterType::Lanczos3,
        };
        let view =
            TypedImageRef::<U8x3>::from_buffer(source.width_px, source.height_px, &source.pixels)
                .expect("three bytes per pixel");
        let mut filled =
            TypedImage::<U8x3>::from_buffer(target.width_px, target.height_px, &mut target.pixels)
                .expect("three bytes per pixel");
        let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(filter));
        // Typed: `Resizer::resize` would compile the kernels of all thirteen pixel types into this crate.
        self.0
            .resize_typed(&view, &mut filled, &options)
            .expect("the target has the size that it says");
    }
}
