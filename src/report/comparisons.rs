//! Photos, what the map makes of their poses, and the rows of the report that show both.

use std::sync::Arc;

use base64::Engine as _;
use maud::{Markup, html};

use crate::eval::images::{depth_in_colours, jpeg, shrunk, viridis_css};
use crate::eval::numbers::{decibels, number};
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;

/// Twelve rows of three images at this size and quality are 2 to 4 MB.
const MAX_COMPARISONS: usize = 12;
/// Rows kept for training views where there are both kinds: the gap between the two indicates overfitting.
const MAX_TRAINING_ROWS: usize = 3;
const IMAGE_SIDE_PX: u32 = 640;
const JPEG_QUALITY: u8 = 85;

/// A photo and what the map makes of its pose, at the same size.
#[derive(Debug, Clone)]
pub struct Comparison {
    pub keyframe_id: u32,
    /// Kept out of optimisation.
    pub held_out: bool,
    pub photo: Arc<RgbImage>,
    pub rendering: Rendering,
    pub psnr: f64,
}

/// The section with the most reporting of them; nothing when there are none.
pub fn comparisons(all: &[Comparison]) -> image::ImageResult<Markup> {
    let shown = chosen(all);
    if shown.is_empty() {
        return Ok(html! {});
    }
    let rows = shown
        .iter()
        .map(|comparison| comparison_row(comparison))
        .collect::<image::ImageResult<Vec<_>>>()?;
    let n_held_out = all.iter().filter(|comparison| comparison.held_out).count();
    Ok(html! {
        section {
            h2 { "Renders beside photos" }
            p.soft {
                "Each row: photo, rendering from the refined pose, rendered depth ("
                span { "far " } span.ramp style=(format!("background:{}", viridis_css())) {} " near). "
                (shown.len()) " of " (all.len()) " views, " (n_held_out) " of them held out from optimisation. Click a row to enlarge it."
            }
            div.pairs { @for row in rows { (row) } }
        }
    })
}

fn comparison_row(comparison: &Comparison) -> image::ImageResult<Markup> {
    let depth = depth_in_colours(&comparison.rendering);
    let unit = |value: f32| number(f64::from(value));
    let name = format!("keyframe {}", comparison.keyframe_id);
    let photo = embedded(&comparison.photo)?;
    let rendering = embedded(&comparison.rendering.to_rgb())?;
    let depth_image = depth
        .as_ref()
        .map(|depth| embedded(&depth.image))
        .transpose()?;
    Ok(html! {
        figure.card.pair {
            div.head {
                h3 { "Keyframe " (comparison.keyframe_id) }
                @if comparison.held_out { span.badge.held { "held out" } } @else { span.badge { "training view" } }
                span.num { (decibels(Some(comparison.psnr))) " dB" }
            }
            label {
                input type="checkbox" aria-label=(format!("enlarge {name}"));
                span.views {
                    img src=(photo) alt=(format!("photo, {name}"));
                    img src=(rendering) alt=(format!("rendering, {name}"));
                    @match &depth_image {
                        Some(source) => { img src=(source) alt=(format!("depth, {name}")); }
                        None => { span.none { "no splat in view" } }
                    }
                }
            }
            figcaption {
                span { "photo" } span { "rendering" }
                span { "depth" @if let Some(depth) = &depth { ", " (unit(depth.near)) " to " (unit(depth.far)) } }
            }
        }
    })
}

/// At most `MAX_COMPARISONS`, in order of keyframes: held-out views, the rest training views, each kind spread evenly.
fn chosen(all: &[Comparison]) -> Vec<&Comparison> {
    let (held_out, training): (Vec<_>, Vec<_>) =
        all.iter().partition(|comparison| comparison.held_out);
    let reserved = MAX_TRAINING_ROWS.min(training.len());
    let n_held_out = held_out.len().min(MAX_COMPARISONS - reserved);
    let mut shown = spread(&held_out, n_held_out);
    shown.extend(spread(&training, MAX_COMPARISONS - n_held_out));
    shown.sort_by_key(|comparison| comparison.keyframe_id);
    shown
}

fn spread<'a>(all: &[&'a Comparison], n: usize) -> Vec<&'a Comparison> {
    let n = n.min(all.len());
    (0..n)
        .map(|ix| all[(2 * ix + 1) * all.len() / (2 * n)])
        .collect()
}

fn embedded(image: &RgbImage) -> image::ImageResult<String> {
    let bytes = jpeg(&shrunk(image, IMAGE_SIDE_PX), JPEG_QUALITY)?;
    Ok(format!(
        "data:image/jpeg;base64,{}",
        base64::engine::general_purpose::STANDARD.encode(bytes)
    ))
}
