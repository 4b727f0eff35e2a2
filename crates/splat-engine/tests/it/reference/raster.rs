//! Ordered 2D Gaussians -> colour, alpha and depth of every pixel. docs/GRADIENTS.md 4.
//! No tiles and no boxes: every pixel looks at every splat.

use nalgebra::Vector2;

use super::project::Projected;

pub const MAX_ALPHA: f64 = 0.99;
pub const MIN_ALPHA: f64 = 1.0 / 255.0;
pub const MIN_TRANSMITTANCE: f64 = 1e-4;

/// A splat's part in one pixel.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Index into `projected`.
    pub ix: usize,
    pub alpha: f64,
    /// What the splats in front of it let through.
    pub transmittance: f64,
    /// Alpha was held at `MAX_ALPHA`.
    pub is_saturated: bool,
}

#[derive(Debug, Clone)]
pub struct Raster {
    pub width_px: usize,
    pub height_px: usize,
    /// r g b per pixel.
    pub rgb: Vec<f64>,
    pub alpha: Vec<f64>,
    /// Depths weighted like colours; divided by alpha it is the expected depth.
    pub depth_sum: Vec<f64>,
    pub hits: Vec<Vec<Hit>>,
}

impl Raster {
    /// Expected depth of what was hit, 0 where nothing was.
    pub fn depth(&self, pixel: usize) -> f64 {
        if self.alpha[pixel] > 0.0 {
            self.depth_sum[pixel] / self.alpha[pixel]
        } else {
            0.0
        }
    }
}

pub fn raster(projected: &[Projected], order: &[usize], size: [usize; 2]) -> Raster {
    raster_lists(projected, |_, _| order, size)
}

/// `list(x, y)` says which splats a pixel looks at, near to far.
pub fn raster_lists<'a>(
    projected: &[Projected],
    list: impl Fn(usize, usize) -> &'a [usize],
    size: [usize; 2],
) -> Raster {
    let [width_px, height_px] = size;
    let n = width_px * height_px;
    let mut raster = Raster {
        width_px,
        height_px,
        rgb: vec![0.0; 3 * n],
        alpha: vec![0.0; n],
        depth_sum: vec![0.0; n],
        hits: Vec::with_capacity(n),
    };
    for pixel in 0..n {
        let (x, y) = (pixel % width_px, pixel / width_px);
        let hits = hits(projected, list(x, y), pixel_centre(x, y));
        for hit in &hits {
            let weight = hit.alpha * hit.transmittance;
            for channel in 0..3 {
                raster.rgb[3 * pixel + channel] += weight * projected[hit.ix].colour[channel];
            }
            raster.depth_sum[pixel] += weight * projected[hit.ix].mean_in_cam.z;
        }
        raster.alpha[pixel] = 1.0 - transmittance_behind(&hits);
        raster.hits.push(hits);
    }
    raster
}

pub fn pixel_centre(x: usize, y: usize) -> Vector2<f64> {
    Vector2::new(x as f64 + 0.5, y as f64 + 0.5)
}

pub fn transmittance_behind(hits: &[Hit]) -> f64 {
    hits.last()
        .map_or(1.0, |hit| hit.transmittance * (1.0 - hit.alpha))
}

/// Opacity times the Gaussian, before it is held at `MAX_ALPHA`.
pub fn raw_alpha(splat: &Projected, pixel: Vector2<f64>) -> f64 {
    let offset = splat.centre_px - pixel;
    splat.opacity * (-0.5 * offset.dot(&(splat.conic * offset))).exp()
}

fn hits(projected: &[Projected], list: &[usize], pixel: Vector2<f64>) -> Vec<Hit> {
    let mut hits = Vec::new();
    let mut transmittance = 1.0;
    for &ix in list {
        let raw = raw_alpha(&projected[ix], pixel);
        let alpha = raw.min(MAX_ALPHA);
        if alpha < MIN_ALPHA {
            continue;
        }
        let behind = transmittance * (1.0 - alpha);
        if behind <= MIN_TRANSMITTANCE {
            break;
        }
        hits.push(Hit {
            ix,
            alpha,
            transmittance,
            is_saturated: raw > MAX_ALPHA,
        });
        transmittance = behind;
    }
    hits
}
