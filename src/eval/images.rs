//! Images as file bytes: renderings and photos to JPEG and PNG, depth to colours and to 16 bits.
//!
//! The only home of image encoding in `eval`; knows nothing of where the bytes go.

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::imageops::FilterType;
use image::{ExtendedColorType, ImageEncoder, ImageResult};

use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;

/// Steps of a 16-bit depth image per map unit: millimetres when the map is in metres.
pub const DEPTH_STEPS_PER_UNIT: f64 = 1000.0;

/// viridis (van der Walt and Smith 2015) at even distances: equal steps of the value look equal, also without colour vision.
const VIRIDIS: [[u8; 3]; 10] = [
    [68, 1, 84],
    [72, 40, 120],
    [62, 73, 137],
    [49, 104, 142],
    [38, 130, 142],
    [31, 158, 137],
    [53, 183, 121],
    [110, 206, 88],
    [181, 222, 43],
    [253, 231, 37],
];
/// Where nothing was hit.
const NO_DEPTH: [u8; 3] = [24, 24, 27];

/// A depth image in colours, near bright, and the depths that the two ends stand for.
#[derive(Debug, Clone)]
pub struct DepthImage {
    pub image: RgbImage,
    pub near: f32,
    pub far: f32,
}

/// Inverse depth in colours, from the 2nd to the 98th percentile; `None` when no pixel has a depth.
pub fn depth_in_colours(rendering: &Rendering) -> Option<DepthImage> {
    let mut inverse: Vec<f32> = rendering
        .depth
        .iter()
        .filter(|depth| has_depth(**depth))
        .map(|depth| 1.0 / depth)
        .collect();
    if inverse.is_empty() {
        return None;
    }
    inverse.sort_by(f32::total_cmp);
    let at = |share: f32| inverse[((inverse.len() - 1) as f32 * share) as usize];
    let (low, high) = (at(0.02), at(0.98));
    let range = (high - low).max(f32::MIN_POSITIVE);
    let colour = |depth: &f32| {
        if has_depth(*depth) {
            viridis((1.0 / depth - low) / range)
        } else {
            NO_DEPTH
        }
    };
    let pixels = rendering.depth.iter().flat_map(colour).collect();
    let image = RgbImage {
        width_px: rendering.width_px,
        height_px: rendering.height_px,
        pixels,
    };
    Some(DepthImage {
        image,
        near: 1.0 / high,
        far: 1.0 / low,
    })
}

/// viridis as a CSS gradient, from 0 to 1.
pub fn viridis_css() -> String {
    let stops: Vec<String> = VIRIDIS
        .iter()
        .map(|[r, g, b]| format!("rgb({r},{g},{b})"))
        .collect();
    format!("linear-gradient(90deg,{})", stops.join(","))
}

/// The same image, or a smaller one whose longer side is `max_side_px`.
pub fn shrunk(image: &RgbImage, max_side_px: u32) -> RgbImage {
    let longer = image.width_px.max(image.height_px);
    let side =
        |px: u32| ((u64::from(px) * u64::from(max_side_px)) / u64::from(longer)).max(1) as u32;
    let buffer = image::RgbImage::from_raw(image.width_px, image.height_px, image.pixels.clone());
    match buffer {
        Some(buffer) if longer > max_side_px => {
            let (width_px, height_px) = (side(image.width_px), side(image.height_px));
            let small = image::imageops::resize(&buffer, width_px, height_px, FilterType::Triangle);
            RgbImage {
                width_px,
                height_px,
                pixels: small.into_raw(),
            }
        }
        _ => image.clone(),
    }
}

pub fn jpeg(image: &RgbImage, quality: u8) -> ImageResult<Vec<u8>> {
    let mut bytes = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut bytes, quality);
    encoder.write_image(
        &image.pixels,
        image.width_px,
        image.height_px,
        ExtendedColorType::Rgb8,
    )?;
    Ok(bytes)
}

pub fn png(image: &RgbImage) -> ImageResult<Vec<u8>> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes).write_image(
        &image.pixels,
        image.width_px,
        image.height_px,
        ExtendedColorType::Rgb8,
    )?;
    Ok(bytes)
}

/// 16-bit grey, `DEPTH_STEPS_PER_UNIT` steps a map unit, 0 = nothing there; depths beyond 65.535 units saturate.
pub fn depth_png(rendering: &Rendering) -> ImageResult<Vec<u8>> {
    let steps = |depth: &f32| {
        let value = f64::from(*depth) * DEPTH_STEPS_PER_UNIT;
        // A depth that is there must not round to "nothing there".
        if has_depth(*depth) {
            value.round().clamp(1.0, f64::from(u16::MAX)) as u16
        } else {
            0
        }
    };
    // PngEncoder takes 16-bit samples in the machine's byte order.
    let samples: Vec<u8> = rendering
        .depth
        .iter()
        .flat_map(|depth| steps(depth).to_ne_bytes())
        .collect();
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes).write_image(
        &samples,
        rendering.width_px,
        rendering.height_px,
        ExtendedColorType::L16,
    )?;
    Ok(bytes)
}

fn has_depth(depth: f32) -> bool {
    depth.is_finite() && depth > 0.0
}

fn viridis(value: f32) -> [u8; 3] {
    let place = value.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f32;
    let below = (place as usize).min(VIRIDIS.len() - 2);
    let share = place - below as f32;
    let mix = |channel: usize| {
        let (a, b) = (
            f32::from(VIRIDIS[below][channel]),
            f32::from(VIRIDIS[below + 1][channel]),
        );
        (a + (b - a) * share).round() as u8
    };
    [mix(0), mix(1), mix(2)]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_depth(depth: &[f32]) -> Rendering {
        let n = depth.len();
        let (width_px, height_px) = (n as u32, 1);
        Rendering {
            width_px,
            height_px,
            rgb: vec![0.5; 3 * n],
            alpha: vec![1.0; n],
            depth: depth.to_vec(),
        }
    }

    #[test]
    fn near_is_bright_far_is_dark_and_nothing_is_neither() {
        let mut depth: Vec<f32> = (1..=200).map(|ix| ix as f32 / 10.0).collect();
        depth.extend([0.0, f32::NAN, f32::INFINITY, -1.0]);
        let image = depth_in_colours(&with_depth(&depth)).unwrap();
        let pixels = image.image.pixels.as_chunks::<3>().0;
        assert_eq!((pixels[0], pixels[199]), (VIRIDIS[9], VIRIDIS[0]));
        assert!(pixels[200..].iter().all(|pixel| *pixel == NO_DEPTH));
        assert!(
            image.near < 0.6 && image.far > 19.0,
            "{} {}",
            image.near,
            image.far
        );
    }

    #[test]
    fn a_view_of_nothing_has_no_depth_image() {
        assert!(depth_in_colours(&with_depth(&[0.0, f32::NAN])).is_none());
        assert!(depth_in_colours(&with_depth(&[])).is_none());
    }

    #[test]
    fn viridis_runs_from_dark_to_bright() {
        let brightness = |value: f32| viridis(value).iter().map(|v| u32::from(*v)).sum::<u32>();
        assert_eq!(
            (viridis(-1.0), viridis(0.0), viridis(2.0)),
            (VIRIDIS[0], VIRIDIS[0], VIRIDIS[9])
        );
        assert!(brightness(0.1) < brightness(0.5) && brightness(0.5) < brightness(0.9));
    }

    #[test]
    fn shrinking_keeps_the_aspect_and_never_enlarges() {
        let image = |width_px: u32, height_px: u32| RgbImage {
            width_px,
            height_px,
            pixels: vec![7; (3 * width_px * height_px) as usize],
        };
        let size = |image: &RgbImage| (image.width_px, image.height_px);
        assert_eq!(size(&shrunk(&image(1000, 500), 100)), (100, 50));
        assert_eq!(size(&shrunk(&image(1000, 1), 100)), (100, 1));
        assert_eq!(shrunk(&image(30, 20), 100), image(30, 20));
        assert_eq!(shrunk(&image(0, 0), 100), image(0, 0));
    }
}
