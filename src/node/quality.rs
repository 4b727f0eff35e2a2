//! The map beside images, held-out ones and some that it was trained on -> PSNR, SSIM and LPIPS.

use crate::eval::exposure_fit::{HalfScores, half_scores};
use crate::eval::image_metrics;
use crate::eval::lpips::{Lpips, LpipsError};
use crate::eval::report_json::Quality;
use crate::report::comparisons::Comparison;
use splat_engine::error::EngineError;
use splat_slam::mapper::mapper::Mapper;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;

/// Views of each kind after a stop, which nobody wants to wait for.
const MAX_VIEWS_STOPPED: usize = 6;
/// Images in the report.
const MAX_HELD_OUT_IMAGES: usize = 8;
const MAX_TRAIN_IMAGES: usize = 4;

/// Which views are measured.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MeasuredViews {
    pub(crate) holdout_every: u32,
    /// 0 = all.
    pub(crate) max_train: usize,
    /// Somebody waits for the end.
    pub(crate) was_stopped: bool,
}

/// The figures, and the images for the report. `on_view` gets how many views are done, of how many.
pub(crate) fn measure_quality(
    map: &mut Mapper,
    views: MeasuredViews,
    lpips: &mut Option<Lpips>,
    on_view: &mut dyn FnMut(usize, usize),
) -> Result<(Quality, Vec<Comparison>), EngineError> {
    let (held_out, train) = chosen(map, views);
    let (mut done, of) = (0, held_out.len() + train.len());
    let mut images = Vec::new();
    let mut measure = |ids: &[u32], is_held_out: bool, max_images: usize| {
        let image_stride = ids.len().div_ceil(max_images).max(1);
        let mut scores = Scores::default();
        for (i, id) in ids.iter().enumerate() {
            on_view(done, of);
            done += 1;
            let Some((rendering, photo)) = map.render_keyframe(*id)? else {
                continue;
            };
            let psnr = scores.add(&rendering, &photo, is_held_out, lpips);
            tracing::debug!("keyframe {id}: {psnr:.2} dB, held out: {is_held_out}");
            if i % image_stride == 0 {
                images.push(Comparison {
                    keyframe_id: *id,
                    held_out: is_held_out,
                    photo,
                    rendering,
                    psnr,
                });
            }
        }
        Ok::<Scores, EngineError>(scores)
    };
    let held_out = measure(&held_out, true, MAX_HELD_OUT_IMAGES)?;
    let train = measure(&train, false, MAX_TRAIN_IMAGES)?;
    let quality = Quality {
        holdout_every: u64::from(views.holdout_every),
        views_holdout: held_out.psnrs.len() as u64,
        views_train: train.psnrs.len() as u64,
        psnr_train: mean(&train.psnrs),
        ssim_train: mean(&train.ssims),
        lpips_train: train.lpips(),
        psnr_holdout: mean(&held_out.psnrs),
        ssim_holdout: mean(&held_out.ssims),
        psnr_holdout_half: held_out.half_mean(|half| half.psnr),
        ssim_holdout_half: held_out.half_mean(|half| half.ssim),
        psnr_holdout_exposed: held_out.half_mean(|half| half.psnr_exposed),
        ssim_holdout_exposed: held_out.half_mean(|half| half.ssim_exposed),
        lpips_holdout: held_out.lpips(),
    };
    Ok((quality, images))
}

/// What is measured of views.
#[derive(Default)]
struct Scores {
    psnrs: Vec<f64>,
    ssims: Vec<f64>,
    halves: Vec<HalfScores>,
    distances: Vec<f64>,
}

impl Scores {
    /// Returns the PSNR.
    fn add(
        &mut self,
        rendering: &Rendering,
        photo: &RgbImage,
        is_held_out: bool,
        lpips: &mut Option<Lpips>,
    ) -> f64 {
        let psnr = rendering.psnr(photo);
        self.psnrs.push(psnr);
        self.ssims.push(image_metrics::ssim(&rendering.rgb, photo));
        if is_held_out {
            self.halves.push(half_scores(rendering, photo));
        }
        self.distances.extend(lpips_of(lpips, rendering, photo));
        psnr
    }

    fn half_mean(&self, score: impl Fn(&HalfScores) -> f64) -> Option<f64> {
        mean(&self.halves.iter().map(score).collect::<Vec<f64>>())
    }

    /// A mean over some of the views would be another figure.
    fn lpips(&self) -> Option<f64> {
        mean(&self.distances).filter(|_| self.distances.len() == self.ssims.len())
    }
}

/// Held-out views, and training views, that quality is measured by.
fn chosen(map: &Mapper, views: MeasuredViews) -> (Vec<u32>, Vec<u32>) {
    let ids = map.keyframe_ids().into_iter();
    let (held_out, train): (Vec<_>, Vec<_>) = ids.partition(|(_, is_held_out)| *is_held_out);
    let bare = |ids: Vec<(u32, bool)>| ids.into_iter().map(|(id, _)| id).collect::<Vec<u32>>();
    let (held_out, train) = (bare(held_out), bare(train));
    let n_held_out = held_out.len();
    let (most_held_out, most_train) = match (views.was_stopped, views.max_train) {
        (true, _) => (MAX_VIEWS_STOPPED, MAX_VIEWS_STOPPED),
        (false, 0) => (usize::MAX, usize::MAX),
        (false, most) => (usize::MAX, most),
    };
    let held_out = subsampled(held_out, most_held_out);
    if held_out.len() < n_held_out {
        let n = held_out.len();
        tracing::info!("stopped: quality is that of {n} of {n_held_out} held-out views");
    }
    (held_out, subsampled(train, most_train))
}

/// Evenly, at most so many.
fn subsampled(ids: Vec<u32>, most: usize) -> Vec<u32> {
    let stride = ids.len().div_ceil(most).max(1);
    ids.into_iter().step_by(stride).collect()
}

/// A network that fails is not asked again: the run is worth more than this figure.
fn lpips_of(lpips: &mut Option<Lpips>, rendering: &Rendering, photo: &RgbImage) -> Option<f64> {
    let distance = lpips.as_mut()?.distance(&rendering.rgb, photo);
    let failed = |e: &LpipsError| tracing::warn!("quality.lpips_holdout stays null: {e}");
    let distance = distance.inspect_err(failed).ok();
    if distance.is_none() {
        *lpips = None;
    }
    distance
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}
