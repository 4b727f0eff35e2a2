//! An image of any size -> the planes of numbers that a network of fixed size takes, and the way back.

use crate::foundation::decode::ModelCamera;
use crate::foundation::sidecar::{Preprocess, Sidecar};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;

/// What the bars beside an image are filled with, as VGGT pads.
const WHITE: f32 = 1.0;
/// An image that would be this many times as long as the network's before it is cut shows too little after.
const MAX_CUT: u32 = 4;

/// How an image lies in the network's: resized to `scaled_px`, which may change its aspect a little, and then shifted
/// so that its first pixel comes to `first_px`, which is negative where it is cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fit {
    pub image_px: [u32; 2],
    pub scaled_px: [u32; 2],
    pub first_px: [i64; 2],
    pub model_px: [u32; 2],
}

impl Fit {
    pub fn new(image: &RgbImage, sidecar: &Sidecar) -> Self {
        let image_px = [image.width_px.max(1), image.height_px.max(1)];
        let model_px = [sidecar.width, sidecar.height];
        let scales = [0, 1].map(|i| f64::from(model_px[i]) / f64::from(image_px[i]));
        let whole = scaled(image_px, scales[0].min(scales[1]), sidecar.patch);
        let filling = scaled(image_px, scales[0].max(scales[1]), sidecar.patch);
        let may_cut = [0, 1].iter().all(|&i| filling[i] <= MAX_CUT * model_px[i]);
        let is_cut = sidecar.preprocess == Preprocess::Crop && may_cut && whole != model_px;
        let scaled_px = if is_cut {
            [0, 1].map(|i| filling[i].max(model_px[i]))
        } else {
            [0, 1].map(|i| whole[i].min(model_px[i]))
        };
        // Whole pixels before the image, rounded down where the bars or the cuts are not alike.
        let first = |i: usize| (i64::from(model_px[i]) - i64::from(scaled_px[i])).div_euclid(2);
        Self {
            image_px,
            scaled_px,
            first_px: [first(0), first(1)],
            model_px,
        }
    }

    /// No bars and nothing cut.
    pub fn is_whole(&self) -> bool {
        self.scaled_px == self.model_px
    }

    /// Red, green and blue plane, from 0 to 1.
    pub fn planes(&self, image: &RgbImage) -> Vec<f32> {
        let [width, height] = self.model_px.map(|side| side as usize);
        let scaled = image.resized_cubic(self.scaled_px[0], self.scaled_px[1]);
        let mut planes = vec![WHITE; 3 * width * height];
        for y in 0..height {
            for x in 0..width {
                if let Some(at) = self.scaled_ix(x, y) {
                    for channel in 0..3 {
                        let value = f32::from(scaled.pixels[3 * at + channel]) / 255.0;
                        planes[(channel * height + y) * width + x] = value;
                    }
                }
            }
        }
        planes
    }

    /// Depth and confidence of the network's image at the pixels of the resized image: all of the image and
    /// nothing else; 0 where it was cut off.
    pub fn depth_map(&self, depth: &[f32], confidence: &[f32]) -> DepthMap {
        let [width, height] = self.model_px.map(|side| side as usize);
        let n = self.scaled_px[0] as usize * self.scaled_px[1] as usize;
        let mut map = DepthMap {
            width_px: self.scaled_px[0],
            height_px: self.scaled_px[1],
            depth: vec![0.0; n],
            confidence: vec![0.0; n],
        };
        for y in 0..height {
            for x in 0..width {
                if let Some(at) = self.scaled_ix(x, y) {
                    map.depth[at] = depth[y * width + x];
                    map.confidence[at] = confidence[y * width + x];
                }
            }
        }
        map
    }

    /// The camera in pixels of the image itself.
    pub fn intrinsics(&self, camera: &ModelCamera) -> Intrinsics {
        let scale = [0, 1].map(|i| f64::from(self.scaled_px[i]) / f64::from(self.image_px[i]));
        let centre = [0, 1].map(|i| {
            let in_scaled = 0.5 * f64::from(self.model_px[i]) - self.first_px[i] as f64;
            in_scaled / scale[i]
        });
        Intrinsics {
            width_px: self.image_px[0],
            height_px: self.image_px[1],
            fx: camera.fx / scale[0],
            fy: camera.fy / scale[1],
            cx: centre[0],
            cy: centre[1],
        }
    }

    /// Pixel of the resized image under one of the network's; none in a bar.
    fn scaled_ix(&self, x: usize, y: usize) -> Option<usize> {
        let [width, height] = self.scaled_px.map(|side| side as usize);
        let column = usize::try_from(x as i64 - self.first_px[0]).ok()?;
        let row = usize::try_from(y as i64 - self.first_px[1]).ok()?;
        (column < width && row < height).then_some(row * width + column)
    }
}

/// Sides in whole patches, at least one: both models in use round so.
fn scaled(image_px: [u32; 2], scale: f64, patch: u32) -> [u32; 2] {
    image_px.map(|side| {
        let patches = (f64::from(side) * scale / f64::from(patch)).round() as u32;
        patches.max(1).saturating_mul(patch)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::foundation::sidecar::tests::sidecar;
    use splat_types::transform::Rigid;

    fn fit(rgb_image: [u32; 2], model: [u32; 2], preprocess: Preprocess) -> Fit {
        let image = RgbImage {
            width_px: rgb_image[0],
            height_px: rgb_image[1],
            pixels: vec![128; (3 * rgb_image[0] * rgb_image[1]) as usize],
        };
        let sidecar = Sidecar {
            preprocess,
            ..sidecar(model[0], model[1])
        };
        let fit = Fit::new(&image, &sidecar);
        let planes = fit.planes(&image);
        assert_eq!(planes.len(), (3 * model[0] * model[1]) as usize);
        assert!(planes.iter().all(|v| (0.0..=1.0).contains(v)));
        fit
    }

    #[test]
    fn images_of_about_the_aspect_of_the_network_are_stretched() {
        // What VGGT-X makes of usual cameras.
        for (image, model) in [
            ([640, 480], [518, 392]),
            ([1280, 720], [518, 294]),
            ([1920, 1080], [518, 294]),
            ([752, 480], [518, 336]),
        ] {
            for preprocess in [Preprocess::Ratio, Preprocess::Crop, Preprocess::Pad] {
                assert!(fit(image, model, preprocess).is_whole(), "{image:?}");
            }
        }
    }

    #[test]
    fn other_aspects_get_bars_or_lose_their_ends() {
        let bars = fit([480, 640], [518, 392], Preprocess::Ratio);
        assert_eq!((bars.scaled_px, bars.first_px), ([294, 392], [112, 0]));
        assert_eq!(bars, fit([480, 640], [518, 392], Preprocess::Pad));
        let cut = fit([480, 640], [518, 392], Preprocess::Crop);
        assert_eq!((cut.scaled_px, cut.first_px), ([518, 686], [0, -147]));
        let line = fit([4000, 1], [28, 28], Preprocess::Crop);
        assert_eq!(line.scaled_px, [28, 14], "too long to be cut");
    }

    #[test]
    fn cameras_and_depth_come_back_to_the_pixels_of_the_image() {
        let camera = ModelCamera {
            window_from_cam: Rigid::IDENTITY,
            fx: 300.0,
            fy: 300.0,
        };
        for preprocess in [Preprocess::Ratio, Preprocess::Crop] {
            let fit = fit([480, 640], [518, 392], preprocess);
            let back = fit.intrinsics(&camera);
            assert!((back.cx - 240.0).abs() < 1e-9 && (back.cy - 320.0).abs() < 1e-9);
            let scale = f64::from(fit.scaled_px[0]) / 480.0;
            assert!((back.fx - 300.0 / scale).abs() < 1e-9);
            let n = 518 * 392;
            let columns: Vec<f32> = (0..n).map(|i| (i % 518) as f32 + 1.0).collect();
            let map = fit.depth_map(&columns, &vec![1.0; n]);
            assert_eq!([map.width_px, map.height_px], fit.scaled_px);
            let middle = map.depth[(fit.scaled_px[1] / 2 * fit.scaled_px[0]) as usize];
            assert_eq!(middle, fit.first_px[0].max(0) as f32 + 1.0);
            let n_verified = map.confidence.iter().filter(|c| **c > 0.0).count();
            assert_eq!(
                n_verified,
                (fit.scaled_px[0] * 392.min(fit.scaled_px[1])) as usize
            );
        }
    }

    #[test]
    fn images_are_resized_by_a_cubic_of_minus_one_half() {
        // A line of one bright pixel, made twice as wide: the weights of the cubic (Keys 1981, a = -0.5) at distances
        // of 1.25, 0.75, 0.25 pixels and back.
        let mut image = RgbImage {
            width_px: 9,
            height_px: 1,
            pixels: vec![100; 27],
        };
        image.pixels[12..15].fill(200);
        let wide = image.resized_cubic(18, 1);
        let cubic = |x: f64| {
            if x < 1.0 {
                (1.5 * x - 2.5) * x * x + 1.0
            } else {
                ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0
            }
        };
        for (at, distance) in [
            (6, 1.25),
            (7, 0.75),
            (8, 0.25),
            (9, 0.25),
            (10, 0.75),
            (11, 1.25),
        ] {
            let expected = 100.0 + 100.0 * cubic(distance);
            let found = f64::from(wide.pixels[3 * at]);
            assert!((found - expected).abs() < 1.0, "{at}: {found}, {expected}");
        }
    }

    #[test]
    fn images_are_resized_as_pil_does() {
        // Twelve bytes evenly spread and the sum of all, by Pillow 13.0 BICUBIC.
        const SMALLER: [i32; 12] = [5, 147, 57, 149, 211, 45, 50, 177, 86, 215, 154, 131];
        const LARGER: [i32; 12] = [0, 238, 19, 179, 195, 188, 13, 67, 63, 154, 106, 34];
        let value = |i: u32| {
            let (x, y, c) = (i / 3 % 60, i / 180, i % 3);
            (x * 7 + y * 13 + c * 50 + x * y / 3) as u8
        };
        let image = RgbImage {
            width_px: 60,
            height_px: 40,
            pixels: (0..60 * 40 * 3).map(value).collect(),
        };
        for (w, h, expected, sum) in [(42, 28, SMALLER, 451_675), (84, 70, LARGER, 2_259_022)] {
            let found = image.resized_cubic(w, h).pixels;
            for (k, expected) in expected.iter().enumerate() {
                let off = i32::from(found[k * found.len() / 12 + k]) - expected;
                // Bytes between the passes round, and the passes may come in another order.
                assert!(off.abs() <= 3, "{k}: {off}");
            }
            let total: i32 = found.iter().map(|v| i32::from(*v)).sum();
            assert!((total - sum).abs() < found.len() as i32 / 4, "{total}");
        }
    }
}
