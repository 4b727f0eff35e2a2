//! Two pictures -> their LPIPS distance, by a network that the user supplies as an ONNX file.
//!
//! The contract stands in docs/FORMATS.md: two inputs [1, 3, H, W] in [-1, 1], one number out. ONNX Runtime is loaded
//! when it is asked for; nothing else needs it.

use std::path::{Path, PathBuf};

use super::machine::{find_library, library_folders};
use crate::frame::RgbImage;

/// How people get the library; `doctor` says it, too.
pub const ONNX_RUNTIME_FIX: &str = "pip install onnxruntime, then export ORT_DYLIB_PATH=<site-packages>/onnxruntime/capi/libonnxruntime.so.<version>";

#[derive(Debug, thiserror::Error)]
pub enum LpipsError {
    #[error(
        "eval.lpips_model needs ONNX Runtime 1.24 or newer, which is not on this machine; {ONNX_RUNTIME_FIX}"
    )]
    NoRuntime,
    #[error("cannot load ONNX Runtime: {reason}; {ONNX_RUNTIME_FIX}: {}", path.display())]
    Runtime { reason: String, path: PathBuf },
    #[error("eval.lpips_model is no LPIPS network: {reason}; docs/FORMATS.md has the contract: {}", path.display())]
    Model { reason: String, path: PathBuf },
    #[error("this build has no ONNX Runtime; build with --features onnx to use eval.lpips_model")]
    NotInBuild,
}

/// The library that is named by ORT_DYLIB_PATH or lies where the loader looks.
pub fn onnx_runtime() -> Option<PathBuf> {
    match std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from) {
        Some(named) => Some(named).filter(|path| path.is_file()),
        None => find_library(&library_folders(), "libonnxruntime.so"),
    }
}

/// Red, green and blue planes of n interleaved values from 0 to 1, as -1 to 1.
#[cfg(feature = "onnx")]
fn planes(rgb: &(impl Iterator<Item = f32> + Clone)) -> Vec<f32> {
    let channel = |c: usize| rgb.clone().skip(c).step_by(3);
    let scaled = |v: f32| v.clamp(0.0, 1.0).mul_add(2.0, -1.0);
    (0..3).flat_map(|c| channel(c).map(scaled)).collect()
}

#[cfg(feature = "onnx")]
mod session {
    use std::sync::OnceLock;

    use ort::environment::Environment;
    use ort::session::Session;
    use ort::value::Tensor;

    use super::{LpipsError, Path, RgbImage, planes};

    /// One environment serves the whole process: ONNX Runtime has no second one.
    static ENVIRONMENT: OnceLock<Result<Environment, String>> = OnceLock::new();

    /// A loaded network.
    #[derive(Debug)]
    pub struct Lpips {
        session: Session,
        path: std::path::PathBuf,
    }

    impl Lpips {
        /// `library`: see `onnx_runtime`; the first one that is named stays loaded.
        pub fn open(library: &Path, model: &Path) -> Result<Self, LpipsError> {
            let environment = ENVIRONMENT.get_or_init(|| {
                let builder = ort::init_from(library).map_err(|e| e.to_string())?;
                builder.build().map_err(|e| e.to_string())
            });
            let environment = environment.as_ref().map_err(|reason| LpipsError::Runtime {
                reason: reason.clone(),
                path: library.to_owned(),
            })?;
            let fail = |reason: String| LpipsError::Model {
                reason,
                path: model.to_owned(),
            };
            let session = Session::builder(environment)
                .and_then(|mut builder| builder.commit_from_file(model))
                .map_err(|e| fail(first_line(&e)))?;
            let n_inputs = session.inputs().len();
            if n_inputs != 2 {
                return Err(fail(format!("{n_inputs} inputs, expected two pictures")));
            }
            Ok(Self {
                session,
                path: model.to_owned(),
            })
        }

        /// 0 for equal pictures. `rendered` holds r, g, b of every pixel from 0 to 1, at the size of the photo.
        pub fn distance(&mut self, rendered: &[f32], photo: &RgbImage) -> Result<f64, LpipsError> {
            let fail = |reason: String| LpipsError::Model {
                reason,
                path: self.path.clone(),
            };
            let (width, height) = (i64::from(photo.width_px), i64::from(photo.height_px));
            let tensor = |planes: Vec<f32>| {
                Tensor::from_array(([1, 3, height, width], planes))
                    .map_err(|e| fail(first_line(&e)))
            };
            let shown = tensor(planes(&rendered.iter().copied()))?;
            let seen = tensor(planes(&photo.pixels.iter().map(|v| f32::from(*v) / 255.0)))?;
            let inputs = ort::inputs![shown, seen];
            let outputs = self.session.run(inputs).map_err(|e| fail(first_line(&e)))?;
            let (_, values) = outputs[0]
                .try_extract_tensor::<f32>()
                .map_err(|e| fail(first_line(&e)))?;
            match values {
                [distance] if distance.is_finite() => Ok(f64::from(*distance)),
                [distance] => Err(fail(format!("it gives {distance}"))),
                _ => Err(fail(format!(
                    "{} numbers come out, expected one",
                    values.len()
                ))),
            }
        }
    }

    /// ONNX Runtime adds stacks and hints.
    fn first_line(error: &impl ToString) -> String {
        let text = error.to_string();
        text.lines().next().unwrap_or_default().to_owned()
    }
}

#[cfg(feature = "onnx")]
pub use session::Lpips;

/// Stands where builds with `onnx` have the network; there is never one.
#[cfg(not(feature = "onnx"))]
#[derive(Debug)]
pub enum Lpips {}

#[cfg(not(feature = "onnx"))]
impl Lpips {
    pub fn open(_library: &Path, _model: &Path) -> Result<Self, LpipsError> {
        Err(LpipsError::NotInBuild)
    }

    pub fn distance(&mut self, _rendered: &[f32], _photo: &RgbImage) -> Result<f64, LpipsError> {
        match *self {}
    }
}

/// The network of `eval.lpips_model`; `None` where it is empty.
pub fn lpips(model: &str) -> Result<Option<Lpips>, LpipsError> {
    if model.is_empty() {
        return Ok(None);
    }
    if !cfg!(feature = "onnx") {
        return Err(LpipsError::NotInBuild);
    }
    let library = onnx_runtime().ok_or(LpipsError::NoRuntime)?;
    Lpips::open(&library, Path::new(model)).map(Some)
}
