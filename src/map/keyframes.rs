//! Keyframes of the map: where each stands, in the model's frame and in the engine.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::camera::{Intrinsics, Lens};
use crate::frame::{DepthMap, Keyframe, RgbImage};
use crate::geometry::{Health, View};
use crate::map::resting::Home;
use crate::pose::Rigid;
use crate::source::rectify::Rectifier;

/// A keyframe with a place in the map.
#[derive(Debug, Clone)]
pub struct Placed {
    pub keyframe: Arc<Keyframe>,
    /// Index in the engine.
    pub view_ix: usize,
    /// Last pose that the geometry model gave, in its own frame.
    pub model_from_cam: Rigid,
    /// The picture that is trained on, and its camera.
    pub image: Arc<RgbImage>,
    pub intrinsics: Intrinsics,
    /// Of the keyframe's own picture, where that had to be straightened.
    pub lens: Option<Lens>,
    /// In map units, and its median.
    pub depth: Arc<DepthMap>,
    pub median_depth: Option<f32>,
    /// What the map made of the model's depth, and how often it was asked.
    pub depth_factor: f64,
    pub n_depth_looks: u8,
    /// Logarithms of metres per unit of the model's depth, by depth pictures and by the floor; `None` before it was
    /// looked at.
    pub ratios: Option<[Option<f64>; 2]>,
    pub health: Health,
    /// Kept out of optimisation, measures quality.
    pub is_held_out: bool,
    pub home: Home,
}

/// Everything that has come and may still be used, by keyframe id.
#[derive(Debug, Default)]
pub struct Keyframes {
    pub placed: BTreeMap<u32, Placed>,
    /// Without a pose so far; the oldest go when there are too many.
    pub waiting: BTreeMap<u32, Arc<Keyframe>>,
    /// Placed by the model, but in a component that has no known relation to the map.
    pub foreign: BTreeMap<u32, View>,
    /// By landmark, the pixel in the keyframe's picture; kept only where the map has a use for matches.
    pub sightings: BTreeMap<u32, BTreeMap<u32, [f32; 2]>>,
}

impl Keyframes {
    /// Remembers keyframes until they are placed; beyond `max_waiting` the oldest are given up.
    pub fn remember(&mut self, keyframes: &[Arc<Keyframe>], max_waiting: usize) {
        for keyframe in keyframes {
            if !self.placed.contains_key(&keyframe.id) {
                self.waiting.insert(keyframe.id, Arc::clone(keyframe));
            }
        }
        while self.waiting.len() > max_waiting {
            if let Some((id, _)) = self.waiting.pop_first() {
                self.foreign.remove(&id);
            }
        }
    }

    /// Number of keyframes per component other than the map's own.
    pub fn foreign_counts(&self) -> BTreeMap<u32, usize> {
        let mut counts = BTreeMap::new();
        for view in self.foreign.values() {
            *counts.entry(view.component).or_insert(0) += 1;
        }
        counts
    }

    /// (pose in the map, pose in the model's frame) of all that are optimised, else of all, but for the ids `without`;
    /// `map_poses` by view index.
    pub fn pose_pairs(&self, map_poses: &[Rigid], without: &BTreeSet<u32>) -> Vec<(Rigid, Rigid)> {
        let no_choice = self.placed.values().all(|p| p.is_held_out);
        self.placed
            .iter()
            .filter(|(id, p)| (no_choice || !p.is_held_out) && !without.contains(id))
            .map(|(_, p)| (map_poses[p.view_ix].inverse(), p.model_from_cam))
            .collect()
    }
}

/// The keyframe's picture at most `max_side` pixels long, as the view's pinhole sees it, and that pinhole.
pub fn picture(keyframe: &Keyframe, view: &View, max_side: u32) -> (Arc<RgbImage>, Intrinsics) {
    let full = &keyframe.frame.image;
    let image = if full.width_px.max(full.height_px) <= max_side {
        Arc::clone(full)
    } else {
        Arc::new(full.shrunk(max_side))
    };
    let size = (image.width_px, image.height_px);
    let pinhole = view.intrinsics.resized(size.0, size.1);
    let lens = view.lens.map(|lens| lens.resized(size.0, size.1));
    let rectifier = lens.and_then(|lens| Rectifier::onto(&pinhole, &lens));
    let straight = match rectifier {
        Some(rectifier) => Arc::new(rectifier.rectify(Arc::unwrap_or_clone(image))),
        None => image,
    };
    (straight, pinhole)
}

/// The same depth in another unit.
pub fn rescaled(depth: &DepthMap, factor: f64) -> DepthMap {
    let mut depth = depth.clone();
    depth.scale(factor);
    depth
}
