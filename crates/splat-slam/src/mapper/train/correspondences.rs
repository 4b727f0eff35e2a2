//! Pixels at which keyframes saw the same points -> matches between the views of the map, for the epipolar loss.

use std::collections::BTreeMap;

use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::params::EpipolarWeighting;
use crate::mapper::train::match_weights::{ERROR_SIDE_PX, adaptive_weights};
use splat_engine::epipolar::distance_px;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_engine::view::Correspondence;
use splat_geometry::answer::{GeometryBatch, PairMatches};
use splat_types::transform::Rigid;

/// More matches of a view say no more of its pose and cost time in every step.
const MAX_MATCHES: usize = 400;

/// A pixel in either image.
type PixelPair = [[f32; 2]; 2];

/// What keyframes saw of the same points.
#[derive(Debug, Default)]
pub(crate) struct KnownMatches {
    /// By keyframe and landmark, the pixel in the keyframe's image.
    landmarks: BTreeMap<u32, BTreeMap<u32, [f32; 2]>>,
    /// By keyframe and by other keyframe.
    pairs: BTreeMap<u32, BTreeMap<u32, Vec<PixelPair>>>,
}

/// A match of a keyframe with another, in pixels of the keyframes' images.
#[derive(Debug, Clone, Copy)]
struct Match {
    other_id: u32,
    own: [f32; 2],
    other: [f32; 2],
}

impl KnownMatches {
    /// Remembers what was seen; the newest word on a keyframe, and on a pair, counts.
    pub(crate) fn record(&mut self, geometry: &GeometryBatch) {
        for seen in &geometry.observations {
            let landmarks = seen.landmarks.iter();
            let pixels = landmarks.map(|seen| (seen.id, seen.pixel)).collect();
            self.landmarks.insert(seen.keyframe_id, pixels);
        }
        for found in &geometry.pair_matches {
            self.record_pair(found);
        }
    }

    fn record_pair(&mut self, found: &PairMatches) {
        let [a, b] = found.keyframe_ids;
        let turned = found.pixels.iter().map(|&[p, q]| [q, p]).collect();
        let mut keep = |from, to, pixels| self.pairs.entry(from).or_default().insert(to, pixels);
        keep(a, b, found.pixels.clone());
        keep(b, a, turned);
    }

    /// Gives every view its matches with all others, and returns their number. Held-out keyframes have none: what measures
    /// quality shapes no pose. What is known of keyframes that left the map is forgotten.
    pub(crate) fn match_views(
        &mut self,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
        weighting: EpipolarWeighting,
    ) -> Result<usize, EngineError> {
        let registered = keyframes.registered();
        self.landmarks.retain(|id, _| registered.contains_key(id));
        self.pairs.retain(|id, _| registered.contains_key(id));
        if self.landmarks.is_empty() && self.pairs.is_empty() {
            return Ok(0);
        }
        let poses = engine.poses()?;
        let mut of_views = self.of_views(registered);
        if weighting == EpipolarWeighting::Adaptive {
            weigh(&mut of_views, registered, &poses);
        }
        let mut n = 0;
        for (view_ix, matches) in &of_views {
            n += matches.len();
            engine.set_correspondences(*view_ix, matches)?;
        }
        Ok(n)
    }

    /// By index of the view, in pixels of the training images, all of weight 1.
    fn of_views(
        &self,
        registered: &BTreeMap<u32, RegisteredKeyframe>,
    ) -> BTreeMap<usize, Vec<Correspondence>> {
        let takes_part = |id: &u32| registered.get(id).filter(|r| !r.is_held_out);
        let mut seen_by: BTreeMap<u32, Vec<(u32, [f32; 2])>> = BTreeMap::new();
        for (id, pixels) in self
            .landmarks
            .iter()
            .filter(|(id, _)| takes_part(id).is_some())
        {
            for (landmark, px) in pixels {
                seen_by.entry(*landmark).or_default().push((*id, *px));
            }
        }
        let ids = registered
            .keys()
            .filter_map(|id| Some((id, takes_part(id)?)));
        ids.map(|(id, own)| {
            let mut matches = self.by_landmarks(*id, &seen_by);
            matches.extend(self.by_pairs(*id));
            matches.retain(|found| takes_part(&found.other_id).is_some());
            // Stable: the landmarks of each pair stay in order. An even choice keeps all neighbours.
            matches.sort_by_key(|found| found.other_id);
            let every = matches.len().div_ceil(MAX_MATCHES).max(1);
            let chosen = matches.iter().step_by(every);
            let scaled =
                chosen.map(|found| correspondence(own, &registered[&found.other_id], found));
            (own.view_ix, scaled.collect())
        })
        .collect()
    }

    fn by_landmarks(&self, id: u32, seen_by: &BTreeMap<u32, Vec<(u32, [f32; 2])>>) -> Vec<Match> {
        let own = self.landmarks.get(&id).into_iter().flatten();
        let with_others = own.flat_map(|(landmark, px)| {
            let others = seen_by.get(landmark).into_iter().flatten();
            let others = others.filter(move |(other, _)| *other != id);
            others.map(move |(other_id, other)| Match {
                other_id: *other_id,
                own: *px,
                other: *other,
            })
        });
        with_others.collect()
    }

    fn by_pairs(&self, id: u32) -> impl Iterator<Item = Match> {
        let others = self.pairs.get(&id).into_iter().flatten();
        others.flat_map(|(other_id, pixels)| {
            pixels.iter().map(|&[own, other]| Match {
                other_id: *other_id,
                own,
                other,
            })
        })
    }
}

fn correspondence(
    own: &RegisteredKeyframe,
    other: &RegisteredKeyframe,
    found: &Match,
) -> Correspondence {
    let scaled = |registered: &RegisteredKeyframe, px: [f32; 2]| {
        let (from, to) = (&registered.keyframe.frame.image, &registered.image);
        let x = px[0] * to.width_px as f32 / from.width_px as f32;
        [x, px[1] * to.height_px as f32 / from.height_px as f32]
    };
    Correspondence {
        own_px: scaled(own, found.own),
        other_view_ix: other.view_ix as u32,
        other_px: scaled(other, found.other),
        weight: 1.0,
    }
}

/// Gives all matches of all views their adaptive weights, at the poses as they are.
fn weigh(
    of_views: &mut BTreeMap<usize, Vec<Correspondence>>,
    registered: &BTreeMap<u32, RegisteredKeyframe>,
    poses: &[Rigid],
) {
    let cameras: BTreeMap<usize, _> = registered
        .values()
        .filter_map(|r| Some((r.view_ix, (r.intrinsics, *poses.get(r.view_ix)?))))
        .collect();
    let error = |view_ix: usize, found: &Correspondence| {
        let own = cameras.get(&view_ix)?;
        let other = cameras.get(&(found.other_view_ix as usize))?;
        let px = distance_px(own, other, found.own_px, found.other_px)?;
        let side = own.0.width_px.max(own.0.height_px);
        Some(px * ERROR_SIDE_PX / f64::from(side.max(1)))
    };
    let errors: Vec<Option<f64>> = of_views
        .iter()
        .flat_map(|(ix, matches)| matches.iter().map(|found| error(*ix, found)))
        .collect();
    let weights = adaptive_weights(&errors);
    let all = of_views.values_mut().flatten();
    all.zip(weights)
        .for_each(|(found, weight)| found.weight = weight);
}
