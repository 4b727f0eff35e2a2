//! An ONNX file -> a network that turns numbers into numbers. ONNX Runtime is loaded when it is first asked for.
//!
//! Knows nothing of pictures. The library is found at run time, so a program without it starts all the same.

use std::path::{Path, PathBuf};

use crate::libraries::{find_library, library_folders};

/// How people get the library; `doctor` says it, too.
pub const ONNX_RUNTIME_FIX: &str = "pip install onnxruntime, then export ORT_DYLIB_PATH=<site-packages>/onnxruntime/capi/libonnxruntime.so.<version>";

#[derive(Debug, thiserror::Error)]
pub enum OnnxError {
    #[error(
        "it needs ONNX Runtime 1.24 or newer, which is not on this machine; {ONNX_RUNTIME_FIX}"
    )]
    NoRuntime,
    #[error("cannot load ONNX Runtime: {reason}; {ONNX_RUNTIME_FIX}: {}", path.display())]
    Runtime { reason: String, path: PathBuf },
    #[error("ONNX Runtime refuses the network: {reason}: {}", path.display())]
    Network { reason: String, path: PathBuf },
    #[error("this build has no ONNX Runtime; build with --features onnx")]
    NotInBuild,
}

/// Numbers of a known shape.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    pub shape: Vec<i64>,
    pub values: Vec<f32>,
}

/// The library that is named by ORT_DYLIB_PATH or lies where the loader looks.
pub fn onnx_runtime() -> Option<PathBuf> {
    match std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from) {
        Some(named) => Some(named).filter(|path| path.is_file()),
        None => find_library(&library_folders(), "libonnxruntime.so"),
    }
}

#[cfg(feature = "onnx")]
mod session {
    use std::sync::OnceLock;

    use ort::environment::Environment;
    use ort::session::Session;

    use super::{OnnxError, Path, PathBuf, Tensor};

    /// One environment serves the whole process: ONNX Runtime has no second one.
    static ENVIRONMENT: OnceLock<Result<Environment, String>> = OnceLock::new();

    #[derive(Debug)]
    pub struct Network {
        session: Session,
        path: PathBuf,
    }

    impl Network {
        /// `library`: see `onnx_runtime`; the first one that is named stays loaded.
        pub fn open(library: &Path, model: &Path) -> Result<Self, OnnxError> {
            let environment = ENVIRONMENT.get_or_init(|| {
                let builder = ort::init_from(library).map_err(|e| e.to_string())?;
                builder.build().map_err(|e| e.to_string())
            });
            let environment = environment.as_ref().map_err(|reason| OnnxError::Runtime {
                reason: reason.clone(),
                path: library.to_owned(),
            })?;
            let session = Session::builder(environment)
                .and_then(|mut builder| builder.commit_from_file(model))
                .map_err(|e| refused(&e, model))?;
            Ok(Self {
                session,
                path: model.to_owned(),
            })
        }

        pub fn path(&self) -> &Path {
            &self.path
        }

        /// Name and shape of every input, -1 where a side is free.
        pub fn inputs(&self) -> Vec<(String, Vec<i64>)> {
            self.session.inputs().iter().map(described).collect()
        }

        pub fn outputs(&self) -> Vec<(String, Vec<i64>)> {
            self.session.outputs().iter().map(described).collect()
        }

        /// Inputs and outputs in the network's order.
        pub fn run(&mut self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError> {
            let refused = |e: ort::Error| refused(&e, &self.path);
            let input = |tensor: Tensor| {
                let value = ort::value::Tensor::from_array((tensor.shape, tensor.values))?;
                Ok(ort::session::SessionInputValue::from(value))
            };
            let inputs: Result<Vec<_>, ort::Error> = inputs.into_iter().map(input).collect();
            let outputs = self
                .session
                .run(&inputs.map_err(refused)?[..])
                .map_err(refused)?;
            let output = |ix: usize| {
                let (shape, values) = outputs[ix].try_extract_tensor::<f32>()?;
                Ok(Tensor {
                    shape: shape.to_vec(),
                    values: values.to_vec(),
                })
            };
            (0..outputs.len())
                .map(output)
                .collect::<Result<_, _>>()
                .map_err(refused)
        }
    }

    fn described(outlet: &ort::value::Outlet) -> (String, Vec<i64>) {
        let shape = outlet.dtype().tensor_shape().map(|shape| shape.to_vec());
        (outlet.name().to_owned(), shape.unwrap_or_default())
    }

    /// ONNX Runtime adds stacks and hints after the first line.
    fn refused(error: &impl ToString, path: &Path) -> OnnxError {
        let text = error.to_string();
        OnnxError::Network {
            reason: text.lines().next().unwrap_or_default().to_owned(),
            path: path.to_owned(),
        }
    }
}

#[cfg(feature = "onnx")]
pub use session::Network;

/// Stands where builds with `onnx` have networks; there is never one.
#[cfg(not(feature = "onnx"))]
#[derive(Debug)]
pub enum Network {}

#[cfg(not(feature = "onnx"))]
impl Network {
    pub fn open(_library: &Path, _model: &Path) -> Result<Self, OnnxError> {
        Err(OnnxError::NotInBuild)
    }

    pub fn path(&self) -> &Path {
        match *self {}
    }

    pub fn inputs(&self) -> Vec<(String, Vec<i64>)> {
        match *self {}
    }

    pub fn outputs(&self) -> Vec<(String, Vec<i64>)> {
        match *self {}
    }

    pub fn run(&mut self, _inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError> {
        match *self {}
    }
}

/// The network of a file, by the library that is on this machine.
pub fn network(model: &Path) -> Result<Network, OnnxError> {
    if !cfg!(feature = "onnx") {
        return Err(OnnxError::NotInBuild);
    }
    let library = onnx_runtime().ok_or(OnnxError::NoRuntime)?;
    Network::open(&library, model)
}
