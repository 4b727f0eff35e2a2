//! Parameters: `launch/params.yaml` -> checked structs.
//!
//! The embedded file is the only home of defaults and ranges: the structs below have neither. A user's file or
//! `--set` may change any key that the embedded file has, within the range that its comment states.

pub mod align;
pub mod describe;
mod file;
mod known;
pub mod live;
pub mod onnx;
mod publish;
mod range;
pub mod ros2;
pub mod scale;
mod source;
pub mod track;

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;

pub use self::known::KnownParams;
pub use self::publish::{PublishParams, TfMode};
pub use self::range::Range;
pub use self::source::{CameraParams, RecordParams, SourceParams};
use crate::config::align::AlignParams;
use crate::config::file::{flatten, parse_file};
use crate::config::range::ranges_of_comments;
use crate::config::ros2::Ros2Params;

/// Named sets of values in `launch/presets`.
const PRESETS: [(&str, &str); 1] = [("paper", include_str!("../../launch/presets/paper.yaml"))];

/// The shipped `launch/params.yaml`.
pub const PARAMS_YAML: &str = include_str!("../../launch/params.yaml");

#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("cannot read the parameter file: {reason}: {}", path.display())]
    Read { reason: String, path: PathBuf },
    #[error("the parameter file is not ROS 2 parameter YAML (splat_mapper: ros__parameters: ...): {reason}: {}", path.display())]
    Form { reason: String, path: PathBuf },
    #[error("unknown parameter {key:?}{}; launch/params.yaml lists all", nearest.as_ref().map(|n| format!(", nearest is {n:?}")).unwrap_or_default())]
    UnknownKey {
        key: String,
        nearest: Option<String>,
    },
    #[error("parameter {key} = {found} is out of range, expected {expected}")]
    OutOfRange {
        key: String,
        found: String,
        expected: String,
    },
    #[error("{found:?} is no preset, expected {known}")]
    Preset { found: String, known: String },
    #[error("{found:?} is no setting, expected key=value, for example map.steps=500")]
    Setting { found: String },
    #[error(
        "parameters select.batch_overlap = {overlap} and select.batch_size = {size} do not fit: the overlap must be smaller"
    )]
    Overlap { overlap: usize, size: usize },
    #[error(
        "parameter {key} is read at the start only: set it in a parameter file, by --set or behind --ros-args, and start anew"
    )]
    Fixed { key: String },
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Params {
    pub seed: u64,
    pub backend: Backend,
    pub deterministic: bool,
    pub geometry: String,
    pub sequential: bool,
    pub use_sim_time: bool,
    pub source: SourceParams,
    pub record: RecordParams,
    pub select: SelectParams,
    pub known: KnownParams,
    pub sfm: SfmParams,
    pub mvs: MvsParams,
    pub align: AlignParams,
    pub onnx: onnx::OnnxParams,
    pub track: track::TrackParams,
    pub map: MapParams,
    pub scale: scale::ScaleParams,
    pub eval: EvalParams,
    pub publish: PublishParams,
    pub ros2: Ros2Params,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    Auto,
    Wgpu,
    Cpu,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelectParams {
    pub all: bool,
    pub min_flow: f64,
    pub min_parallax: f64,
    pub max_rate_hz: f64,
    pub min_sharpness: f64,
    pub max_wait: f64,
    pub batch_size: usize,
    pub batch_overlap: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FeatureKind {
    Auto,
    Sift,
    Orb,
    Xfeat,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OldPoses {
    Held,
    Soft,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SfmParams {
    pub features: FeatureKind,
    pub xfeat_model: String,
    pub max_features: usize,
    pub max_side: u32,
    pub min_inliers: usize,
    pub min_parallax_deg: f64,
    pub max_error_px: f64,
    pub focal_guess: f64,
    pub old_poses: OldPoses,
    pub loops: bool,
    pub max_drift: f64,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MvsParams {
    pub max_side: u32,
    pub n_depths: usize,
    pub n_sources: usize,
    pub min_views: usize,
    pub backend: Backend,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PoseRefinement {
    Direct,
    Shared,
    Held,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthLoss {
    InvDepth,
    PaperCode,
    PaperAlpha,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CopiesKeep {
    Picture,
    Line,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapParams {
    pub steps: u64,
    pub max_side: u32,
    pub final_share: f64,
    pub max_splats: usize,
    pub max_gpu_mib: u64,
    pub max_keyframes_in_ram: usize,
    pub max_disk_mib: u64,
    pub load: String,
    pub save_pictures: u64,
    pub autosave_secs: f64,
    pub seeds_per_keyframe: usize,
    pub sh_degree: u8,
    pub holdout: u32,
    pub ssim_weight: f32,
    pub depth_weight: f32,
    pub depth_mode: DepthLoss,
    pub epipolar_weight: f32,
    pub transient: f32,
    pub mcmc: bool,
    pub mcmc_every: u64,
    pub mcmc_start: u64,
    pub growth: f32,
    pub copies: CopiesKeep,
    pub noise: f32,
    pub opacity_reg: f32,
    pub scale_reg: f32,
    pub min_opacity: f32,
    pub lr_mean: f32,
    pub lr_scale: f32,
    pub lr_quat: f32,
    pub lr_opacity: f32,
    pub lr_sh: f32,
    pub sh_interval: u32,
    pub pose: PoseRefinement,
    pub lr_rotation: f32,
    pub lr_translation: f32,
    pub lr_refiner: f32,
    pub lr_focal: f32,
    pub lr_exposure: f32,
    pub snapshot_secs: f64,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvalParams {
    pub lpips_model: String,
}

/// Values by dotted key; every key of the embedded file is there.
#[derive(Debug, Clone)]
pub struct Settings {
    values: BTreeMap<String, Value>,
    ranges: BTreeMap<String, (Range, bool)>,
}

impl Settings {
    /// The shipped defaults.
    pub fn shipped() -> Self {
        let tree = parse_file(PARAMS_YAML).expect("the embedded params.yaml is valid YAML");
        let mut values = BTreeMap::new();
        flatten("", &tree, &mut values);
        let ranges = ranges_of_comments(PARAMS_YAML);
        let ranges = values
            .iter()
            .map(|(key, value)| {
                let range = ranges
                    .get(key)
                    .unwrap_or_else(|| panic!("params.yaml states no range for {key}"));
                // A default written with a point may be fractional, one without must be whole.
                (
                    key.clone(),
                    (range.clone(), value.is_i64() || value.is_u64()),
                )
            })
            .collect();
        Self { values, ranges }
    }

    /// Applies one of the shipped presets over what is there.
    pub fn merge_preset(&mut self, name: &str) -> Result<(), ConfigError> {
        let preset = PRESETS.iter().find(|(known, _)| *known == name);
        let (_, text) = preset.ok_or_else(|| ConfigError::Preset {
            found: name.to_owned(),
            known: PRESETS.map(|(known, _)| known).join(", "),
        })?;
        self.merge_text(text, &PathBuf::from(name))
    }

    /// Applies a user's parameter file over what is there.
    pub fn merge_file(&mut self, path: &Path) -> Result<(), ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|e| ConfigError::Read {
            reason: e.to_string(),
            path: path.to_owned(),
        })?;
        self.merge_text(&text, path)
    }

    /// `path` is for the error only.
    fn merge_text(&mut self, text: &str, path: &Path) -> Result<(), ConfigError> {
        let tree = parse_file(text).map_err(|reason| ConfigError::Form {
            reason,
            path: path.to_owned(),
        })?;
        let mut values = BTreeMap::new();
        flatten("", &tree, &mut values);
        let mut changes = values.into_iter();
        changes.try_for_each(|(key, value)| self.set(&key, value))
    }

    /// Applies one `key=value` of the command line; the value is YAML.
    pub fn merge_setting(&mut self, setting: &str) -> Result<(), ConfigError> {
        let fail = || ConfigError::Setting {
            found: setting.to_owned(),
        };
        let (key, text) = setting.split_once('=').ok_or_else(fail)?;
        let key = key.trim();
        let is_text = self
            .ranges
            .get(key)
            .is_some_and(|(range, _)| matches!(range, Range::Text | Range::Choice(_)));
        let value = if is_text {
            Value::String(text.trim().to_owned())
        } else {
            serde_saphyr::from_str(text).unwrap_or_else(|_| Value::String(text.to_owned()))
        };
        self.set(key, value)
    }

    /// Sets one key after checking it against its range.
    pub fn set(&mut self, key: &str, value: Value) -> Result<(), ConfigError> {
        let Some((range, whole)) = self.ranges.get(key) else {
            return Err(ConfigError::UnknownKey {
                key: key.to_owned(),
                nearest: self.nearest_key(key),
            });
        };
        if !range.allows(&value, *whole) {
            let whole = if *whole { " (whole)" } else { "" };
            return Err(ConfigError::OutOfRange {
                key: key.to_owned(),
                found: value.to_string(),
                expected: format!("{range}{whole}"),
            });
        }
        // 500.0 means 500 where a whole number is asked for; serde would refuse it.
        let value = match value.as_f64() {
            Some(v) if *whole => Value::from(v as i64),
            _ => value,
        };
        self.values.insert(key.to_owned(), value);
        Ok(())
    }

    pub fn value(&self, key: &str) -> Option<&Value> {
        self.values.get(key)
    }

    /// All keys with their values, for logs and reports.
    pub fn entries(&self) -> impl Iterator<Item = (&str, &Value)> {
        self.values.iter().map(|(key, value)| (key.as_str(), value))
    }

    /// The checked structs.
    pub fn params(&self) -> Result<Params, ConfigError> {
        let mut root = serde_json::Map::new();
        for (key, value) in &self.values {
            insert(&mut root, key, value);
        }
        let params: Params = serde_json::from_value(Value::Object(root))
            .expect("params.yaml and config.rs name the same keys");
        let select = &params.select;
        if select.batch_overlap >= select.batch_size {
            return Err(ConfigError::Overlap {
                overlap: select.batch_overlap,
                size: select.batch_size,
            });
        }
        Ok(params)
    }

    /// One of the same last part, else one that holds it; of several the one that begins most alike.
    fn nearest_key(&self, key: &str) -> Option<String> {
        let last = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
        let tail = last(key);
        let alike = |known: &&String| {
            let pairs = known.bytes().zip(key.bytes());
            Reverse(pairs.take_while(|(a, b)| a == b).count())
        };
        let keys = || self.values.keys();
        let same = keys().filter(|known| last(known) == tail).min_by_key(alike);
        let holding = keys().filter(|known| known.contains(&tail));
        same.or_else(|| holding.min_by_key(alike)).cloned()
    }
}

/// A value by dotted key, into the groups that the key names.
fn insert(root: &mut serde_json::Map<String, Value>, key: &str, value: &Value) {
    let Some((group, rest)) = key.split_once('.') else {
        root.insert(key.to_owned(), value.clone());
        return;
    };
    let group = root
        .entry(group)
        .or_insert_with(|| Value::Object(serde_json::Map::new()));
    if let Value::Object(group) = group {
        insert(group, rest, value);
    }
}

#[cfg(test)]
mod tests;
