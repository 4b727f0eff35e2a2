//! `report.json`: what a run did, in numbers. Keys may be added, never renamed or removed: scripts depend on them.
//!
//! A figure that has no value is null. Units are in the names.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Deserializer, Serialize};

use crate::eval::error::{EvalError, read_text, write_atomically};
use splat_io::frame_source::SourceCounts;
use splat_slam::mapper::budgets::Budgets;
use splat_types::snapshot;

const MAX_FILE_BYTES: u64 = 1 << 26;

/// report.json. Many fields: its keys, which scripts outside read.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Of the program that wrote this.
    #[serde(default)]
    pub version: String,
    pub frames: FrameCounts,
    pub keyframes: KeyframeCounts,
    /// The map first, then those that have no known relation to it.
    #[serde(default)]
    pub submaps: Vec<SubmapEntry>,
    pub splats: u64,
    pub steps: u64,
    pub adapter: String,
    pub seed: u64,
    /// Of the splats as `map::layout` orders their bytes, in hexadecimal.
    pub map_sha256: String,
    pub timing_s: Timing,
    pub steps_per_s: Option<f64>,
    pub latency_ms: Latency,
    /// Live; nothing in a replay.
    #[serde(default)]
    pub load_shed: LoadShedding,
    #[serde(default)]
    pub tracking: TrackingFigures,
    pub peak_rss_mib: Option<f64>,
    pub peak_gpu_mib: Option<f64>,
    pub quality: Quality,
    /// At the steps that `eval.at_steps` names.
    #[serde(default)]
    pub quality_at: Vec<QualityAt>,
    #[serde(default)]
    pub budgets: Budgets,
    /// Null where the run began anew.
    #[serde(default)]
    #[serde(rename = "continued")]
    pub resume_report: Option<Resumed>,
    pub scale: Scale,
    /// Why the input ended early.
    #[serde(default)]
    pub source_fault: Option<String>,
    /// Why keyframes are missing.
    #[serde(default)]
    pub geometry_note: Option<String>,
    /// Times that the engine was lost.
    #[serde(default)]
    pub engine_faults: u64,
    /// Why the run failed; the other figures are those up to then.
    #[serde(default)]
    pub error: Option<String>,
    /// All of `launch/params.yaml` as the run used them.
    #[serde(default)]
    pub parameters: BTreeMap<String, serde_json::Value>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameCounts {
    pub received: u64,
    pub dropped: u64,
    pub undecodable: u64,
    pub out_of_order: u64,
    /// That no depth image belongs to, of a source that has some.
    #[serde(default)]
    pub without_depth: u64,
    /// That no image of the second camera belongs to, of a stereo pair.
    #[serde(default)]
    pub without_second: u64,
    /// That no samples of the IMU reach, of a source that has one.
    #[serde(default)]
    pub without_imu: u64,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyframeCounts {
    pub selected: u64,
    /// With a pose in the map.
    pub registered: u64,
    /// Of the map that the run went on from; not among the others.
    #[serde(default)]
    pub before: u64,
    /// Groups of keyframes whose relation to each other is unknown; the map is the largest that was mapped.
    #[serde(rename = "components")]
    pub submaps: u64,
}

/// Keyframes with one frame and unit, and what was made of them.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SubmapEntry {
    /// The geometry's number.
    pub id: u64,
    pub keyframes: u64,
    pub splats: u64,
    /// In the run directory; null where it has no splats.
    pub file: Option<String>,
    /// It is the map, in whose frame all other files are.
    pub active: bool,
}

/// Seconds of work by stage; stages overlap, so they need not add up to `wall`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    #[serde(deserialize_with = "null_as_nan")]
    pub wall: f64,
    #[serde(deserialize_with = "null_as_nan")]
    pub decode: f64,
    #[serde(deserialize_with = "null_as_nan")]
    pub geometry: f64,
    #[serde(deserialize_with = "null_as_nan")]
    pub optimise: f64,
    #[serde(default, deserialize_with = "null_as_nan")]
    pub track: f64,
}

/// From the arrival of a keyframe to its pose, and to the first snapshot that holds it; live, from the arrival of any frame
/// to its pose by the tracker.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Latency {
    pub keyframe_to_pose_p50: Option<f64>,
    pub keyframe_to_pose_p95: Option<f64>,
    pub keyframe_to_snapshot_p50: Option<f64>,
    pub keyframe_to_snapshot_p95: Option<f64>,
    #[serde(default)]
    pub frame_to_pose_p50: Option<f64>,
    #[serde(default)]
    pub frame_to_pose_p95: Option<f64>,
}

/// What was left out, or waited, since poses were more urgent.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LoadShedding {
    /// Keyframes that had gathered, so that each got fewer features and fewer matches.
    pub hurried_keyframes: u64,
    /// Keyframes that were not compared with places seen long before.
    pub unsought_keyframes: u64,
    /// Seconds that depth, and steps of the optimiser, waited for poses.
    pub depth_s: f64,
    pub steps_s: f64,
}

/// Poses of single frames.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrackingFigures {
    /// That came to the tracker, and those that had to make room for newer ones before.
    pub frames: u64,
    pub dropped: u64,
    /// With a pose measured when they came.
    pub tracked: u64,
    /// With a measured pose in `trajectory.tum`: keyframes, tracked ones and those that the map has reached since.
    pub posed: u64,
    /// With a pose between two measured ones.
    pub interpolated: u64,
    /// Times that the tracker got lost, and was found again without a hint.
    pub lost: u64,
    pub relocalised: u64,
    /// With a pose at which their image fits the splats best.
    #[serde(default)]
    pub fitted: u64,
    /// Milliseconds of work per frame.
    pub work_ms_p50: Option<f64>,
    pub work_ms_p95: Option<f64>,
}

/// How like its images the map is. Many fields: the keys of `quality` in report.json.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Every n-th keyframe was kept out of optimisation; 0 = none.
    pub holdout_every: u64,
    /// Views that the figures are means of.
    #[serde(default)]
    pub views_holdout: u64,
    #[serde(default)]
    pub views_train: u64,
    pub psnr_train: Option<f64>,
    pub ssim_train: Option<f64>,
    /// By the network of `eval.lpips_model`; null without one.
    pub lpips_train: Option<f64>,
    pub psnr_holdout: Option<f64>,
    pub ssim_holdout: Option<f64>,
    /// Of the right halves of held-out views, as rendered
    pub psnr_holdout_half: Option<f64>,
    pub ssim_holdout_half: Option<f64>,
    /// and with the exposure that fits their left halves.
    pub psnr_holdout_exposed: Option<f64>,
    pub ssim_holdout_exposed: Option<f64>,
    /// By the network of `eval.lpips_model`; null without one.
    pub lpips_holdout: Option<f64>,
}

/// Quality after some of the steps.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct QualityAt {
    pub steps: u64,
    /// Seconds since the run began, without those that measuring took.
    pub wall_s: f64,
    /// Seconds that measuring has taken in all so far.
    pub measured_s: f64,
    pub splats: u64,
    pub quality: Quality,
}

/// How a run that goes on from a map stands to it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Resumed {
    /// Keyframes of the saved map.
    pub map_keyframes: u64,
    /// Keyframes of this run that were looked for in it, and those that were found.
    pub asked: u64,
    pub found: u64,
    /// Whether this run has its place in the map; else nothing was added to it.
    pub joined: bool,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// `up_to_scale` or `given`.
    pub source: String,
    pub metres_per_unit: Option<f64>,
    /// Standard deviation of `metres_per_unit`.
    pub std: Option<f64>,
}

impl Report {
    pub fn write(&self, path: &Path) -> Result<(), EvalError> {
        let mut text = serde_json::to_string_pretty(self)
            .map_err(|e| EvalError::writing("the report", &e, path))?;
        text.push('\n');
        write_atomically("the report", text.as_bytes(), path)
    }

    pub fn read(path: &Path) -> Result<Self, EvalError> {
        let text = read_text("the report", MAX_FILE_BYTES, path)?;
        serde_json::from_str(&text).map_err(|e| EvalError::reading("the report", &e, path))
    }
}

impl FrameCounts {
    /// `dropped` comes from the first queue, to which those are added that never came that far.
    pub fn of(counts: &SourceCounts, dropped: u64) -> Self {
        let SourceCounts {
            received,
            undecodable,
            out_of_order,
            without_depth,
            without_second,
            without_imu,
            dropped: missed,
            ..
        } = *counts;
        Self {
            received,
            dropped: dropped + missed,
            undecodable,
            out_of_order,
            without_depth,
            without_second,
            without_imu,
        }
    }
}

impl Latency {
    /// From one measurement, in seconds, per keyframe and per frame.
    pub fn of(
        keyframe_to_pose_secs: &[f64],
        keyframe_to_snapshot_secs: &[f64],
        frame_to_pose_secs: &[f64],
    ) -> Self {
        let ms = |values: &[f64], share: f64| percentile(values, share).map(|secs| secs * 1e3);
        Self {
            keyframe_to_pose_p50: ms(keyframe_to_pose_secs, 0.5),
            keyframe_to_pose_p95: ms(keyframe_to_pose_secs, 0.95),
            keyframe_to_snapshot_p50: ms(keyframe_to_snapshot_secs, 0.5),
            keyframe_to_snapshot_p95: ms(keyframe_to_snapshot_secs, 0.95),
            frame_to_pose_p50: ms(frame_to_pose_secs, 0.5),
            frame_to_pose_p95: ms(frame_to_pose_secs, 0.95),
        }
    }
}

impl From<snapshot::Scale> for Scale {
    fn from(scale: snapshot::Scale) -> Self {
        Self {
            source: scale.source.name().to_owned(),
            metres_per_unit: scale.metres_per_unit,
            std: scale.std,
        }
    }
}

impl Default for Scale {
    fn default() -> Self {
        snapshot::Scale::UP_TO_SCALE.into()
    }
}

/// Value below which `share` (0 to 1) of the finite values lie, between two of them by proportion. `None` of none.
pub fn percentile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted: Vec<f64> = values
        .iter()
        .copied()
        .filter(|value| value.is_finite())
        .collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    let place = share.clamp(0.0, 1.0) * last as f64;
    let (below, above) = (
        sorted[place.floor() as usize],
        sorted[place.ceil() as usize],
    );
    Some(below + (above - below) * place.fract())
}

/// SHA-256 in hexadecimal.
pub fn sha256_hex(bytes: &[u8]) -> String {
    use sha2::Digest;

    sha2::Sha256::digest(bytes)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

/// JSON has no NaN: it is written as null, and so must be read back.
fn null_as_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_lie_between_the_values() {
        let values = [4.0, 1.0, f64::NAN, 3.0, 2.0, 5.0];
        assert_eq!(percentile(&values, 0.5), Some(3.0));
        assert_eq!(percentile(&values, 0.95), Some(4.8));
        assert_eq!(
            (percentile(&values, 0.0), percentile(&values, 1.0)),
            (Some(1.0), Some(5.0))
        );
        assert_eq!(
            (percentile(&[], 0.5), percentile(&[7.0], 0.95)),
            (None, Some(7.0))
        );
    }

    #[test]
    fn the_hash_is_the_published_one_of_abc() {
        assert_eq!(
            sha256_hex(b"abc"),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        );
    }
}
