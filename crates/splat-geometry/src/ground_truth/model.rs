//! Geometry from the recording's own truth, with stated noise: runs the whole node without estimating a pose.
//!
//! Depth is the recording's where it has some, else stereo at the true poses, for which frames that the source holds
//! out are not used: what measures quality must not shape the map. Poses and depth are disturbed after
//! that, each by its own noise: depth that rested on poses 1 deg off would be none at all, as neighbouring images
//! would lie several pixels beside the lines on which stereo looks for them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::DVec3;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use crate::alignment::aligner::Aligner;
use crate::alignment::pair_matcher::PairMatcher;
use crate::alignment::params::AlignParams;
use crate::answer::{GeometryBatch, PoseQuality, PoseStd, View};
use crate::error::GeometryError;
use crate::ground_truth::noise::{Noise, answer, normal, normal3};
use crate::ground_truth::params::GroundTruthParams;
use crate::model::GeometryModel;
use crate::mvs::params::MvsParams;
use crate::sfm::known_poses::KnownPoseStereo;
use crate::sfm::params::SfmParams;
use splat_types::depth::DepthMap;
use splat_types::frame::{Batch, Keyframe};
use splat_types::transform::Rigid;

/// Drift is stated per so many keyframes.
const DRIFT_KEYFRAMES: f64 = 100.0;
/// Added to the seed for the direction of the drift, which is one for all keyframes.
const DRIFT_STREAM: u64 = 0x5eed_d41f;

/// Answers with `Frame::truth`, and with `Frame::sensor_depth` or stereo. The batch frame is the recording's map frame,
/// in its unit.
#[derive(Debug)]
pub struct GroundTruthModel {
    params: GroundTruthParams,
    seed: u64,
    /// Largest distance between two true positions: the unit of `*_extent`.
    extent: f64,
    stereo: KnownPoseStereo,
    /// By keyframe id: the pose that was given out, and the generator as drawing it left it. A shared keyframe gets
    /// the same noise in every batch, even when its depth and so its median changes.
    disturbed: BTreeMap<u32, (Rigid, Pcg64Mcg)>,
    /// With `ground_truth.windows`: what a foundation model's answers go through.
    aligner: Option<Aligner>,
    /// Without windows, where matches are wanted.
    pairs: Option<PairMatcher>,
    /// A keyframe has had a pose.
    has_posed: bool,
    /// Keyframes that had none.
    left_out: BTreeSet<u32>,
}

impl GroundTruthModel {
    pub fn new(
        params: GroundTruthParams,
        (sfm, mvs): (&SfmParams, &MvsParams),
        extent: Option<f64>,
        seed: u64,
    ) -> Result<Self, GeometryError> {
        let shares = [
            params.translation_noise_extent,
            params.drift_extent,
            params.offset_extent,
        ];
        let needs_extent = shares.iter().any(|share| *share > 0.0);
        if needs_extent && extent.is_none() {
            return Err(GeometryError::NoExtent);
        }
        Ok(Self {
            params,
            seed,
            extent: extent.unwrap_or(0.0),
            stereo: KnownPoseStereo::new(sfm, mvs, seed)?,
            disturbed: BTreeMap::new(),
            aligner: None,
            pairs: None,
            has_posed: false,
            left_out: BTreeSet::new(),
        })
    }

    /// Answers each batch as a foundation model does, if `ground_truth.windows` asks for it: in a frame and unit of its own,
    /// with fresh noise, then corrected and joined.
    pub fn in_windows(
        mut self,
        align: &AlignParams,
        sfm: &SfmParams,
    ) -> Result<Self, GeometryError> {
        if self.params.windows {
            self.aligner = Some(Aligner::new(align, sfm, self.seed)?);
        }
        Ok(self)
    }

    /// Reports matches between keyframes too, by features of their images. Windows report theirs in any case.
    pub fn with_matches(mut self, sfm: &SfmParams) -> Result<Self, GeometryError> {
        if !self.params.windows {
            self.pairs = Some(PairMatcher::new(sfm, self.seed)?);
        }
        Ok(self)
    }

    fn infer_window(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let views = self.true_views(batch)?;
        let window = answer(
            &views,
            &self.noise(),
            self.seed ^ (u64::from(batch.id) << 24),
        );
        let images = batch.keyframes.iter();
        let images = images.map(|k| (k.id, Arc::clone(&k.frame.image))).collect();
        let Some(aligner) = &mut self.aligner else {
            return Ok(GeometryBatch::default());
        };
        aligner.note_stamps(batch.keyframes.iter().map(|k| (k.id, k.frame.stamp)));
        // A network takes the focal length of a calibrated camera, and has no error of it.
        let is_calibrated = self.params.focal_error == 0.0;
        let joined = aligner.place(window, &images, is_calibrated);
        tracing::debug!(batch = batch.id, fit = ?joined.fit, refined = ?joined.refined, "window");
        Ok(GeometryBatch {
            batch_id: batch.id,
            views: joined.views,
            revised: joined.revised,
            pair_matches: aligner.take_new_matches(),
            is_loop: joined.is_loop,
            note: joined.note,
            ..GeometryBatch::default()
        })
    }

    /// Views of this batch as they are, in the order of the batch.
    fn true_views(&mut self, batch: &Batch) -> Result<Vec<View>, GeometryError> {
        let mut views = exact_views(batch)?;
        if views.len() < batch.keyframes.len() {
            let by_stereo = self.views_by_stereo(batch)?.views;
            let is_wanted = |view: &View| {
                let is_ready = views.iter().any(|v| v.keyframe_id == view.keyframe_id);
                !is_ready && batch.keyframes.iter().any(|k| k.id == view.keyframe_id)
            };
            let wanted: Vec<View> = by_stereo.into_iter().filter(is_wanted).collect();
            views.extend(wanted);
            views.sort_by_key(|view| view.keyframe_id);
        }
        Ok(views)
    }

    fn noise(&self) -> Noise {
        let params = &self.params;
        Noise {
            scale: params.window_scale,
            rotation_deg: params.rotation_noise_deg,
            translation: params.translation_noise,
            depth: params.depth_noise,
            outliers: params.depth_outliers,
            jumps: params.window_jumps,
            walk_deg: params.walk_deg,
            walk_translation: params.walk_translation,
            warp: params.depth_warp,
            edge_px: params.edge_bleed_px,
            focal: params.focal_error,
        }
    }

    /// Views that need no stereo: with the exact depth of their recording, or held out and without any.
    fn views_without_stereo(&mut self, batch: &Batch) -> Result<Vec<View>, GeometryError> {
        let exact = exact_views(batch)?;
        Ok(exact.into_iter().map(|view| self.disturb(view)).collect())
    }

    /// Views with depth by stereo, of this batch and revised ones of earlier batches.
    fn views_by_stereo(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let mut poses = BTreeMap::new();
        for keyframe in &batch.keyframes {
            keyframe.frame.intrinsics.ok_or_else(|| no_lens(keyframe))?;
            if !keyframe.frame.is_held_out {
                poses.insert(keyframe.id, truth_of(keyframe)?);
            }
        }
        Ok(self.stereo.infer(batch, &poses))
    }

    /// The view where the noise puts it, and its depth as the noise leaves it.
    fn disturb(&mut self, mut view: View) -> View {
        let id = view.keyframe_id;
        if !self.disturbed.contains_key(&id) {
            let fresh = self.disturbed_pose(id, view.submap_from_cam, &view.depth);
            self.disturbed.insert(id, fresh);
        }
        let (pose, mut rng) = self.disturbed[&id].clone();
        view.submap_from_cam = pose;
        add_noise(&mut view.depth, self.params.depth_noise as f32, &mut rng);
        view
    }

    fn disturbed_pose(&self, id: u32, truth: Rigid, depth: &DepthMap) -> (Rigid, Pcg64Mcg) {
        let params = &self.params;
        let mut rng = Pcg64Mcg::seed_from_u64(self.seed ^ (u64::from(id) << 20));
        let median = depth.median().map_or(1.0, f64::from);
        let theta = normal3(&mut rng) * params.rotation_noise_deg.to_radians();
        let share = params.translation_noise * median;
        let rho = normal3(&mut rng) * share.hypot(params.translation_noise_extent * self.extent);
        (truth * Rigid::exp(rho, theta) * self.offset(id), rng)
    }

    /// What all keyframes have in common: a constant, and what grows from one to the next.
    fn offset(&self, id: u32) -> Rigid {
        let mut rng = Pcg64Mcg::seed_from_u64(self.seed ^ DRIFT_STREAM);
        let mut direction = || normal3(&mut rng).normalize_or(DVec3::X);
        let progress = f64::from(id) / DRIFT_KEYFRAMES;
        let degrees = self.params.drift_deg * progress + self.params.offset_deg;
        let theta = direction() * degrees.to_radians();
        let share = self.params.drift_extent * progress + self.params.offset_extent;
        let rho = direction() * share * self.extent;
        Rigid::exp(rho, theta)
    }

    /// What the noise leaves poses unsure by.
    fn pose_error(&self, views: &[View]) -> PoseStd {
        let params = &self.params;
        let median = views.iter().find_map(|view| view.depth.median());
        let share = params.translation_noise * median.map_or(0.0, f64::from);
        let extents = params.translation_noise_extent.hypot(params.offset_extent);
        PoseStd {
            rotation_rad: params
                .rotation_noise_deg
                .hypot(params.offset_deg)
                .to_radians(),
            translation: share.hypot(extents * self.extent),
        }
    }
}

impl GeometryModel for GroundTruthModel {
    fn accepts_small_batches(&self) -> bool {
        self.aligner.is_none()
    }

    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let posed = self.posed(batch)?;
        let mut answer = if posed.keyframes.is_empty() {
            GeometryBatch {
                batch_id: batch.id,
                ..GeometryBatch::default()
            }
        } else if self.aligner.is_some() {
            self.infer_window(&posed)?
        } else {
            self.infer_batch(&posed)?
        };
        if let Some(pairs) = &mut self.pairs {
            answer.pair_matches = pairs.matches(&answer.views, &posed);
        }
        let n = self.left_out.len();
        if n > 0 {
            let note = format!("{n} keyframes without a ground truth pose were left out");
            answer.note = answer.note.or(Some(note));
        }
        Ok(answer)
    }

    fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        if let Some(aligner) = &mut self.aligner {
            return Ok(GeometryBatch {
                revised: aligner.finish(),
                pair_matches: aligner.take_new_matches(),
                ..GeometryBatch::default()
            });
        }
        let mut answer = self.stereo.finish();
        answer.views = answer.views.into_iter().map(|v| self.disturb(v)).collect();
        answer.pose_error = self.pose_error(&answer.views);
        Ok(answer)
    }
}

impl GroundTruthModel {
    /// The keyframes of a batch that have a pose: ground truth often begins late, or has gaps. An error where no keyframe has had any.
    fn posed(&mut self, batch: &Batch) -> Result<Batch, GeometryError> {
        let lacks = |keyframe: &&Arc<Keyframe>| keyframe.frame.truth.is_none();
        let lacking = batch.keyframes.iter().filter(lacks);
        self.left_out.extend(lacking.map(|keyframe| keyframe.id));
        let mut posed = batch.clone();
        posed.keyframes.retain(|k| k.frame.truth.is_some());
        let shared = batch.keyframes.iter().take(batch.n_shared);
        posed.n_shared = shared.filter(|k| k.frame.truth.is_some()).count();
        self.has_posed |= !posed.keyframes.is_empty();
        match batch.keyframes.first() {
            Some(first) if !self.has_posed => truth_of(first).map(|_| posed),
            _ => Ok(posed),
        }
    }

    fn infer_batch(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let ready = self.views_without_stereo(batch)?;
        if ready.len() == batch.keyframes.len() {
            return Ok(GeometryBatch {
                batch_id: batch.id,
                pose_error: self.pose_error(&ready),
                views: ready,
                ..GeometryBatch::default()
            });
        }
        let mut answer = self.views_by_stereo(batch)?;
        answer
            .views
            .retain(|view| ready.iter().all(|w| w.keyframe_id != view.keyframe_id));
        let by_stereo = answer.views.into_iter().map(|view| self.disturb(view));
        answer.views = by_stereo.chain(ready).collect();
        answer.pose_error = self.pose_error(&answer.views);
        Ok(answer)
    }
}

/// Views that need no stereo, as they are.
fn exact_views(batch: &Batch) -> Result<Vec<View>, GeometryError> {
    let mut views = Vec::new();
    for keyframe in &batch.keyframes {
        let held_out = keyframe.frame.is_held_out.then(DepthMap::none);
        let exact = keyframe.frame.sensor_depth.as_deref().cloned();
        if let Some(depth) = exact.or(held_out) {
            let view = View {
                keyframe_id: keyframe.id,
                submap: 0,
                intrinsics: keyframe.frame.intrinsics.ok_or_else(|| no_lens(keyframe))?,
                lens: None,
                submap_from_cam: truth_of(keyframe)?,
                depth,
                health: PoseQuality::default(),
            };
            views.push(view);
        }
    }
    Ok(views)
}

fn truth_of(keyframe: &Keyframe) -> Result<Rigid, GeometryError> {
    let missing = || {
        missing(
            "a ground truth pose (PoseStamped, tf or a scene's)",
            keyframe,
        )
    };
    keyframe.frame.truth.ok_or_else(missing)
}

fn no_lens(keyframe: &Keyframe) -> GeometryError {
    missing("a calibration (CameraInfo or intrinsics.json)", keyframe)
}

fn missing(needs: &'static str, keyframe: &Keyframe) -> GeometryError {
    GeometryError::Missing {
        model: "ground_truth",
        needs,
        keyframe_id: keyframe.id,
        way_out: "use --geometry sfm",
    }
}

fn add_noise(depth: &mut DepthMap, std: f32, rng: &mut Pcg64Mcg) {
    if std > 0.0 {
        for value in &mut depth.depth {
            // A depth of zero means no value and stays so; noise never makes one negative.
            *value *= (1.0 + std * normal(rng) as f32).max(0.05);
        }
    }
}
