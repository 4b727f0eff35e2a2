//! Depth maps with a confidence for each pixel.

use glam::DVec2;

/// z-depth along the camera axis, in the length unit of whoever made it; 0 = no value.
/// `confidence` is 0 (unverified: never use) to 1, one per pixel; only its order means anything between models.
#[derive(Clone, PartialEq)]
pub struct DepthMap {
    pub width_px: u32,
    pub height_px: u32,
    pub depth: Vec<f32>,
    pub confidence: Vec<f32>,
}

impl DepthMap {
    /// No pixels at all.
    pub fn none() -> Self {
        Self {
            width_px: 0,
            height_px: 0,
            depth: Vec::new(),
            confidence: Vec::new(),
        }
    }

    /// So many pixels without depth.
    pub fn empty(width_px: u32, height_px: u32) -> Self {
        let n = width_px as usize * height_px as usize;
        Self {
            width_px,
            height_px,
            depth: vec![0.0; n],
            confidence: vec![0.0; n],
        }
    }

    /// The same in another unit, `factor` of which make one of the old.
    pub fn scale(&mut self, factor: f64) {
        for value in &mut self.depth {
            *value = (f64::from(*value) * factor) as f32;
        }
    }

    /// So many pixels of it, each from the middle of what it stands for.
    pub fn subsampled(&self, width_px: u32, height_px: u32) -> Self {
        let (from, to) = ([self.width_px, self.height_px], [width_px, height_px]);
        let middle = |ix: u32, side: usize| {
            let doubled = u64::from(2 * ix + 1) * u64::from(from[side]);
            (doubled / u64::from(2 * to[side])) as usize
        };
        let places: Vec<usize> = (0..height_px)
            .flat_map(|y| (0..width_px).map(move |x| (x, y)))
            .map(|(x, y)| middle(y, 1) * from[0] as usize + middle(x, 0))
            .collect();
        let picked = |values: &[f32]| {
            let value = |&at: &usize| values.get(at).copied().unwrap_or(0.0);
            places.iter().map(value).collect()
        };
        Self {
            width_px,
            height_px,
            depth: picked(&self.depth),
            confidence: picked(&self.confidence),
        }
    }

    /// The pixel that holds a place, in pixels of this map; `None` outside of it.
    pub fn pixel_at(&self, place: DVec2) -> Option<usize> {
        let (width, height) = (f64::from(self.width_px), f64::from(self.height_px));
        let is_inside = place.x >= 0.0 && place.y >= 0.0 && place.x < width && place.y < height;
        is_inside.then(|| place.y as usize * self.width_px as usize + place.x as usize)
    }

    /// Depth and confidence of pixel `at`; `None` where no depth was verified.
    #[inline]
    pub fn verified(&self, at: usize) -> Option<(f32, f32)> {
        let (depth, confidence) = (*self.depth.get(at)?, *self.confidence.get(at)?);
        let is_verified =
            depth > 0.0 && depth.is_finite() && confidence > 0.0 && confidence.is_finite();
        is_verified.then_some((depth, confidence))
    }

    /// Median of the verified depths; `None` where there are none.
    pub fn median(&self) -> Option<f32> {
        let usable = self
            .depth
            .iter()
            .zip(&self.confidence)
            .filter(|(d, c)| **c > 0.0 && **d > 0.0 && d.is_finite());
        let mut values: Vec<f32> = usable.map(|(d, _)| *d).collect();
        if values.is_empty() {
            return None;
        }
        let middle = values.len() / 2;
        Some(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

impl std::fmt::Debug for DepthMap {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "DepthMap({}x{})", self.width_px, self.height_px)
    }
}
