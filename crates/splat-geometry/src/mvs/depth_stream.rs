//! A stream of posed keyframes -> verified depth of each as its neighbours come in. Bounded memory.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DVec2, DVec3};

use crate::mvs::backend::Matcher;
use crate::mvs::consistency;
use crate::mvs::neighbours::{Candidate, choose_sources};
use crate::mvs::params::MvsParams;
use crate::mvs::stereo::SweepTask;
use crate::mvs::view::{MvsView, Prepared, RawDepth};
use splat_gpu::error::GpuError;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::frame::SecondImage;
use splat_types::transform::Rigid;

/// Grey images and raw depth of the newest keyframes: up to 3 MB each at 320 pixels.
#[derive(Debug)]
pub struct DepthStream {
    params: MvsParams,
    /// `None` while a sweep has it.
    matcher: Option<Matcher>,
    max_keyframes: usize,
    held: BTreeMap<u32, StoredDepth>,
    n_sweeps: u64,
}

#[derive(Debug)]
struct StoredDepth {
    prepared: Prepared,
    raw: RawDepth,
    second: Option<Second>,
    /// What the raw depth rests on.
    swept_intrinsics: Intrinsics,
    sources: Vec<Source>,
    /// Sweep number, for forgetting the oldest.
    age: u64,
}

/// The second camera of a pair, which goes wherever the first one goes.
#[derive(Debug)]
struct Second {
    prepared: Prepared,
    raw: RawDepth,
    first_from_second: Rigid,
}

/// Stands for the second camera of a pair among the sources of its first one; ids of keyframes are smaller.
const SECOND: u32 = u32::MAX;

/// A source as it was at the time of the sweep.
#[derive(Debug)]
struct Source {
    keyframe_id: u32,
    intrinsics: Intrinsics,
    source_from_cam: Rigid,
}

/// A sweep on its way to the thread that makes it: images with their poses of the moment, and the machine that matches.
#[derive(Debug)]
pub struct SweepJob {
    keyframe_id: u32,
    reference: Prepared,
    /// By keyframe; `SECOND` for the pair's own.
    sources: Vec<(u32, Prepared)>,
    range: (f64, f64),
    params: MvsParams,
    matcher: Matcher,
}

/// What a sweep found, on its way back.
#[derive(Debug)]
pub struct SweptDepth {
    keyframe_id: u32,
    raw: RawDepth,
    /// Of the second camera.
    second_raw: Option<RawDepth>,
    sources: Vec<Source>,
    matcher: Matcher,
}

impl SweepJob {
    /// Matches; takes tens to hundreds of milliseconds on a CPU.
    pub fn run(self) -> SweptDepth {
        self.run_giving_way(&|| ())
    }

    /// The same; on a CPU `give_way` is called every few milliseconds, from all its threads, and may wait.
    pub fn run_giving_way(mut self, give_way: &(dyn Fn() + Sync)) -> SweptDepth {
        let (near, far) = self.range;
        let (keyframe_id, n_sources) = (self.keyframe_id, self.sources.len());
        tracing::debug!(keyframe_id, n_sources, near, far, "sweep");
        let images: Vec<&Prepared> = self.sources.iter().map(|(_, source)| source).collect();
        let (range, params) = (self.range, &self.params);
        let mut sweep = |reference: &Prepared, sources: &[&Prepared]| match SweepTask::new(
            reference, sources, range, params,
        ) {
            Some(task) => {
                let winners = self.matcher.winners(&task, give_way);
                give_way();
                task.raw_depth(winners)
            }
            None => RawDepth::empty(reference.intrinsics),
        };
        let raw = sweep(&self.reference, &images);
        // The second camera's own depth, against the first alone, is what the pair's depth is checked by.
        let second = self.sources.iter().find(|(id, _)| *id == SECOND);
        let second_raw = second.map(|(_, second)| sweep(second, &[&self.reference]));
        let source = |(id, source): &(u32, Prepared)| Source {
            keyframe_id: *id,
            intrinsics: source.intrinsics,
            source_from_cam: source.submap_from_cam.inverse() * self.reference.submap_from_cam,
        };
        SweptDepth {
            keyframe_id,
            raw,
            second_raw,
            sources: self.sources.iter().map(source).collect(),
            matcher: self.matcher,
        }
    }
}

/// Views that a depth map is checked against.
const MAX_VERIFIERS: usize = 12;
/// Points of a depth map that stand for it when neighbours are chosen.
const MAX_LANDMARKS: usize = 200;

impl DepthStream {
    /// An error where the parameters insist on a GPU and there is none.
    pub fn new(params: MvsParams, max_keyframes: usize) -> Result<Self, GpuError> {
        Ok(Self {
            matcher: Some(Matcher::new(params.backend)?),
            params,
            max_keyframes: max_keyframes.max(1),
            held: BTreeMap::new(),
            n_sweeps: 0,
        })
    }

    /// Matches `view` against those `neighbours` that are held. Without any, the view is held all the same and can
    /// serve as a source. An id that is held already is replaced. The oldest keyframe leaves when there are too many.
    pub fn add(
        &mut self,
        keyframe_id: u32,
        view: &MvsView,
        near: f64,
        far: f64,
        neighbours: &[u32],
    ) {
        let prepared = Prepared::new(view, &self.params);
        let raw = RawDepth::empty(prepared.intrinsics);
        let swept_intrinsics = prepared.intrinsics;
        self.n_sweeps += 1;
        let held = StoredDepth {
            prepared,
            raw,
            second: None,
            swept_intrinsics,
            sources: Vec::new(),
            age: self.n_sweeps,
        };
        self.held.insert(keyframe_id, held);
        self.resweep(keyframe_id, near, far, neighbours);
        while self.held.len() > self.max_keyframes {
            let oldest = self
                .held
                .iter()
                .min_by_key(|(_, held)| held.age)
                .map(|(id, _)| *id);
            oldest.and_then(|id| self.held.remove(&id));
        }
    }

    /// Matches a held keyframe again, with the poses of this moment. Does nothing for an id that is not held.
    pub fn resweep(&mut self, keyframe_id: u32, near: f64, far: f64, neighbours: &[u32]) {
        if let Some(job) = self.sweep_job(keyframe_id, near, far, neighbours) {
            let swept = job.run();
            self.take(swept);
        }
    }

    /// The same as work for another thread; the pose of each view is that of this moment, and may be revised meanwhile. `None`:
    /// the id is not held, has no neighbours that are, or another sweep is on its way.
    pub fn sweep_job(
        &mut self,
        keyframe_id: u32,
        near: f64,
        far: f64,
        neighbours: &[u32],
    ) -> Option<SweepJob> {
        let held = self.held.get(&keyframe_id)?;
        let reference = held.prepared.clone();
        let own = held.second.as_ref();
        let own = own.map(|second| (SECOND, second.prepared.clone()));
        let usable = neighbours.iter().filter(|id| **id != keyframe_id);
        let others = usable.filter_map(|id| Some((*id, self.held.get(id)?.prepared.clone())));
        let sources: Vec<(u32, Prepared)> = own
            .into_iter()
            .chain(others)
            .take(self.params.source_views)
            .collect();
        if sources.is_empty() {
            return None;
        }
        Some(SweepJob {
            keyframe_id,
            reference,
            sources,
            range: (near, far),
            params: self.params.clone(),
            matcher: self.matcher.take()?,
        })
    }

    /// Takes over what a sweep has found; of a keyframe that is no longer held, nothing.
    pub fn take(&mut self, swept: SweptDepth) {
        self.matcher = Some(swept.matcher);
        if let Some(held) = self.held.get_mut(&swept.keyframe_id) {
            held.swept_intrinsics = swept.raw.intrinsics;
            held.raw = swept.raw;
            held.sources = swept.sources;
            if let Some((second, raw)) = held.second.as_mut().zip(swept.second_raw) {
                second.raw = raw;
            }
        }
    }

    /// Depth that the held keyframes agree on, as far as they have come. `None`: not held.
    pub fn depth_of(&self, keyframe_id: u32) -> Option<DepthMap> {
        let held = self.held.get(&keyframe_id)?;
        let raw = RawDepth {
            score: held.raw.score.clone(),
            margin: held.raw.margin.clone(),
            ..self.current_depth(held)
        };
        let verifiers = self.verifiers_of(keyframe_id, held, &raw);
        let others: Vec<(Rigid, RawDepth)> = verifiers
            .iter()
            .filter_map(|id| self.held.get(id))
            .map(|other| (other.prepared.submap_from_cam, self.current_depth(other)))
            .collect();
        let mut others: Vec<(Rigid, &RawDepth)> =
            others.iter().map(|(pose, raw)| (*pose, raw)).collect();
        // How a pair is mounted is known, unlike where another view is: its second camera confirms as much as two views.
        let second = held.second.as_ref();
        let second = second.map(|second| (second.prepared.submap_from_cam, &second.raw));
        others.extend(
            second
                .into_iter()
                .cycle()
                .take(self.params.min_views.max(1)),
        );
        Some(consistency::verify(
            (held.prepared.submap_from_cam, &raw),
            &others,
            &self.params,
        ))
    }

    /// A better camera. Depth already matched follows a change of scale; see `drift_px` for the rest.
    pub fn revise(&mut self, keyframe_id: u32, intrinsics: Intrinsics, submap_from_cam: Rigid) {
        if let Some(held) = self.held.get_mut(&keyframe_id) {
            let grey = &held.prepared.grey;
            held.prepared.intrinsics = intrinsics.resized(grey.width as u32, grey.height as u32);
            held.prepared.submap_from_cam = submap_from_cam;
            if let Some(second) = &mut held.second {
                second.prepared.submap_from_cam = submap_from_cam * second.first_from_second;
            }
        }
    }

    /// Gives a held keyframe the image of its second camera, in a submap whose unit is the metre.
    pub fn pair(&mut self, keyframe_id: u32, second: &SecondImage) {
        let Some((held, decoded)) = self.held.get_mut(&keyframe_id).zip(second.decoded()) else {
            return;
        };
        let first_from_second = second.second_from_first.inverse();
        let view = MvsView {
            image: Arc::clone(&decoded.image),
            intrinsics: decoded.intrinsics,
            submap_from_cam: held.prepared.submap_from_cam * first_from_second,
        };
        let prepared = Prepared::new(&view, &self.params);
        held.second = Some(Second {
            raw: RawDepth::empty(prepared.intrinsics),
            prepared,
            first_from_second,
        });
    }

    /// Whether a keyframe has the image of a second camera.
    pub fn is_pair(&self, keyframe_id: u32) -> bool {
        let held = self.held.get(&keyframe_id);
        held.is_some_and(|held| held.second.is_some())
    }

    /// How far the revisions since the sweep have moved its pixels in its sources, in pixels of the depth map: above
    /// about 1 the depth is out of date and `resweep` pays. `None`: not held, or nothing to compare.
    pub fn drift_px(&self, keyframe_id: u32) -> Option<f64> {
        let held = self.held.get(&keyframe_id)?;
        let scale = self.scale_since_sweep(held);
        let depth = f64::from(median(
            held.raw.depth.iter().copied().filter(|depth| *depth > 0.0),
        )?);
        let (width, height) = (
            held.prepared.grey.width as f64,
            held.prepared.grey.height as f64,
        );
        let mut worst: Option<f64> = None;
        for source in &held.sources {
            let Some(other) = self.held.get(&source.keyframe_id) else {
                continue;
            };
            let source_from_cam =
                other.prepared.submap_from_cam.inverse() * held.prepared.submap_from_cam;
            for (share_x, share_y) in [(0.5, 0.5), (0.2, 0.2), (0.8, 0.2), (0.2, 0.8), (0.8, 0.8)] {
                let pixel = DVec2::new(share_x * width, share_y * height);
                let before = held.swept_intrinsics.ray_in_cam(pixel) * depth;
                let after = held.prepared.intrinsics.ray_in_cam(pixel) * depth * scale;
                let before = source
                    .intrinsics
                    .project(source.source_from_cam.transform_point(before));
                let after = other
                    .prepared
                    .intrinsics
                    .project(source_from_cam.transform_point(after));
                let (Some(before), Some(after)) = (before, after) else {
                    continue;
                };
                worst = Some(worst.unwrap_or(0.0).max((after - before).length()));
            }
        }
        worst
    }

    /// That the last sweep had; 0 for one that was never swept or is not held.
    pub fn n_sources(&self, keyframe_id: u32) -> usize {
        self.held
            .get(&keyframe_id)
            .map_or(0, |held| held.sources.len())
    }

    #[cfg(test)]
    pub(crate) fn matcher(&self) -> Option<&Matcher> {
        self.matcher.as_ref()
    }

    pub fn holds(&self, keyframe_id: u32) -> bool {
        self.held.contains_key(&keyframe_id)
    }

    /// Raw depth in the unit and with the lens of this moment; without scores, which verifiers need not.
    fn current_depth(&self, held: &StoredDepth) -> RawDepth {
        let scale = self.scale_since_sweep(held) as f32;
        RawDepth {
            intrinsics: held.prepared.intrinsics,
            depth: held.raw.depth.iter().map(|depth| depth * scale).collect(),
            score: Vec::new(),
            margin: Vec::new(),
        }
    }

    /// Bundle adjustment and loop closure stretch the map: the distances to the sources show by how much.
    fn scale_since_sweep(&self, held: &StoredDepth) -> f64 {
        let ratios = held.sources.iter().filter_map(|source| {
            let other = &self.held.get(&source.keyframe_id)?.prepared;
            let distance = (other.submap_from_cam.translation
                - held.prepared.submap_from_cam.translation)
                .length();
            let ratio = distance / source.source_from_cam.translation.length();
            (ratio.is_finite() && ratio > 0.0).then_some(ratio)
        });
        median(ratios).unwrap_or(1.0)
    }

    fn verifiers_of(&self, keyframe_id: u32, held: &StoredDepth, raw: &RawDepth) -> Vec<u32> {
        let width = held.prepared.grey.width;
        let found: Vec<usize> = (0..raw.depth.len())
            .filter(|ix| raw.depth[*ix] > 0.0)
            .collect();
        let stride = found.len().div_ceil(MAX_LANDMARKS).max(1);
        let landmarks: Vec<DVec3> = found
            .iter()
            .step_by(stride)
            .map(|ix| {
                let pixel = DVec2::new((ix % width) as f64 + 0.5, (ix / width) as f64 + 0.5);
                let in_cam = raw.intrinsics.ray_in_cam(pixel) * f64::from(raw.depth[*ix]);
                held.prepared.submap_from_cam.transform_point(in_cam)
            })
            .collect();
        let candidates: Vec<Candidate> = self
            .held
            .iter()
            .filter(|(id, other)| **id != keyframe_id && !other.sources.is_empty())
            .map(|(id, other)| Candidate {
                keyframe_id: *id,
                intrinsics: other.prepared.intrinsics,
                submap_from_cam: other.prepared.submap_from_cam,
                n_shared: 0,
            })
            .collect();
        choose_sources(
            (&raw.intrinsics, &held.prepared.submap_from_cam),
            &landmarks,
            &candidates,
            MAX_VERIFIERS,
        )
    }
}

fn median<T: PartialOrd + Copy>(values: impl Iterator<Item = T>) -> Option<T> {
    let mut values: Vec<T> = values.collect();
    let middle = values.len() / 2;
    values.sort_by(|a, b| a.partial_cmp(b).unwrap_or(std::cmp::Ordering::Equal));
    values.get(middle).copied()
}
