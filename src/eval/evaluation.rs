//! A run directory and a reference trajectory -> the figures of `splat-mapper eval`.
//!
//! Keyframes only; positions are compared after one Sim(3) alignment, in the unit of the reference.

use std::path::Path;

use glam::{DQuat, DVec3};
use serde::Serialize;

use crate::eval::alignment::{AlignError, Alignment, align};
use crate::eval::error::EvalError;
use crate::eval::numbers::ordinal;
use crate::eval::report_json::{Quality, Report};
use crate::eval::trajectory::{
    TOLERANCE_SECS, TimedPose, associate, read_tum, shifted, stamp_offset_nanos,
};
use splat_io::scene_formats::scene::{Layout, SceneView};
use splat_types::transform::{Rigid, Similarity, extent};

/// What `eval --json` prints. A figure that has no value is null and `note` says why.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// Keyframes of the run that have a reference pose: what all figures are over.
    pub registered: usize,
    /// Poses of the reference.
    pub reference: usize,
    /// Root mean square distance of positions after alignment, in units of the reference.
    pub ate_rmse: Option<f64>,
    /// The same as a share of the largest distance between two reference positions.
    pub ate_percent_of_extent: Option<f64>,
    /// Root mean square distance of positions after alignment by a rigid motion alone, in units of the reference: the run's
    /// own metres count. `None` where the run has none.
    pub ate_se3_rmse: Option<f64>,
    /// Mean angle between orientations after the same alignment.
    pub rotation_mean_deg: Option<f64>,
    /// Root mean square error of the motion from each keyframe to the next: its length, in units of the reference,
    pub rpe_translation: Option<f64>,
    /// and its angle.
    pub rpe_rotation_deg: Option<f64>,
    /// Units of the reference per unit of the run.
    pub aligned_scale: Option<f64>,
    /// Poses in the run's `keyframes.tum`.
    pub keyframes: usize,
    /// What a reader must know before quoting the figures.
    pub note: Option<String>,
    /// Held-out views, from the run's `report.json` where there is one.
    pub quality: Option<Quality>,
}

/// Compares `RUN_DIR/keyframes.tum` with a reference: a TUM file, or a scene that `source::scene_formats` knows, whose
/// stamps are those that a replay of it gives its frames.
pub fn evaluate(run_dir: &Path, reference: &Path) -> Result<Evaluation, EvalError> {
    let keyframes_path = run_dir.join("keyframes.tum");
    let keyframes = read_poses(&keyframes_path)?;
    let truth = read_reference(reference)?;
    let report_path = run_dir.join("report.json");
    let report = if report_path.exists() {
        Some(Report::read(&report_path)?)
    } else {
        None
    };
    let metres_per_unit = report.as_ref().and_then(|r| r.scale.metres_per_unit);
    let quality = report.map(|report| report.quality);
    let evaluation = compare_at(&keyframes, &truth, metres_per_unit);
    if evaluation.registered == 0 {
        return Err(EvalError::NothingInCommon {
            run: span(&keyframes),
            reference: span(&truth),
            tolerance_secs: TOLERANCE_SECS,
            path: reference.to_owned(),
        });
    }
    Ok(Evaluation {
        quality,
        ..evaluation
    })
}

/// The figures for two trajectories in order of time.
pub fn compare(keyframes: &[TimedPose], reference: &[TimedPose]) -> Evaluation {
    compare_at(keyframes, reference, None)
}

/// The same of a run whose unit is so many metres, where that is known.
fn compare_at(
    keyframes: &[TimedPose],
    reference: &[TimedPose],
    metres_per_unit: Option<f64>,
) -> Evaluation {
    let offset_nanos = stamp_offset_nanos(keyframes, reference, TOLERANCE_SECS);
    let keyframes = &shifted(keyframes, offset_nanos)[..];
    let pairs = associate(keyframes, reference, TOLERANCE_SECS);
    let estimated: Vec<Rigid> = pairs.iter().map(|&(ix, _)| keyframes[ix].pose).collect();
    let truth: Vec<Rigid> = pairs.iter().map(|&(_, ix)| reference[ix].pose).collect();
    let empty = Evaluation {
        registered: pairs.len(),
        reference: reference.len(),
        ate_rmse: None,
        ate_percent_of_extent: None,
        ate_se3_rmse: None,
        rotation_mean_deg: None,
        rpe_translation: None,
        rpe_rotation_deg: None,
        aligned_scale: None,
        keyframes: keyframes.len(),
        note: shift_note(offset_nanos),
        quality: None,
    };
    let alignment = match align(&estimated, &truth) {
        Ok(alignment) => alignment,
        Err(reason) => {
            return Evaluation {
                note: Some(note_of(reason)),
                ..empty
            };
        }
    };
    let similarity = alignment.reference_from_estimate;
    let aligned: Vec<Rigid> = estimated
        .iter()
        .map(|pose| similarity.transform_pose(pose))
        .collect();
    let ate = rmse(
        aligned
            .iter()
            .zip(&truth)
            .map(|(a, t)| a.translation.distance(t.translation)),
    );
    let ate_se3_rmse = metres_per_unit.map(|metres| {
        let rigid = (similarity.rotation, metres);
        ate_se3(&estimated, &truth, rigid)
    });
    let positions: Vec<DVec3> = reference
        .iter()
        .map(|timed| timed.pose.translation)
        .collect();
    let motion_errors: Vec<Rigid> = aligned
        .windows(2)
        .zip(truth.windows(2))
        .map(|(a, t)| (t[0].inverse() * t[1]).inverse() * (a[0].inverse() * a[1]))
        .collect();
    Evaluation {
        ate_rmse: Some(ate),
        ate_se3_rmse,
        ate_percent_of_extent: Some(100.0 * ate / extent(&positions)),
        rotation_mean_deg: Some(mean_angle_deg(&similarity, &estimated, &truth)),
        rpe_translation: Some(rmse(
            motion_errors.iter().map(|error| error.translation.length()),
        )),
        rpe_rotation_deg: Some(rmse(
            motion_errors
                .iter()
                .map(|error| error.angle_to(&Rigid::IDENTITY).to_degrees()),
        )),
        aligned_scale: Some(similarity.scale),
        note: join_notes(
            shift_note(offset_nanos),
            roll_note(&alignment, &estimated, &truth),
        ),
        ..empty
    }
}

/// Root mean square distance of positions about their middles, in metres. The best turn is the same whatever the scale.
fn ate_se3(estimate: &[Rigid], truth: &[Rigid], (turn, metres_per_unit): (DQuat, f64)) -> f64 {
    let middle = |poses: &[Rigid]| {
        let sum: DVec3 = poses.iter().map(|pose| pose.translation).sum();
        sum / poses.len() as f64
    };
    let (own_middle, true_middle) = (middle(estimate), middle(truth));
    rmse(estimate.iter().zip(truth).map(|(own, truth)| {
        let turned = turn * (own.translation - own_middle) * metres_per_unit;
        turned.distance(truth.translation - true_middle)
    }))
}

fn mean_angle_deg(similarity: &Similarity, estimate: &[Rigid], truth: &[Rigid]) -> f64 {
    let angles = estimate
        .iter()
        .zip(truth)
        .map(|(e, t)| similarity.transform_pose(e).angle_to(t).to_degrees());
    angles.sum::<f64>() / estimate.len() as f64
}

/// What a path along a line leaves open.
fn roll_note(alignment: &Alignment, estimate: &[Rigid], truth: &[Rigid]) -> Option<String> {
    if alignment.is_line {
        return Some("the positions lie on a line: the roll about it was aligned by the orientations, so rotation_mean_deg leaves that part out".to_owned());
    }
    let loose = alignment.loose_roll.as_ref()?;
    let without = mean_angle_deg(&loose.by_orientations, estimate, truth);
    // Beyond a right angle there is no more to say than that nothing is known.
    let roll = loose.std_rad.to_degrees().min(90.0);
    Some(format!(
        "the positions lie nearly on a line (spread {:.3} across, {:.3} along): after alignment by them the roll about it is only known to about {roll:.0} deg, all of which is in rotation_mean_deg; with the roll that the orientations ask for it is {without:.4}",
        loose.across, loose.along
    ))
}

fn shift_note(offset_nanos: i64) -> Option<String> {
    let secs = offset_nanos / 1_000_000_000;
    (secs != 0)
        .then(|| format!("the stamps of the run were shifted by {secs} s to meet the reference"))
}

fn join_notes(first: Option<String>, second: Option<String>) -> Option<String> {
    let notes: Vec<String> = first.into_iter().chain(second).collect();
    (!notes.is_empty()).then(|| notes.join("; "))
}

/// For people: one figure a line.
impl std::fmt::Display for Evaluation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let figure =
            |value: Option<f64>| value.map_or_else(|| "none".to_owned(), |v| format!("{v:.4}"));
        writeln!(
            f,
            "registered       {} of {} reference poses ({} keyframes in the run)",
            self.registered, self.reference, self.keyframes
        )?;
        writeln!(
            f,
            "ATE              {} RMSE, {} % of the extent (keyframes, Sim(3) aligned, units of the reference)",
            figure(self.ate_rmse),
            figure(self.ate_percent_of_extent)
        )?;
        writeln!(
            f,
            "rotation         {} deg mean",
            figure(self.rotation_mean_deg)
        )?;
        writeln!(
            f,
            "RPE              {} and {} deg RMSE, keyframe to keyframe",
            figure(self.rpe_translation),
            figure(self.rpe_rotation_deg)
        )?;
        if let Some(metres) = self.ate_se3_rmse {
            writeln!(
                f,
                "ATE in metres    {} RMSE (keyframes, aligned by a rigid motion, at the run's own scale)",
                figure(Some(metres))
            )?;
        }
        writeln!(
            f,
            "aligned scale    {} units of the reference per unit of the run",
            figure(self.aligned_scale)
        )?;
        if let Some(quality) = &self.quality {
            if quality.holdout_every > 0 || quality.psnr_holdout.is_some() {
                let which = match quality.holdout_every {
                    0 => "named by the source".to_owned(),
                    n => format!("every {} keyframe", ordinal(n)),
                };
                writeln!(
                    f,
                    "held-out views   PSNR {} dB, SSIM {}, LPIPS {} ({which})",
                    figure(quality.psnr_holdout),
                    figure(quality.ssim_holdout),
                    figure(quality.lpips_holdout),
                )?;
                // Reports of 0.1.0 have none.
                if quality.psnr_holdout_half.is_some() {
                    writeln!(
                        f,
                        "right halves     PSNR {} dB, SSIM {}; with the exposure of the left halves {} dB, {}",
                        figure(quality.psnr_holdout_half),
                        figure(quality.ssim_holdout_half),
                        figure(quality.psnr_holdout_exposed),
                        figure(quality.ssim_holdout_exposed),
                    )?;
                }
            }
            writeln!(f, "training views   PSNR {} dB", figure(quality.psnr_train))?;
        }
        if let Some(note) = &self.note {
            writeln!(f, "note             {note}")?;
        }
        Ok(())
    }
}

fn read_reference(path: &Path) -> Result<Vec<TimedPose>, EvalError> {
    let beside_images = path.join("poses_tum.txt");
    if beside_images.is_file() {
        return read_poses(&beside_images);
    }
    let Some(layout) = Layout::find(path) else {
        return read_poses(path);
    };
    // Sizes of images do not matter here.
    let views = layout.views(u32::MAX)?;
    let timed = |view: &SceneView| TimedPose {
        stamp: view.stamp,
        pose: view.gt_from_cam,
    };
    Ok(views.iter().map(timed).collect())
}

fn read_poses(path: &Path) -> Result<Vec<TimedPose>, EvalError> {
    let poses = read_tum(path)?;
    if poses.is_empty() {
        Err(EvalError::NoPoses {
            path: path.to_owned(),
        })
    } else {
        Ok(poses)
    }
}

fn note_of(reason: AlignError) -> String {
    format!("the trajectories cannot be aligned: {reason}")
}

fn span(poses: &[TimedPose]) -> String {
    match poses {
        [] => "none".to_owned(),
        [first, .., last] => format!("{} to {}", first.stamp, last.stamp),
        [only] => only.stamp.to_string(),
    }
}

fn rmse(errors: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = errors.fold((0.0, 0usize), |(sum, n), error| {
        (sum + error * error, n + 1)
    });
    (sum / n.max(1) as f64).sqrt()
}
