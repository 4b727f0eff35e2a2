//! An image -> its pixels with strong gradients, which say most of a camera's pose.

use std::sync::Arc;

use splat_types::image::RgbImage;

/// A gradient is strong from so many times the median (3R-GS).
const TIMES_MEDIAN: f32 = 4.0;
/// Scharr's weights across and along add up to this.
const NORM: f32 = 32.0;
/// Pixels whose colours add up to no more are black: beyond the rim of an undistorted image. Of 3.
const BLACK: f32 = 0.01;

/// Weights by pixel: 255 where the gradient is strong and none of the 3 x 3 pixels about it is black, else 0, also along the edges of
/// the image. `None` where no pixel is left: every pixel counts then.
pub(crate) fn mask(image: &RgbImage) -> Option<Arc<[u8]>> {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    if width < 3 || height < 3 || image.pixels.len() != 3 * width * height {
        return None;
    }
    let sums: Vec<f32> = image
        .pixels
        .chunks_exact(3)
        .map(|rgb| rgb.iter().map(|v| f32::from(*v) / 255.0).sum())
        .collect();
    let mut strengths = vec![0.0_f32; width * height];
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            strengths[y * width + x] = strength(&sums, width, y * width + x);
        }
    }
    let mut sorted = strengths.clone();
    let (_, median, _) = sorted.select_nth_unstable_by(width * height / 2, f32::total_cmp);
    let bound = TIMES_MEDIAN * *median;
    let is_strong = |at: &usize| {
        let (x, y) = (at % width, at / width);
        let is_inside = x > 0 && y > 0 && x < width - 1 && y < height - 1;
        is_inside && strengths[*at] > bound && !touches_black(&sums, width, *at)
    };
    let weight = |at: usize| if is_strong(&at) { u8::MAX } else { 0 };
    let mask: Arc<[u8]> = (0..width * height).map(weight).collect();
    mask.iter().any(|w| *w > 0).then_some(mask)
}

/// Length of Scharr's gradient of the mean colour.
fn strength(sums: &[f32], width: usize, at: usize) -> f32 {
    let value = |dx: isize, dy: isize| {
        let there = at as isize + dy * width as isize + dx;
        sums[there as usize] / 3.0
    };
    let difference = |at: &dyn Fn(isize, isize) -> f32| {
        let side = |s: isize| 3.0 * at(s, -1) + 10.0 * at(s, 0) + 3.0 * at(s, 1);
        (side(1) - side(-1)) / NORM
    };
    let across = difference(&|s, t| value(s, t));
    let down = difference(&|s, t| value(t, s));
    across.hypot(down)
}

fn touches_black(sums: &[f32], width: usize, at: usize) -> bool {
    let rows = [at - width, at, at + width];
    rows.iter()
        .any(|row| sums[row - 1..=row + 1].iter().any(|sum| *sum <= BLACK))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width_px: u32, height_px: u32, level: impl Fn(u32, u32) -> u8) -> RgbImage {
        let pixels = (0..width_px * height_px)
            .flat_map(|at| [level(at % width_px, at / width_px); 3])
            .collect();
        RgbImage {
            width_px,
            height_px,
            pixels,
        }
    }

    #[test]
    fn an_edge_is_strong_on_both_of_its_sides() {
        let step = image(20, 10, |x, _| if x < 10 { 100 } else { 200 });
        let mask = mask(&step).unwrap();
        for (at, weight) in mask.iter().enumerate() {
            let (x, y) = (at % 20, at / 20);
            let is_edge = (9..=10).contains(&x) && (1..9).contains(&y);
            assert_eq!(*weight, if is_edge { 255 } else { 0 }, "{x}, {y}");
        }
    }

    #[test]
    fn a_black_rim_is_no_edge() {
        let rim = image(20, 10, |x, _| match x {
            0..5 => 0,
            5..12 => 100,
            _ => 110,
        });
        let mask = mask(&rim).unwrap();
        let strong: Vec<usize> = (0..20).filter(|x| mask[5 * 20 + x] > 0).collect();
        assert_eq!(strong, [11, 12], "the step from 100 to 110 alone");
    }

    #[test]
    fn a_slope_is_measured_in_levels_a_pixel() {
        let slope = image(8, 8, |x, y| (10 + 3 * x + 4 * y) as u8);
        let sums: Vec<f32> = (slope.pixels.chunks_exact(3))
            .map(|rgb| rgb.iter().map(|v| f32::from(*v) / 255.0).sum())
            .collect();
        // Central differences are of two pixels: Scharr's weights add up to 16 on either side.
        let found = strength(&sums, 8, 3 * 8 + 3) * 255.0;
        assert!((found - 5.0).abs() < 1e-3, "{found}");
    }

    #[test]
    fn an_image_without_edges_keeps_all_pixels() {
        assert!(mask(&image(9, 9, |_, _| 80)).is_none());
        assert!(mask(&image(2, 9, |_, _| 80)).is_none());
    }
}
