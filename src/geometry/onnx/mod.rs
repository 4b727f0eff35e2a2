//! A batch of keyframes -> poses, depth and confidence by a foundation model (VGGT, Depth-Anything-3) that the user
//! supplies as an ONNX file. docs/MODELS.md has the contract.
//!
//! A model answers for one window of frames, in the frame and scale of that window; windows are joined by the frames
//! that they share. What fails is dropped and counted, and no number that is none gets out.

pub mod chain;
pub mod check;
pub mod contract;
pub mod decode;
mod losses;
pub mod model;
pub mod preprocess;
pub mod sidecar;
pub mod window;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::config::onnx::{IntrinsicsFrom, OnnxParams};
use crate::frame::{Batch, DepthMap, Keyframe};
use crate::geometry::onnx::chain::Shared;
use crate::geometry::onnx::decode::ModelCamera;
use crate::geometry::onnx::losses::Losses;
use crate::geometry::onnx::model::Model;
use crate::geometry::onnx::preprocess::Fit;
use crate::geometry::{GeometryBatch, GeometryError, GeometryModel, Health, PoseError, View};
use crate::onnx::OnnxError;
use crate::pose::{Rigid, Similarity};

/// One frame alone has no place.
const MIN_FRAMES: usize = 2;
/// Scales of neighbouring windows differ by less, if they show the same scene.
const MAX_SCALE_STEP: f64 = 3.0;

#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    #[error("onnx.providers names {found:?}, expected auto or some of tensorrt, cuda, cpu")]
    Providers { found: String },
    #[error("there is no model; --geometry onnx:FILE names an ONNX file as docs/MODELS.md describes it: {}", .0.display())]
    NoFile(PathBuf),
    #[error("the model's description cannot be used: {reason}; scripts/export_model.py writes it beside the model, docs/MODELS.md lists its keys: {}", path.display())]
    Sidecar { reason: String, path: PathBuf },
    #[error("this network is no model for --geometry onnx: {reason}; docs/MODELS.md has the contract: {}", path.display())]
    Contract { reason: String, path: PathBuf },
    #[error("{n} numbers make no whole number of pictures of {width}x{height}")]
    Pictures {
        n: usize,
        width: usize,
        height: usize,
    },
    #[error("--geometry onnx: {0}")]
    Onnx(#[from] OnnxError),
}

/// Answers with what a network says. Its frame is the first camera that it placed.
#[derive(Debug)]
pub struct Foundation {
    model: Model,
    params: OnnxParams,
    /// Frames of one window.
    window: usize,
    /// Keyframes that have a place, of the newest batch that had any: the next batch shares some of them.
    placed: BTreeMap<u32, Placed>,
    /// Components that windows without a link have begun.
    n_components: u32,
    /// Scale of the newest window that was joined.
    last_scale: Option<f64>,
    losses: Losses,
}

#[derive(Debug)]
struct Placed {
    keyframe: Arc<Keyframe>,
    component: u32,
    component_from_cam: Rigid,
    depth: DepthMap,
}

/// A frame that the network placed in its window.
#[derive(Debug)]
struct Seen {
    keyframe: Arc<Keyframe>,
    intrinsics: Intrinsics,
    window_from_cam: Rigid,
    depth: DepthMap,
}

impl Foundation {
    pub fn open(model: &Path, params: &OnnxParams) -> Result<Self, ModelError> {
        Ok(Self::of(Model::open(model, params)?, params))
    }

    pub fn of(model: Model, params: &OnnxParams) -> Self {
        let provider = model.provider();
        let weights = window::weight_bytes(model.path()) as f64;
        let free = window::free_bytes(provider).map(|free| (free - weights).max(0.0));
        let window = window::size(&model.sidecar, params.window, free);
        let sidecar = &model.sidecar;
        tracing::info!(
            "{:?} model of {}x{} on {}, up to {window} frames at once: {}",
            sidecar.family,
            sidecar.width,
            sidecar.height,
            provider.name(),
            model.path().display()
        );
        Self {
            model,
            params: params.clone(),
            window,
            placed: BTreeMap::new(),
            n_components: 0,
            last_scale: None,
            losses: Losses::default(),
        }
    }

    /// What the network says of these keyframes, in the frame of the first it placed; empty where that is nothing.
    fn ask(&mut self, keyframes: &[Arc<Keyframe>]) -> Result<Vec<Seen>, GeometryError> {
        let images = keyframes.iter().map(|k| &k.frame.image);
        let fits: Vec<Fit> = images.map(|i| Fit::new(i, &self.model.sidecar)).collect();
        if let Some(fit) = fits.iter().find(|fit| !fit.is_whole()) {
            self.losses.warn_of_bars(fit);
        }
        let mut planes = Vec::new();
        for (keyframe, fit) in keyframes.iter().zip(&fits) {
            planes.extend(fit.planes(&keyframe.frame.image));
        }
        // A network that wants more frames sees the last one again; what it says of it then is not asked for.
        let one = planes[planes.len() - planes.len() / keyframes.len()..].to_vec();
        for _ in keyframes.len()..self.model.sidecar.s_min {
            planes.extend_from_slice(&one);
        }
        let answer = self.model.answer(planes)?;
        let mut cameras = Vec::new();
        for (frame, camera) in answer
            .cameras(self.model.sidecar.pose)
            .into_iter()
            .enumerate()
        {
            if frame == keyframes.len() {
                break;
            }
            match camera.and_then(|c| answer.fault_of(frame).map_or(Ok(c), Err)) {
                Ok(camera) => cameras.push((frame, camera)),
                Err(fault) => self.losses.lose_frame(fault),
            }
        }
        self.losses.count(keyframes.len());
        let frames: Vec<usize> = cameras.iter().map(|(frame, _)| *frame).collect();
        if frames.len() < MIN_FRAMES {
            self.losses
                .lose_window("fewer than 2 frames of a window could be used");
            return Ok(Vec::new());
        }
        if answer.is_flat(&frames) {
            self.losses.lose_window("depth is the same everywhere");
            return Ok(Vec::new());
        }
        let median = answer.median_confidence(&frames);
        let seen = cameras.into_iter().map(|(frame, camera)| {
            let (keyframe, fit) = (&keyframes[frame], &fits[frame]);
            let trust: Vec<f32> = answer
                .confidence_of(frame)
                .iter()
                .map(|c| decode::trust(*c, median))
                .collect();
            Ok(Seen {
                keyframe: Arc::clone(keyframe),
                intrinsics: self.intrinsics(keyframe, fit, &camera)?,
                window_from_cam: camera.window_from_cam,
                depth: fit.depth_map(answer.depth_of(frame), &trust),
            })
        });
        seen.collect()
    }

    fn intrinsics(
        &self,
        keyframe: &Keyframe,
        fit: &Fit,
        camera: &ModelCamera,
    ) -> Result<Intrinsics, GeometryError> {
        let predicted = fit.intrinsics(camera);
        match self.params.intrinsics {
            IntrinsicsFrom::Model => Ok(predicted),
            IntrinsicsFrom::Auto => Ok(keyframe.frame.intrinsics.unwrap_or(predicted)),
            IntrinsicsFrom::Camera => keyframe.frame.intrinsics.ok_or(GeometryError::Missing {
                model: "onnx.intrinsics=camera",
                needs: "a calibration (CameraInfo or intrinsics.json)",
                keyframe_id: keyframe.id,
                way_out: "use onnx.intrinsics=auto",
            }),
        }
    }

    /// Gives the frames of a window their places. Returns views of those that had none.
    fn join(&mut self, window: Vec<Seen>) -> Vec<View> {
        if window.is_empty() {
            return Vec::new();
        }
        let (component, component_from_window) = self.link(&window).unwrap_or_else(|| {
            self.n_components += 1;
            (self.n_components - 1, Similarity::IDENTITY)
        });
        let mut views = Vec::new();
        for seen in window {
            let id = seen.keyframe.id;
            let is_placed = self.placed.get(&id);
            if is_placed.is_some_and(|placed| placed.component == component) {
                continue;
            }
            let mut depth = seen.depth;
            for value in &mut depth.depth {
                *value = (f64::from(*value) * component_from_window.scale) as f32;
            }
            let component_from_cam = component_from_window.transform_pose(&seen.window_from_cam);
            let is_new = is_placed.is_none();
            let placed = Placed {
                keyframe: seen.keyframe,
                component,
                component_from_cam,
                depth: depth.clone(),
            };
            // A frame that an older component has is kept there, and links what comes to the newer one.
            self.placed.insert(id, placed);
            if is_new {
                views.push(View {
                    keyframe_id: id,
                    component,
                    intrinsics: seen.intrinsics,
                    batch_from_cam: component_from_cam,
                    depth,
                    health: Health::default(),
                });
            }
        }
        views
    }

    /// The newest component that the window shares frames with, and the way there; `None` where there is none, or none
    /// to trust.
    fn link(&mut self, window: &[Seen]) -> Option<(u32, Similarity)> {
        let both = window
            .iter()
            .filter_map(|seen| Some((seen, self.placed.get(&seen.keyframe.id)?)));
        let both: Vec<(&Seen, &Placed)> = both.collect();
        let component = both.iter().map(|(_, placed)| placed.component).max()?;
        let of_component = both
            .iter()
            .filter(|(_, placed)| placed.component == component);
        let shared: Vec<Shared<'_>> = of_component
            .map(|(seen, placed)| Shared {
                map_from_cam: placed.component_from_cam,
                depth_in_map: &placed.depth,
                window_from_cam: seen.window_from_cam,
                depth_in_window: &seen.depth,
            })
            .collect();
        let found = chain::similarity(&shared).and_then(|similarity| {
            let step = self.last_scale.map_or(1.0, |last| similarity.scale / last);
            let is_near = (1.0 / MAX_SCALE_STEP..=MAX_SCALE_STEP).contains(&step);
            is_near.then_some(similarity).ok_or_else(|| {
                format!("scale jumps by a factor of {step:.2}, more than {MAX_SCALE_STEP}")
            })
        });
        match found {
            Ok(similarity) => {
                self.last_scale = Some(similarity.scale);
                Some((component, similarity))
            }
            Err(reason) => {
                self.last_scale = None;
                self.losses.lose_link(reason);
                None
            }
        }
    }

    /// The batch, behind some placed keyframes where it shares none itself: its neighbour was dropped.
    fn with_link(&self, batch: &Batch) -> Vec<Arc<Keyframe>> {
        let is_linked = batch
            .keyframes
            .iter()
            .any(|k| self.placed.contains_key(&k.id));
        let n_anchors = if is_linked {
            0
        } else {
            self.params.window_overlap
        };
        let newest = self.placed.values().rev().take(n_anchors);
        let mut keyframes: Vec<_> = newest.map(|p| Arc::clone(&p.keyframe)).collect();
        keyframes.reverse();
        keyframes.extend(batch.keyframes.iter().cloned());
        keyframes
    }

    fn pose_error(&self, views: &[View]) -> PoseError {
        let median = views.iter().find_map(|view| view.depth.median());
        PoseError {
            rotation_rad: self.params.rotation_error_deg.to_radians(),
            translation: self.params.translation_error * median.map_or(0.0, f64::from),
        }
    }
}

impl GeometryModel for Foundation {
    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let (mut views, mut done) = (Vec::new(), 0);
        let keyframes = self.with_link(batch);
        let n = keyframes.len();
        while let Some(range) = window::next(done, n, self.window, self.params.window_overlap) {
            match self.ask(&keyframes[range.clone()]) {
                Ok(window) => views.extend(self.join(window)),
                // What a network says against a window is mostly that memory is short.
                Err(GeometryError::Model(ModelError::Onnx(error @ OnnxError::Network { .. })))
                    if range.len() > self.model.sidecar.s_min.max(MIN_FRAMES) =>
                {
                    self.window = (range.len() / 2)
                        .max(self.model.sidecar.s_min)
                        .max(MIN_FRAMES);
                    tracing::warn!("{} frames at once from here: {error}", self.window);
                    continue;
                }
                Err(error) => return Err(error),
            }
            done = range.end;
        }
        let in_batch = |id: &u32| batch.keyframes.iter().any(|k| k.id == *id);
        if self.placed.keys().any(in_batch) {
            self.placed.retain(|id, _| in_batch(id));
        }
        Ok(GeometryBatch {
            batch_id: batch.id,
            pose_error: self.pose_error(&views),
            views,
            note: self.losses.note(),
            ..GeometryBatch::default()
        })
    }

    fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        Ok(GeometryBatch {
            note: self.losses.note(),
            ..GeometryBatch::default()
        })
    }
}
