//! A network of the contract in docs/MODELS.md: images of a window in, poses, depth and confidence out.

use std::path::Path;

use crate::error::ModelError;
use crate::foundation::contract::{INPUT, Slots, places};
use crate::foundation::decode::{Answer, POSE_LENGTH};
use crate::foundation::params::OnnxParams;
use crate::foundation::sidecar::{InputNorm, Sidecar};
use crate::inference::{Network, NetworkOptions, Provider, Tensor, onnx_runtime};

/// Cores that a network takes without being asked: the optimiser needs some, too.
const MAX_THREADS: usize = 4;
/// Frames that TensorRT tunes for.
const USUAL_FRAMES: usize = 8;
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// A loaded network and what its numbers mean.
#[derive(Debug)]
pub struct Model {
    network: Network,
    places: Slots,
    pub sidecar: Sidecar,
}

impl Model {
    /// By the ONNX Runtime of this machine.
    pub fn open(model: &Path, params: &OnnxParams) -> Result<Self, ModelError> {
        if !cfg!(feature = "onnx") {
            return Err(crate::inference::OnnxError::NotInBuild.into());
        }
        let library = onnx_runtime().ok_or(crate::inference::OnnxError::NoRuntime)?;
        Self::open_by(&library, model, params)
    }

    /// `library`: see `onnx::onnx_runtime`.
    pub fn open_by(library: &Path, model: &Path, params: &OnnxParams) -> Result<Self, ModelError> {
        let unknown = |found| ModelError::Providers { found };
        let providers = Provider::list(&params.providers).map_err(unknown)?;
        // The small file first: its faults are reported without loading gigabytes.
        if !model.is_file() {
            return Err(ModelError::NoFile(model.to_owned()));
        }
        let sidecar = Sidecar::read(model)?;
        let options = NetworkOptions {
            providers,
            n_threads: n_threads(params.threads),
            is_dynamic: true,
            profile: Some(profile(&sidecar)),
        };
        let network = Network::open(library, model, &options)?;
        let places = places(&network.inputs(), &network.outputs(), &sidecar);
        let places = places.map_err(|faults| ModelError::Contract {
            reason: faults.join("; "),
            path: model.to_owned(),
        })?;
        Ok(Self {
            network,
            places,
            sidecar,
        })
    }

    pub fn path(&self) -> &Path {
        self.network.path()
    }

    pub fn provider(&self) -> Provider {
        self.network.provider()
    }

    /// `images`: red, green and blue plane of frame after frame, from 0 to 1, at the size of the network.
    pub fn answer(&mut self, mut images: Vec<f32>) -> Result<Answer, ModelError> {
        let (width, height) = (self.sidecar.width as usize, self.sidecar.height as usize);
        let n_frames = images.len() / (3 * width * height);
        if n_frames == 0 || images.len() != n_frames * 3 * width * height {
            return Err(ModelError::Images {
                n: images.len(),
                width,
                height,
            });
        }
        if self.sidecar.input_norm == InputNorm::Imagenet {
            for (plane_ix, plane) in images.chunks_exact_mut(width * height).enumerate() {
                let (mean, deviation) = (MEAN[plane_ix % 3], DEVIATION[plane_ix % 3]);
                plane.iter_mut().for_each(|v| *v = (*v - mean) / deviation);
            }
        }
        let input = Tensor {
            shape: vec![n_frames as i64, 3, height as i64, width as i64],
            values: images,
        };
        let mut outputs = self.network.run(vec![input])?;
        let mut take = |place: usize, name: &str, sides: &[usize]| {
            let found = std::mem::take(&mut outputs[place]);
            let is_right = found.shape.len() == sides.len()
                && found.shape.iter().zip(sides).all(|(a, b)| *a == *b as i64);
            is_right
                .then_some(found.values)
                .ok_or(ModelError::Contract {
                    reason: format!("{name} came out as {:?}, expected {sides:?}", found.shape),
                    path: self.network.path().to_owned(),
                })
        };
        Ok(Answer {
            n_frames,
            width,
            height,
            pose_enc: take(self.places.pose_enc, "pose_enc", &[n_frames, POSE_LENGTH])?,
            depth: take(self.places.depth, "depth", &[n_frames, height, width])?,
            depth_conf: take(
                self.places.depth_conf,
                "depth_conf",
                &[n_frames, height, width],
            )?,
        })
    }
}

fn n_threads(wanted: usize) -> usize {
    let n_cores = std::thread::available_parallelism().map_or(1, usize::from);
    if wanted > 0 {
        wanted
    } else {
        n_cores.min(MAX_THREADS)
    }
}

fn profile(sidecar: &Sidecar) -> [String; 3] {
    let (least, most) = (sidecar.s_min, sidecar.s_max);
    [least, USUAL_FRAMES.clamp(least, most), most]
        .map(|n| format!("{INPUT}:{n}x3x{}x{}", sidecar.height, sidecar.width))
}
