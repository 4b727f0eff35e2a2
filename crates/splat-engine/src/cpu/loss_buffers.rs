//! The gradient at every pixel, and what the losses work in; kept from step to step.

use crate::cpu::raster::Raster;

/// Rows that one parallel task takes at least.
pub(crate) const ROWS_PER_TASK: usize = 4;

/// d loss / d plane, planes and stride as in `Raster`; margins hold nothing.
#[derive(Debug, Default)]
pub struct PixelGradients {
    pub planes: [Vec<f32>; 5],
    pub(crate) scratch: Scratch,
}

#[derive(Debug, Default)]
pub(crate) struct Scratch {
    pub(crate) stride: usize,
    /// One channel of the photo, and of the rendering as exposed.
    pub(crate) target: Vec<f32>,
    pub(crate) exposed: Vec<f32>,
    /// 0 to 1, one per pixel.
    pub(crate) weights: Vec<f32>,
    /// x, y, x^2, y^2, xy blurred along rows.
    pub(crate) moments: [Vec<f32>; 5],
    /// p, q, r of `ssim::Terms`; two more rows to work in.
    pub(crate) terms: [Vec<f32>; 5],
    /// p, q, r blurred along rows.
    pub(crate) blurred: [Vec<f32>; 3],
    pub(crate) row_sums: Vec<[f64; 3]>,
    /// Column of the depth map that each pixel of a row takes.
    pub(crate) map_columns: Vec<usize>,
    pub(crate) stretched: Vec<Stretched>,
    pub(crate) zeros: Vec<f32>,
}

/// A pixel that is compared after stretching.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stretched {
    pub(crate) x: usize,
    pub(crate) y: usize,
    pub(crate) rendered: f32,
    pub(crate) wanted: f32,
}

impl PixelGradients {
    /// Room for a rendering of this size; margins are zero.
    pub(crate) fn resize(&mut self, raster: &Raster) {
        let n_padded = raster.stride * raster.height_px;
        let n_pixels = raster.width_px * raster.height_px;
        let scratch = &mut self.scratch;
        // Margins must stay zero, and another width moves them.
        if scratch.stride != raster.stride {
            scratch.target.clear();
            scratch.exposed.clear();
            scratch.terms.iter_mut().for_each(Vec::clear);
        }
        scratch.stride = raster.stride;
        scratch.target.resize(n_padded, 0.0);
        scratch.exposed.resize(n_padded, 0.0);
        scratch.weights.resize(n_pixels, 0.0);
        scratch
            .terms
            .iter_mut()
            .for_each(|t| t.resize(n_padded, 0.0));
        scratch
            .moments
            .iter_mut()
            .chain(&mut scratch.blurred)
            .for_each(|m| m.resize(n_pixels, 0.0));
        scratch.row_sums.resize(raster.height_px, [0.0; 3]);
        scratch.zeros.resize(raster.width_px, 0.0);
        self.planes.iter_mut().for_each(|p| p.resize(n_padded, 0.0));
    }
}
