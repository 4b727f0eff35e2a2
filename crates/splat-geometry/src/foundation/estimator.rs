//! A batch of keyframes -> what a network says of them, window by window, in one frame.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::alignment::aligner::Aligner;
use crate::answer::{GeometryBatch, PoseQuality, PoseStd, PoseUpdate, View};
use crate::error::{GeometryError, ModelError};
use crate::foundation::decode::{self, ModelCamera};
use crate::foundation::drop_reasons::DropReasons;
use crate::foundation::model::Model;
use crate::foundation::params::{IntrinsicsFrom, OnnxParams};
use crate::foundation::preprocess::Fit;
use crate::foundation::window;
use crate::inference::OnnxError;
use crate::model::GeometryModel;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::frame::{Batch, Keyframe};
use splat_types::transform::Rigid;

/// One frame alone has no place.
const MIN_FRAMES: usize = 2;

/// Answers with what a network says. Its frame is the first camera that it registered.
#[derive(Debug)]
pub struct FoundationModel {
    model: Model,
    params: OnnxParams,
    /// Frames of one window.
    window: usize,
    /// Keyframes that have a place, of the newest batch that had any: the next batch shares some of them.
    registered: BTreeMap<u32, Arc<Keyframe>>,
    aligner: Aligner,
    losses: DropReasons,
}

/// A frame that the network registered in its window.
#[derive(Debug)]
struct WindowFrame {
    keyframe: Arc<Keyframe>,
    intrinsics: Intrinsics,
    window_from_cam: Rigid,
    depth: DepthMap,
}

impl WindowFrame {
    /// In the frame of its window.
    fn view(self) -> View {
        View {
            keyframe_id: self.keyframe.id,
            submap: 0,
            intrinsics: self.intrinsics,
            lens: None,
            submap_from_cam: self.window_from_cam,
            depth: self.depth,
            health: PoseQuality::default(),
        }
    }
}

impl FoundationModel {
    /// `aligner` corrects the windows and lays them into one frame. `free_bytes` where the model's provider computes;
    /// `None` where that is unknown.
    pub fn of(
        model: Model,
        params: &OnnxParams,
        aligner: Aligner,
        free_bytes: Option<f64>,
    ) -> Self {
        let provider = model.provider();
        let weights = window::weight_bytes(model.path()) as f64;
        let free = free_bytes.map(|free| (free - weights).max(0.0));
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
            registered: BTreeMap::new(),
            aligner,
            losses: DropReasons::default(),
        }
    }

    /// What the network says of these keyframes, in the frame of the first it registered; empty where that is nothing.
    fn ask(&mut self, keyframes: &[Arc<Keyframe>]) -> Result<Vec<WindowFrame>, GeometryError> {
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
            Ok(WindowFrame {
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

    /// Gives the frames of a window their places: adds views of those that had none, and what others learn by them.
    fn join(&mut self, window: Vec<WindowFrame>, out: &mut GeometryBatch) {
        if window.is_empty() {
            return;
        }
        let is_calibrated = window.iter().all(|seen| {
            self.params.intrinsics != IntrinsicsFrom::Model
                && seen.keyframe.frame.intrinsics.is_some()
        });
        let keyframes: Vec<Arc<Keyframe>> = window.iter().map(|s| s.keyframe.clone()).collect();
        let images = keyframes.iter();
        let images = images.map(|k| (k.id, Arc::clone(&k.frame.image))).collect();
        let views = window.into_iter().map(WindowFrame::view).collect();
        let stamps = keyframes.iter().map(|k| (k.id, k.frame.stamp));
        self.aligner.note_stamps(stamps);
        let mut joined = self.aligner.place(views, &images, is_calibrated);
        tracing::debug!(fit = ?joined.fit, refined = ?joined.refined, "window");
        if joined.fit.is_none() && !self.registered.is_empty() {
            self.losses
                .lose_link(joined.note.take().unwrap_or_default());
        }
        let mut views = joined.views;
        let is_reported = |k: &Arc<Keyframe>| views.iter().any(|view| view.keyframe_id == k.id);
        let reported = keyframes.into_iter().filter(is_reported);
        let reported: Vec<_> = reported.map(|k| (k.id, k)).collect();
        views.retain(|view| !self.registered.contains_key(&view.keyframe_id));
        self.registered.extend(reported);
        let is_elsewhere = |r: &PoseUpdate| views.iter().all(|v| v.keyframe_id != r.keyframe_id);
        out.is_loop |= joined.is_loop;
        out.revise(joined.revised.into_iter().filter(is_elsewhere));
        out.views.extend(views);
    }

    /// The batch, behind some registered keyframes where it shares none itself: its neighbour was dropped.
    fn with_link(&self, batch: &Batch) -> Vec<Arc<Keyframe>> {
        let is_linked = batch
            .keyframes
            .iter()
            .any(|k| self.registered.contains_key(&k.id));
        let n_anchors = if is_linked {
            0
        } else {
            self.params.window_overlap
        };
        let newest = self.registered.values().rev().take(n_anchors);
        let mut keyframes: Vec<_> = newest.cloned().collect();
        keyframes.reverse();
        keyframes.extend(batch.keyframes.iter().cloned());
        keyframes
    }

    fn pose_error(&self, views: &[View]) -> PoseStd {
        let median = views.iter().find_map(|view| view.depth.median());
        PoseStd {
            rotation_rad: self.params.rotation_error_deg.to_radians(),
            translation: self.params.translation_error * median.map_or(0.0, f64::from),
        }
    }
}

impl GeometryModel for FoundationModel {
    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let (mut out, mut done) = (GeometryBatch::default(), 0);
        let keyframes = self.with_link(batch);
        let n = keyframes.len();
        while let Some(range) = window::next(done, n, self.window, self.params.window_overlap) {
            match self.ask(&keyframes[range.clone()]) {
                Ok(window) => self.join(window, &mut out),
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
        let in_submap = |id: &u32| batch.keyframes.iter().any(|k| k.id == *id);
        if self.registered.keys().any(in_submap) {
            self.registered.retain(|id, _| in_submap(id));
        }
        Ok(GeometryBatch {
            batch_id: batch.id,
            pose_error: self.pose_error(&out.views),
            pair_matches: self.aligner.take_new_matches(),
            note: self.losses.note(),
            ..out
        })
    }

    fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        Ok(GeometryBatch {
            revised: self.aligner.finish(),
            pair_matches: self.aligner.take_new_matches(),
            note: self.losses.note(),
            ..GeometryBatch::default()
        })
    }
}
