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
        self.filtered(width_px, height_px, fast_image_resize::FilterType::Hamming)
    }

    /// The same by a cubic filter (a = -0.5), as networks have seen their images: sharper, and it overshoots at edges.
    pub fn resized_cubic(&self, width_px: u32, height_px: u32) -> Self {
        self.filtered(
            width_px,
            height_px,
            fast_image_resize::FilterType::CatmullRom,
        )
    }

    fn filtered(
        &self,
        width_px: u32,
        height_px: u32,
        filter: fast_image_resize::FilterType,
    ) -> Self {
        use fast_image_resize::{PixelType, ResizeAlg, ResizeOptions, Resizer, images};
        let source =
            images::ImageRef::new(self.width_px, self.height_px, &self.pixels, PixelType::U8x3)
                .expect("three bytes per pixel");
        let mut target = images::Image::new(width_px, height_px, PixelType::U8x3);
        let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(filter));
        Resizer::new()
            .resize(&source, &mut target, &options)
            .expect("both images are U8x3");
        Self {
            width_px,
            height_px,
            pixels: target.into_vec(),
        }
    }
}
