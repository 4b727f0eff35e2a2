//! Two images -> their LPIPS distance, by a network that the user supplies as an ONNX file.
//!
//! The contract stands in docs/FORMATS.md: two inputs [1, 3, H, W] in [-1, 1], one number out.

use std::path::{Path, PathBuf};

use splat_geometry::inference::{Network, NetworkOptions, OnnxError, Tensor, network};
use splat_types::image::RgbImage;

#[derive(Debug, thiserror::Error)]
pub enum LpipsError {
    #[error("eval.lpips_model: {0}")]
    Onnx(OnnxError),
    #[error("eval.lpips_model is no LPIPS network: {reason}; docs/FORMATS.md has the contract: {}", path.display())]
    Model { reason: String, path: PathBuf },
}

impl From<OnnxError> for LpipsError {
    /// What ONNX Runtime says against the file, with the contract beside it.
    fn from(error: OnnxError) -> Self {
        match error {
            OnnxError::Network { reason, path } => Self::Model { reason, path },
            other => Self::Onnx(other),
        }
    }
}

/// A loaded network.
#[derive(Debug)]
pub struct Lpips {
    network: Network,
}

impl Lpips {
    /// `library`: see `onnx::onnx_runtime`.
    pub fn open(library: &Path, model: &Path) -> Result<Self, LpipsError> {
        Self::of(Network::open(library, model, &NetworkOptions::default())?)
    }

    fn of(network: Network) -> Result<Self, LpipsError> {
        let n_inputs = network.inputs().len();
        if n_inputs != 2 {
            return Err(LpipsError::Model {
                reason: format!("{n_inputs} inputs, expected two images"),
                path: network.path().to_owned(),
            });
        }
        Ok(Self { network })
    }

    /// 0 for equal images. `rendered` holds r, g, b of every pixel from 0 to 1, at the size of the photo.
    pub fn distance(&mut self, rendered: &[f32], photo: &RgbImage) -> Result<f64, LpipsError> {
        let (width, height) = (i64::from(photo.width_px), i64::from(photo.height_px));
        let tensor = |values: Vec<f32>| Tensor {
            shape: vec![1, 3, height, width],
            values,
        };
        let shown = tensor(planes(&rendered.iter().copied()));
        let seen = tensor(planes(&photo.pixels.iter().map(|v| f32::from(*v) / 255.0)));
        let outputs = self.network.run(vec![shown, seen])?;
        let reason = match outputs.first().map(|output| &output.values[..]) {
            Some([distance]) if distance.is_finite() => return Ok(f64::from(*distance)),
            Some([distance]) => format!("it gives {distance}"),
            other => format!(
                "{} numbers come out, expected one",
                other.map_or(0, <[f32]>::len)
            ),
        };
        Err(LpipsError::Model {
            reason,
            path: self.network.path().to_owned(),
        })
    }
}

/// Red, green and blue planes of n interleaved values from 0 to 1, as -1 to 1.
fn planes(rgb: &(impl Iterator<Item = f32> + Clone)) -> Vec<f32> {
    let channel = |c: usize| rgb.clone().skip(c).step_by(3);
    let scaled = |v: f32| v.clamp(0.0, 1.0).mul_add(2.0, -1.0);
    (0..3).flat_map(|c| channel(c).map(scaled)).collect()
}

/// The network of `eval.lpips_model`; `None` where it is empty.
pub fn lpips(model: &str) -> Result<Option<Lpips>, LpipsError> {
    if model.is_empty() {
        return Ok(None);
    }
    Lpips::of(network(Path::new(model), &NetworkOptions::default())?).map(Some)
}
