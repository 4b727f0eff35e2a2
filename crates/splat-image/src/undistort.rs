//! Image through a real lens -> image of a pinhole, by a table made once per lens and size.
//!
//! The pinhole keeps the size and the ratio of focal lengths, and has the widest view of which every pixel lies in
//! the lens's image: no black corners. It looks at the centre of the undistorted image.

mod remap;

use glam::DVec2;

use crate::limits::empty;
use crate::undistort::remap::Table;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};
use splat_types::image::RgbImage;

/// Tangent of the widest half view of the pinhole (60 deg): beyond it a fisheye's rim would be smeared over most
/// of the image.
const MAX_HALF_VIEW: f64 = 1.732;
/// Points of the rim that are checked per side of the image.
const RIM_POINTS: u32 = 96;
/// A pinhole that would show less than this share of the lens's view means a calibration that does not fit.
const MIN_VIEW_SHARE: f64 = 0.2;

pub struct Undistorter {
    /// The camera of the images that come out.
    pub pinhole: Intrinsics,
    table: Table,
}

impl std::fmt::Debug for Undistorter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Undistorter")
            .field("pinhole", &self.pinhole)
            .finish_non_exhaustive()
    }
}

impl Undistorter {
    /// `None` when the coefficients leave no usable view: such a calibration is wrong.
    pub fn new(lens: &CameraModel) -> Option<Self> {
        Self::onto(&widest_pinhole(lens)?, lens)
    }

    /// To a pinhole of one's own choice, of which pixels that the lens does not show take the nearest. `None` for
    /// numbers that are no lens.
    pub fn onto(pinhole: &Intrinsics, lens: &CameraModel) -> Option<Self> {
        let pinhole = *pinhole;
        let table = Table::new((pinhole.width_px, pinhole.height_px), |x, y| {
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let at = lens.project(pinhole.ray_in_cam(pixel))?;
            Some((at.x - 0.5, at.y - 0.5))
        })?;
        Some(Self { pinhole, table })
    }

    /// The image must have the size of the lens.
    pub fn rectify(&self, mut image: RgbImage) -> RgbImage {
        let mut out = empty();
        self.rectify_into(&mut image, &mut out);
        out
    }

    /// The same into an image whose memory is used again; `image` comes out as it went in.
    pub fn rectify_into(&self, image: &mut RgbImage, out: &mut RgbImage) {
        self.table.remap(image, out);
    }

    /// Where a pixel of the pinhole's image lies in the lens's image, in pixels with centres at +0.5.
    pub fn source_of(&self, x: u32, y: u32) -> DVec2 {
        let (x, y) = self.table.place(x, y);
        DVec2::new(x + 0.5, y + 0.5)
    }
}

fn widest_pinhole(lens: &CameraModel) -> Option<Intrinsics> {
    let source = &lens.intrinsics;
    let max_radius = lens.distortion.max_radius();
    let (low, high) = inner_view(lens, max_radius)?;
    let (width, height) = (f64::from(source.width_px), f64::from(source.height_px));
    let centre = (low + high) * 0.5;
    let at_scale = |scale: f64| {
        let (fx, fy) = (source.fx * scale, source.fy * scale);
        let (cx, cy) = (width * 0.5 - fx * centre.x, height * 0.5 - fy * centre.y);
        Intrinsics {
            fx,
            fy,
            cx,
            cy,
            ..*source
        }
    };
    // Focal lengths only grow from the smallest that the inner view and the limit of the view allow.
    let half = ((high - low) * 0.5).min(DVec2::splat(MAX_HALF_VIEW));
    let smallest = (width * 0.5 / half.x / source.fx).max(height * 0.5 / half.y / source.fy) * 0.8;
    let largest = 1.0 / MIN_VIEW_SHARE;
    let fits = |scale: f64| sees_only_image(lens, &at_scale(scale), max_radius);
    if !(smallest.is_finite() && smallest > 0.0 && fits(largest.max(smallest))) {
        return None;
    }
    let (mut too_wide, mut fitting) = (smallest, largest.max(smallest));
    for _ in 0..40 {
        let middle = 0.5 * (too_wide + fitting);
        if fits(middle) {
            fitting = middle;
        } else {
            too_wide = middle;
        }
    }
    // One ten-thousandth keeps the rim off the last half pixel after rounding.
    Some(at_scale(fitting * 1.0001))
}

/// Corners on the plane z = 1 of a box about the axis whose sides the lens's image reaches everywhere.
fn inner_view(lens: &CameraModel, max_radius: f64) -> Option<(DVec2, DVec2)> {
    let i = &lens.intrinsics;
    let (right, bottom) = (f64::from(i.width_px) - 0.5, f64::from(i.height_px) - 0.5);
    let (mut low, mut high) = (DVec2::splat(-MAX_HALF_VIEW), DVec2::splat(MAX_HALF_VIEW));
    let mut n_seen = 0;
    for step in 0..=RIM_POINTS {
        let share = f64::from(step) / f64::from(RIM_POINTS);
        let (x, y) = (0.5 + share * (right - 0.5), 0.5 + share * (bottom - 0.5));
        let ray = |x: f64, y: f64| {
            let ray = lens.ray_in_cam(DVec2::new(x, y))?.truncate();
            (ray.length() <= max_radius).then_some(ray)
        };
        let sides = [ray(0.5, y), ray(x, 0.5), ray(right, y), ray(x, bottom)];
        n_seen += sides.iter().flatten().count();
        // Pixels that no ray in front of the camera reaches set no limit: the view ends before them.
        low.x = sides[0].map_or(low.x, |ray| low.x.max(ray.x));
        low.y = sides[1].map_or(low.y, |ray| low.y.max(ray.y));
        high.x = sides[2].map_or(high.x, |ray| high.x.min(ray.x));
        high.y = sides[3].map_or(high.y, |ray| high.y.min(ray.y));
    }
    let is_fisheye = matches!(lens.distortion, Distortion::Equidistant(_));
    ((n_seen > 0 || is_fisheye) && low.x < high.x && low.y < high.y).then_some((low, high))
}

/// Whether every ray of the pinhole's rim lands in the lens's image, and on the near side of a fold.
fn sees_only_image(lens: &CameraModel, pinhole: &Intrinsics, max_radius: f64) -> bool {
    let (right, bottom) = (
        f64::from(pinhole.width_px) - 0.5,
        f64::from(pinhole.height_px) - 0.5,
    );
    (0..=RIM_POINTS).all(|step| {
        let share = f64::from(step) / f64::from(RIM_POINTS);
        let (x, y) = (0.5 + share * (right - 0.5), 0.5 + share * (bottom - 0.5));
        [(0.5, y), (x, 0.5), (right, y), (x, bottom)]
            .into_iter()
            .all(|(x, y)| {
                let ray = pinhole.ray_in_cam(DVec2::new(x, y));
                ray.truncate().length() <= max_radius
                    && ray.x.abs() <= MAX_HALF_VIEW * 1.001
                    && ray.y.abs() <= MAX_HALF_VIEW * 1.001
                    && lens.project(ray).is_some_and(|at| {
                        at.x >= 0.5 && at.y >= 0.5 && at.x <= right && at.y <= bottom
                    })
            })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise is the hardest image: neighbours differ by up to 255.
    fn noise(width_px: u32, height_px: u32) -> RgbImage {
        let mut state = 1_u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        RgbImage {
            width_px,
            height_px,
            pixels: (0..3 * width_px * height_px).map(|_| next()).collect(),
        }
    }

    fn lens(width_px: u32, height_px: u32) -> CameraModel {
        CameraModel {
            intrinsics: Intrinsics {
                width_px,
                height_px,
                fx: 0.8 * f64::from(width_px),
                fy: 0.8 * f64::from(width_px),
                cx: 0.5 * f64::from(width_px),
                cy: 0.5 * f64::from(height_px),
            },
            distortion: Distortion::PlumbBob([-0.3, 0.1, 0.001, -0.002, 0.0]),
        }
    }

    #[test]
    fn every_pixel_is_within_a_grey_level_of_the_exact_mean() {
        for (width, height) in [(64, 48), (37, 21), (5, 3)] {
            let lens = lens(width, height);
            let rectifier = Undistorter::new(&lens).unwrap();
            let image = noise(width, height);
            let seen = rectifier.rectify(image.clone());
            for y in 0..height {
                for x in 0..width {
                    let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    let at = lens.project(rectifier.pinhole.ray_in_cam(pixel)).unwrap() - 0.5;
                    let at = at.clamp(
                        DVec2::ZERO,
                        DVec2::new(f64::from(width - 1), f64::from(height - 1)),
                    );
                    for channel in 0..3 {
                        let value = |column: f64, row: f64| {
                            let row = (row as usize).min(height as usize - 1);
                            let column = (column as usize).min(width as usize - 1);
                            f64::from(image.pixels[(row * width as usize + column) * 3 + channel])
                        };
                        let (low, share) = (at.floor(), at - at.floor());
                        let above = value(low.x, low.y) * (1.0 - share.x)
                            + value(low.x + 1.0, low.y) * share.x;
                        let below = value(low.x, low.y + 1.0) * (1.0 - share.x)
                            + value(low.x + 1.0, low.y + 1.0) * share.x;
                        let exact = above * (1.0 - share.y) + below * share.y;
                        let ix = (y * width + x) as usize * 3 + channel;
                        let found = f64::from(seen.pixels[ix]);
                        assert!((found - exact).abs() < 0.7, "{x},{y}: {found}, {exact}");
                    }
                }
            }
        }
    }
}
