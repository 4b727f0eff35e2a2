//! An ONNX file -> a network that turns numbers into numbers. ONNX Runtime is loaded when it is first asked for.
//!
//! Knows nothing of images. The library is found at run time, so a program without it starts all the same.

use std::path::{Path, PathBuf};

use crate::shared_library::{find_library, library_folders};

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
    #[error("none of the providers {wanted} runs the network: {reason}; name cpu among them: {}", path.display())]
    NoProvider {
        wanted: String,
        reason: String,
        path: PathBuf,
    },
    #[error("this build has no ONNX Runtime; build with --features onnx")]
    NotInBuild,
}

/// What computes a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Provider {
    TensorRt,
    Cuda,
    Cpu,
}

impl Provider {
    /// The fastest first.
    pub const ALL: [Self; 3] = [Self::TensorRt, Self::Cuda, Self::Cpu];

    pub fn name(self) -> &'static str {
        match self {
            Self::TensorRt => "tensorrt",
            Self::Cuda => "cuda",
            Self::Cpu => "cpu",
        }
    }

    /// `auto`, or names by commas in the order in which they are tried; the name that is none of ours otherwise.
    pub fn list(text: &str) -> Result<Vec<Self>, String> {
        if text.trim() == "auto" {
            return Ok(Self::ALL.to_vec());
        }
        let of_name = |name: &str| {
            let found = Self::ALL.into_iter().find(|p| p.name() == name.trim());
            found.ok_or_else(|| name.trim().to_owned())
        };
        text.split(',').map(of_name).collect()
    }
}

/// How a network is run.
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkOptions {
    /// Tried in this order.
    pub providers: Vec<Provider>,
    /// Threads of one run; 0 leaves it to ONNX Runtime.
    pub n_threads: usize,
    /// Shapes change from run to run: no plan of memory is kept, and memory goes back after every run.
    pub is_dynamic: bool,
    /// Smallest, usual and largest shape of the first input, as TensorRT wants to know them: `images:1x3x8x8`.
    pub profile: Option<[String; 3]>,
}

impl Default for NetworkOptions {
    fn default() -> Self {
        Self {
            providers: vec![Provider::Cpu],
            n_threads: 0,
            is_dynamic: false,
            profile: None,
        }
    }
}

/// An input or an output of a network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Port {
    pub name: String,
    /// As Rust names numbers: f32, i64; empty for what is no tensor.
    pub element: String,
    /// -1 where a side is free.
    pub shape: Vec<i64>,
}

impl std::fmt::Display for Port {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} {} {:?}", self.name, self.element, self.shape)
    }
}

/// Numbers of a known shape.
#[derive(Debug, Clone, Default, PartialEq)]
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
    use ort::ep::{self, ExecutionProvider as _};
    use ort::logging::LogLevel;
    use ort::session::{RunOptions, Session};

    use super::{NetworkOptions, OnnxError, Path, PathBuf, Port, Provider, Tensor};

    /// One environment serves the whole process: ONNX Runtime has no second one.
    static ENVIRONMENT: OnceLock<Result<Environment, String>> = OnceLock::new();

    pub struct Network {
        session: Session,
        provider: Provider,
        run_options: RunOptions,
        path: PathBuf,
    }

    impl std::fmt::Debug for Network {
        fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            write!(f, "Network({:?}, {})", self.provider, self.path.display())
        }
    }

    impl Network {
        /// `library`: see `onnx_runtime`; the first one that is named stays loaded.
        pub fn open(
            library: &Path,
            model: &Path,
            options: &NetworkOptions,
        ) -> Result<Self, OnnxError> {
            let environment = ENVIRONMENT.get_or_init(|| {
                let builder = ort::init_from(library).map_err(|e| e.to_string())?;
                let builder = builder.with_telemetry(false);
                builder.build().map_err(|e| e.to_string())
            });
            let environment = environment.as_ref().map_err(|reason| OnnxError::Runtime {
                reason: first_line(reason),
                path: library.to_owned(),
            })?;
            let (session, provider) = first_session(environment, model, options)?;
            let run_options = run_options(provider, options.is_dynamic);
            Ok(Self {
                session,
                provider,
                run_options: run_options.map_err(|e| refused(&e, model))?,
                path: model.to_owned(),
            })
        }

        pub fn path(&self) -> &Path {
            &self.path
        }

        pub fn provider(&self) -> Provider {
            self.provider
        }

        pub fn inputs(&self) -> Vec<Port> {
            self.session.inputs().iter().map(described).collect()
        }

        pub fn outputs(&self) -> Vec<Port> {
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
                .run_with_options(&inputs.map_err(refused)?[..], &self.run_options)
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

    /// The session of the first provider that takes the network.
    fn first_session(
        environment: &Environment,
        model: &Path,
        options: &NetworkOptions,
    ) -> Result<(Session, Provider), OnnxError> {
        let mut reasons = Vec::new();
        for &provider in &options.providers {
            match session(environment, model, options, provider) {
                Ok(session) => {
                    if !reasons.is_empty() {
                        let reasons: Vec<String> = std::mem::take(&mut reasons);
                        tracing::info!(
                            "networks run on {}: {}",
                            provider.name(),
                            reasons.join("; ")
                        );
                    }
                    return Ok((session, provider));
                }
                // The CPU takes every network that is one, so what it says is about the network.
                Err(e) if provider == Provider::Cpu => return Err(refused(&e, model)),
                Err(e) => reasons.push(format!("{}: {}", provider.name(), first_line(&e))),
            }
        }
        let names: Vec<&str> = options.providers.iter().map(|p| p.name()).collect();
        Err(OnnxError::NoProvider {
            wanted: names.join(","),
            reason: reasons.join("; "),
            path: model.to_owned(),
        })
    }

    fn session(
        environment: &Environment,
        model: &Path,
        options: &NetworkOptions,
        provider: Provider,
    ) -> Result<Session, ort::Error> {
        let mut builder = Session::builder(environment)?.with_log_level(LogLevel::Error)?;
        if options.n_threads > 0 {
            builder = builder.with_intra_threads(options.n_threads)?;
        }
        if options.is_dynamic {
            builder = builder.with_memory_pattern(false)?;
        }
        let is_there = match provider {
            Provider::TensorRt => ep::TensorRT::is_available()?,
            Provider::Cuda => ep::CUDA::is_available()?,
            Provider::Cpu => true,
        };
        if !is_there {
            return Err(ort::Error::new("this ONNX Runtime is built without it"));
        }
        match provider {
            Provider::TensorRt => tensor_rt(model, options).register(&mut builder)?,
            Provider::Cuda => ep::CUDA::default().register(&mut builder)?,
            Provider::Cpu => {}
        }
        builder.commit_from_file(model)
    }

    /// Engines take minutes to build, so they are kept beside the network.
    fn tensor_rt(model: &Path, options: &NetworkOptions) -> ep::TensorRT {
        let folder = model.with_extension("tensorrt").display().to_string();
        let provider = ep::TensorRT::default()
            .with_engine_cache(true)
            .with_engine_cache_path(&folder)
            .with_timing_cache(true)
            .with_timing_cache_path(&folder);
        match &options.profile {
            None => provider,
            Some([least, usual, most]) => provider
                .with_profile_min_shapes(least)
                .with_profile_opt_shapes(usual)
                .with_profile_max_shapes(most),
        }
    }

    fn run_options(provider: Provider, is_dynamic: bool) -> Result<RunOptions, ort::Error> {
        let mut run_options = RunOptions::new()?;
        if is_dynamic {
            let arenas = match provider {
                Provider::Cpu => "cpu:0",
                Provider::TensorRt | Provider::Cuda => "cpu:0;gpu:0",
            };
            run_options.set("memory.enable_memory_arena_shrinkage", arenas)?;
        }
        Ok(run_options)
    }

    fn described(outlet: &ort::value::Outlet) -> Port {
        let kind = outlet.dtype();
        Port {
            name: outlet.name().to_owned(),
            element: kind
                .tensor_type()
                .map(|t| t.to_string())
                .unwrap_or_default(),
            shape: kind
                .tensor_shape()
                .map(|shape| shape.to_vec())
                .unwrap_or_default(),
        }
    }

    /// ONNX Runtime adds stacks and hints after the first line.
    fn refused(error: &impl ToString, path: &Path) -> OnnxError {
        OnnxError::Network {
            reason: first_line(error),
            path: path.to_owned(),
        }
    }

    fn first_line(error: &impl ToString) -> String {
        let text = error.to_string();
        text.lines().next().unwrap_or_default().to_owned()
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
    pub fn open(
        _library: &Path,
        _model: &Path,
        _options: &NetworkOptions,
    ) -> Result<Self, OnnxError> {
        Err(OnnxError::NotInBuild)
    }

    pub fn path(&self) -> &Path {
        match *self {}
    }

    pub fn provider(&self) -> Provider {
        match *self {}
    }

    pub fn inputs(&self) -> Vec<Port> {
        match *self {}
    }

    pub fn outputs(&self) -> Vec<Port> {
        match *self {}
    }

    pub fn run(&mut self, _inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError> {
        match *self {}
    }
}

/// The network of a file, by the library that is on this machine.
pub fn network(model: &Path, options: &NetworkOptions) -> Result<Network, OnnxError> {
    if !cfg!(feature = "onnx") {
        return Err(OnnxError::NotInBuild);
    }
    let library = onnx_runtime().ok_or(OnnxError::NoRuntime)?;
    Network::open(&library, model, options)
}
