//! A view with depth, and what the map shows there -> new splats where the map is empty or wrong.
//!
//! Pixels are drawn at random, more of them where the image has detail; a splat is as large as the pixels it
//! stands for (on-the-fly-nvs, Meuleman 2025, draws by the Laplacian in the same spirit).

use glam::{DVec2, DVec3};
use rand::{Rng, RngExt};

use crate::mapper::splats::seeds::Seeds;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::{SH_C0, Splats};
use splat_types::transform::Rigid;

/// Standard deviation of a seed as a share of the distance to its neighbours: neighbours overlap at one sigma.
const SIGMA_OF_SPACING: f64 = 0.55;
/// Spacing beyond this would blur everything around.
const MAX_SPACING_PX: f64 = 24.0;
const MIN_SPACING_PX: f64 = 1.0;
/// Before activation: opacity 0.6.
const OPACITY_LOGIT: f32 = 0.4;
/// Below this the map has nothing there.
const EMPTY_ALPHA: f32 = 0.5;
/// The map's surface lies this much behind a verified one: it is wrong there.
pub(crate) const DEPTH_RATIO: f32 = 1.15;
/// Mean absolute colour error from which a pixel asks for seeds, and at which it asks fully.
const ERROR_FROM: f32 = 0.06;
const ERROR_FULL: f32 = 0.25;
/// Detail of a flat pixel, as a share of the mean: flat walls need splats too.
const FLAT_DETAIL: f32 = 0.35;
const MAX_DETAIL: f32 = 4.0;

/// What seeds are made from.
#[derive(Debug, Clone, Copy)]
pub struct SeedView<'a> {
    pub keyframe_id: u32,
    pub image: &'a RgbImage,
    pub intrinsics: &'a Intrinsics,
    pub world_from_cam: &'a Rigid,
    /// In map units; any size with the same field of view.
    pub depth: &'a DepthMap,
    /// What the map shows in this view; `None` for an empty map.
    pub rendering: Option<&'a Rendering>,
    /// Guesses depth where none was verified, from the surroundings.
    pub fills_gaps: bool,
}

/// At most about `budget` seeds would fill the whole image; an image that the map covers already gets few.
pub fn seed(view: &SeedView<'_>, budget: usize, sh_degree: u8, rng: &mut impl Rng) -> Seeds {
    let (width, height) = (view.image.width_px as usize, view.image.height_px as usize);
    let filled = view.fills_gaps.then(|| fill_gaps(view.depth));
    let detail = detail(view.image);
    let weights: Vec<f32> = (0..width * height)
        .map(|p| match depth_at(view, filled.as_deref(), p) {
            Some((depth, is_verified)) => need(view, p, depth, is_verified) * detail[p],
            None => 0.0,
        })
        .collect();
    // Dividing by the whole image keeps the density the same whether much or little is missing.
    let rate = budget as f64 / (width * height) as f64;
    let mut is_guess = Vec::new();
    let mut splats = Splats {
        sh_degree,
        ..Splats::default()
    };
    let stride = splats.sh_stride();
    for (p, weight) in weights.iter().enumerate() {
        let chance = (f64::from(*weight) * rate).min(1.0);
        if chance <= 0.0 || rng.random::<f64>() >= chance {
            continue;
        }
        let Some((depth, is_verified)) = depth_at(view, filled.as_deref(), p) else {
            continue;
        };
        let spacing_px = (f64::from(detail[p]) * rate)
            .sqrt()
            .recip()
            .clamp(MIN_SPACING_PX, MAX_SPACING_PX);
        let pixel = DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5);
        let mean: DVec3 = view
            .world_from_cam
            .transform_point(view.intrinsics.ray_in_cam(pixel) * f64::from(depth));
        let scale = SIGMA_OF_SPACING * spacing_px * f64::from(depth)
            / view.intrinsics.fx.max(view.intrinsics.fy);
        let is_usable = mean.is_finite() && scale > 0.0 && scale.is_finite();
        if !is_usable {
            continue;
        }
        splats.means.push(mean.as_vec3().to_array());
        splats.log_scales.push([scale.ln() as f32; 3]);
        splats.quats.push([1.0, 0.0, 0.0, 0.0]);
        splats.opacity_logits.push(OPACITY_LOGIT);
        splats.anchors.push(view.keyframe_id);
        let colour = &view.image.pixels[3 * p..3 * p + 3];
        splats
            .sh
            .extend(colour.iter().map(|c| (f32::from(*c) / 255.0 - 0.5) / SH_C0));
        splats.sh.resize(splats.means.len() * stride, 0.0);
        is_guess.push(!is_verified);
    }
    Seeds { splats, is_guess }
}

/// Depth of an image pixel and whether it was verified.
fn depth_at(view: &SeedView<'_>, filled: Option<&[f32]>, p: usize) -> Option<(f32, bool)> {
    let (width, height) = (view.image.width_px as usize, view.image.height_px as usize);
    let (depth_width, depth_height) = (view.depth.width_px as usize, view.depth.height_px as usize);
    if depth_width == 0 || depth_height == 0 {
        return None;
    }
    let q = (p / width * depth_height / height) * depth_width + p % width * depth_width / width;
    let (depth, confidence) = (view.depth.depth[q], view.depth.confidence[q]);
    if confidence > 0.0 && depth > 0.0 && depth.is_finite() {
        return Some((depth, true));
    }
    filled
        .map(|filled| (filled[q], false))
        .filter(|(depth, _)| *depth > 0.0)
}

/// 0 (the map is right here) to 1 (nothing there).
fn need(view: &SeedView<'_>, p: usize, depth: f32, is_verified: bool) -> f32 {
    let Some(rendering) = view.rendering else {
        return 1.0;
    };
    let alpha = rendering.alpha[p];
    if alpha < EMPTY_ALPHA || (is_verified && rendering.depth[p] > DEPTH_RATIO * depth) {
        return 1.0;
    }
    if !is_verified {
        return 0.0;
    }
    let error: f32 = (0..3)
        .map(|c| (rendering.rgb[3 * p + c] - f32::from(view.image.pixels[3 * p + c]) / 255.0).abs())
        .sum::<f32>()
        / 3.0;
    ((error - ERROR_FROM) / (ERROR_FULL - ERROR_FROM)).clamp(0.0, 1.0)
}

/// Local contrast of each pixel, mean about 1.
fn detail(image: &RgbImage) -> Vec<f32> {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let grey: Vec<f32> = image
        .pixels
        .chunks_exact(3)
        .map(|p| (f32::from(p[0]) + 2.0 * f32::from(p[1]) + f32::from(p[2])) / 1020.0)
        .collect();
    let at = |x: usize, y: usize| grey[y.min(height - 1) * width + x.min(width - 1)];
    let raw: Vec<f32> = (0..width * height)
        .map(|p| {
            let (x, y) = (p % width, p / width);
            let (left, up) = (x.saturating_sub(2), y.saturating_sub(2));
            let horizontal = (at(x + 2, y) - at(left, y)).abs();
            let vertical = (at(x, y + 2) - at(x, up)).abs();
            horizontal + vertical
        })
        .collect();
    let mean = raw.iter().sum::<f32>() / raw.len().max(1) as f32;
    let shaped: Vec<f32> = raw
        .iter()
        .map(|r| (FLAT_DETAIL + r / mean.max(1e-6)).min(MAX_DETAIL))
        .collect();
    let mean = shaped.iter().sum::<f32>() / shaped.len().max(1) as f32;
    shaped.into_iter().map(|s| s / mean).collect()
}

/// Depth for every pixel: verified values spread into the gaps as a mean of inverse depth, coarse to fine
/// (pull-push, Gortler 1996). All zero when nothing was verified.
fn fill_gaps(depth: &DepthMap) -> Vec<f32> {
    let (width, height) = (depth.width_px as usize, depth.height_px as usize);
    let weighted = depth.depth.iter().zip(&depth.confidence).map(|(d, c)| {
        if *c > 0.0 && *d > 0.0 && d.is_finite() {
            (1.0 / d, 1.0)
        } else {
            (0.0, 0.0)
        }
    });
    let mut levels = vec![(width, height, weighted.collect::<Vec<(f32, f32)>>())];
    while let Some((width, height, fine)) = levels.last().filter(|(w, h, _)| *w > 1 || *h > 1) {
        let (half_width, half_height) = (width.div_ceil(2), height.div_ceil(2));
        let mut coarse = vec![(0.0_f32, 0.0_f32); half_width * half_height];
        for (p, (value, weight)) in fine.iter().enumerate() {
            let cell = &mut coarse[(p / width / 2) * half_width + p % width / 2];
            *cell = (cell.0 + value * weight, cell.1 + weight);
        }
        for cell in &mut coarse {
            *cell = if cell.1 > 0.0 {
                (cell.0 / cell.1, cell.1.min(1.0))
            } else {
                (0.0, 0.0)
            };
        }
        levels.push((half_width, half_height, coarse));
    }
    let mut inverse: Vec<f32> = levels
        .last()
        .map(|(_, _, top)| top.iter().map(|c| c.0).collect())
        .unwrap_or_default();
    for pair in levels.windows(2).rev() {
        let ((width, _, fine), (coarse_width, _, _)) = (&pair[0], &pair[1]);
        inverse = fine
            .iter()
            .enumerate()
            .map(|(p, (value, weight))| {
                let from_above = inverse[(p / width / 2) * coarse_width + p % width / 2];
                if *weight > 0.0 { *value } else { from_above }
            })
            .collect();
    }
    inverse
        .into_iter()
        .map(|i| if i > 0.0 { 1.0 / i } else { 0.0 })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    fn test_image() -> (RgbImage, Intrinsics, DepthMap) {
        let (width_px, height_px) = (64, 48);
        let pixels = (0..width_px * height_px)
            .flat_map(|p| [(p % 251) as u8, 100, 200])
            .collect();
        let intrinsics = Intrinsics {
            width_px,
            height_px,
            fx: 60.0,
            fy: 60.0,
            cx: 32.0,
            cy: 24.0,
        };
        let n = (32 * 24) as usize;
        let depth = DepthMap {
            width_px: 32,
            height_px: 24,
            depth: vec![2.0; n],
            confidence: vec![1.0; n],
        };
        (
            RgbImage {
                width_px,
                height_px,
                pixels,
            },
            intrinsics,
            depth,
        )
    }

    fn seeds(depth: &DepthMap, rendering: Option<&Rendering>, fills_gaps: bool) -> Splats {
        let (image, intrinsics, _) = test_image();
        let world_from_cam = Rigid::IDENTITY;
        let view = SeedView {
            keyframe_id: 5,
            image: &image,
            intrinsics: &intrinsics,
            world_from_cam: &world_from_cam,
            depth,
            rendering,
            fills_gaps,
        };
        seed(&view, 500, 1, &mut Pcg64Mcg::seed_from_u64(1)).splats
    }

    #[test]
    fn an_empty_map_gets_the_budget_on_the_surface() {
        let (image, intrinsics, depth) = test_image();
        let splats = seeds(&depth, None, false);
        assert!((400..600).contains(&splats.len()), "{}", splats.len());
        assert_eq!(splats.sh.len(), splats.len() * 12);
        for (mean, sh) in splats.means.iter().zip(splats.sh.chunks_exact(12)) {
            assert!((mean[2] - 2.0).abs() < 1e-6);
            let pixel = intrinsics
                .project(DVec3::from(mean.map(f64::from)))
                .unwrap();
            let p = pixel.y as usize * image.width_px as usize + pixel.x as usize;
            let red = (f32::from(image.pixels[3 * p]) / 255.0 - 0.5) / SH_C0;
            assert!((sh[0] - red).abs() < 1e-4);
        }
    }

    #[test]
    fn a_map_that_shows_the_image_gets_none_and_a_hole_gets_some() {
        let (image, _, depth) = test_image();
        let n = image.pixels.len() / 3;
        let rgb = image.pixels.iter().map(|c| f32::from(*c) / 255.0).collect();
        let mut rendering = Rendering {
            width_px: 64,
            height_px: 48,
            rgb,
            alpha: vec![1.0; n],
            depth: vec![2.0; n],
        };
        assert_eq!(seeds(&depth, Some(&rendering), false).len(), 0);
        rendering.alpha[..n / 2].fill(0.1);
        let half = seeds(&depth, Some(&rendering), false);
        assert!((180..320).contains(&half.len()), "{}", half.len());
        rendering.alpha.fill(1.0);
        rendering.depth.fill(4.0);
        assert!(
            seeds(&depth, Some(&rendering), false).len() > 400,
            "the map is twice too far"
        );
    }

    #[test]
    fn unverified_pixels_are_left_or_filled_as_asked() {
        let (_, _, mut depth) = test_image();
        depth.confidence[..32 * 12].fill(0.0);
        depth.depth[..32 * 12].fill(f32::NAN);
        let left = seeds(&depth, None, false);
        assert!(
            left.means.iter().all(|m| m[1] >= 0.0),
            "the upper half was not verified"
        );
        let filled = seeds(&depth, None, true);
        assert!(filled.len() > left.len() * 3 / 2);
        assert!(filled.means.iter().all(|m| (m[2] - 2.0).abs() < 1e-5));
        depth.confidence.fill(0.0);
        assert_eq!(seeds(&depth, None, true).len(), 0);
    }
}
