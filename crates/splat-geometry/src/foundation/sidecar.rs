//! `NAME.json` beside `NAME.onnx` -> what the numbers of the network mean.

use std::io::Read;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;

use crate::error::ModelError;

/// The contract that this program speaks.
pub const CONTRACT: u64 = 1;
/// A description is some hundred bytes long.
const MAX_BYTES: u64 = 64 * 1024;
/// Longer sides are for no network in use; an image of 4096x4096 already takes 200 MB.
pub const MAX_SIDE_PX: u32 = 4096;
/// Frames of one call.
pub const MAX_FRAMES: usize = 1024;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Family {
    Vggt,
    Da3,
    Mock,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum InputNorm {
    /// From 0 to 1, as they are.
    Unit,
    /// Less the mean and over the deviation of the ImageNet images.
    Imagenet,
}

/// Which way the pose of `pose_enc` leads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PoseKind {
    /// World to camera.
    W2c,
    /// Camera to world.
    C2w,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum QuaternionOrder {
    Xyzw,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RefFrame {
    First,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    F32,
    F16,
}

/// How an image of another size is brought to the size of the network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preprocess {
    /// Stretched, where that distorts by less than a patch, else as `Pad`.
    #[default]
    Ratio,
    /// Stretched, where that distorts by less than a patch, else what sticks out is cut off.
    Crop,
    /// All of it, with white bars.
    Pad,
}

/// How the layers that look at all frames are written down.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Attention {
    /// In standard operators: every pair of tokens takes memory.
    #[default]
    Plain,
    /// In one operator that needs no such matrix.
    Fused,
}

/// The JSON file beside a model. Keys that are not here are no fault: later exports may have more. Many fields: those
/// are the keys.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Sidecar {
    pub family: Family,
    pub height: u32,
    pub width: u32,
    pub patch: u32,
    pub input_norm: InputNorm,
    pub pose: PoseKind,
    pub quat: QuaternionOrder,
    pub ref_frame: RefFrame,
    pub s_min: usize,
    pub s_max: usize,
    pub precision: Precision,
    pub licence: String,
    #[serde(default)]
    pub preprocess: Preprocess,
    /// Attention heads of the layers that look at all frames; 0 where the file does not say.
    #[serde(default)]
    pub heads: u32,
    #[serde(default)]
    pub attention: Attention,
}

impl Sidecar {
    pub fn path_of(model: &Path) -> PathBuf {
        model.with_extension("json")
    }

    /// The description beside a model.
    pub fn read(model: &Path) -> Result<Self, ModelError> {
        let path = Self::path_of(model);
        let fail = |reason: String| ModelError::Sidecar {
            reason,
            path: path.clone(),
        };
        let mut bytes = Vec::new();
        std::fs::File::open(&path)
            .and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes))
            .map_err(|e| fail(e.to_string()))?;
        if bytes.len() as u64 > MAX_BYTES {
            return Err(fail(format!("it is longer than {MAX_BYTES} bytes")));
        }
        Self::parse(&bytes).map_err(fail)
    }

    /// The reason, where it is none.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let value: Value = serde_json::from_slice(bytes).map_err(|e| e.to_string())?;
        // The number comes first: what other versions say about the rest is their own.
        match value.get("contract").map(Value::as_u64) {
            Some(Some(CONTRACT)) => {}
            _ => {
                let found = value.get("contract").unwrap_or(&Value::Null);
                return Err(format!("contract is {found}, expected {CONTRACT}"));
            }
        }
        let sidecar: Self = serde_json::from_value(value).map_err(|e| e.to_string())?;
        sidecar.fault().map_or(Ok(sidecar), Err)
    }

    fn fault(&self) -> Option<String> {
        let side = |name: &str, side: u32| {
            let fits = self.patch > 0
                && (1..=MAX_SIDE_PX).contains(&side)
                && side.is_multiple_of(self.patch);
            (!fits).then(|| {
                let patch = self.patch;
                format!(
                    "{name} is {side}, expected a multiple of patch {patch} up to {MAX_SIDE_PX}"
                )
            })
        };
        let (least, most) = (self.s_min, self.s_max);
        let frames = (least == 0 || least > most || !(2..=MAX_FRAMES).contains(&most)).then(|| {
            format!("s_min is {least} and s_max {most}, expected 1 <= s_min <= s_max and s_max from 2 to {MAX_FRAMES}")
        });
        side("height", self.height)
            .or_else(|| side("width", self.width))
            .or(frames)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn sidecar(width: u32, height: u32) -> Sidecar {
        Sidecar {
            family: Family::Mock,
            height,
            width,
            patch: 14,
            input_norm: InputNorm::Unit,
            pose: PoseKind::W2c,
            quat: QuaternionOrder::Xyzw,
            ref_frame: RefFrame::First,
            s_min: 1,
            s_max: 8,
            precision: Precision::F32,
            licence: String::new(),
            preprocess: Preprocess::Ratio,
            heads: 0,
            attention: Attention::Plain,
        }
    }

    const WHOLE: &str = r#"{"contract":1,"family":"vggt","height":392,"width":518,"patch":14,"input_norm":"unit",
        "pose":"w2c","quat":"xyzw","ref_frame":"first","s_min":1,"s_max":16,"precision":"f32","licence":"mine",
        "exported_by":"somebody"}"#;

    #[test]
    fn a_description_is_read_with_its_defaults() {
        let found = Sidecar::parse(WHOLE.as_bytes()).unwrap();
        assert_eq!((found.height, found.s_max, found.heads), (392, 16, 0));
        assert_eq!(
            (found.preprocess, found.pose),
            (Preprocess::Ratio, PoseKind::W2c)
        );
    }

    #[test]
    fn a_wrong_description_is_refused_with_what_is_wrong() {
        for (from, to, word) in [
            (
                "\"contract\":1",
                "\"contract\":2",
                "contract is 2, expected 1",
            ),
            ("\"contract\":1,", "", "contract is null"),
            ("\"height\":392", "\"height\":390", "height is 390"),
            ("\"width\":518", "\"width\":51800", "width is 51800"),
            ("\"patch\":14", "\"patch\":0", "patch 0"),
            ("\"s_min\":1", "\"s_min\":17", "s_min is 17"),
            ("\"s_min\":1", "\"s_min\":0", "s_min is 0"),
            ("\"s_max\":16", "\"s_max\":1", "s_max 1"),
            ("\"s_max\":16", "\"s_max\":1025", "s_max 1025"),
            ("\"pose\":\"w2c\"", "\"pose\":\"c2c\"", "c2c"),
            ("\"quat\":\"xyzw\"", "\"quat\":\"wxyz\"", "wxyz"),
            ("\"family\":\"vggt\",", "", "family"),
            ("{", "[", "expected"),
        ] {
            let text = WHOLE.replacen(from, to, 1);
            let reason = Sidecar::parse(text.as_bytes()).unwrap_err();
            assert!(reason.contains(word), "{to}: {reason}");
        }
    }
}
