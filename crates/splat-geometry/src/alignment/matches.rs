//! Views with rough poses and their images -> verified matches between those that may see the same surface.
//!
//! Features and matches are remembered by keyframe, so that shared keyframes cost nothing twice.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::alignment::kept_views::KeptView;
use crate::alignment::matched::{Matched, Pair, WindowView, depth_at};
use crate::alignment::params::AlignParams;
use crate::answer::{PairMatches, View};
use crate::error::FeaturesError;
use crate::features::descriptor::{Features, working_image, working_size};
use crate::features::extractor::FeatureExtractor;
use crate::loop_closure::MIN_GAP;
use crate::matching::{PreparedDescriptors, matches};
use crate::sfm::params::SfmParams;
use crate::two_view::epipolar::motion;
use splat_types::camera::Intrinsics;
use splat_types::image::RgbImage;

/// Matches that a pair needs; fewer are as likely chance.
const MIN_PAIR: usize = 15;
/// Pairs of one view: those turned least against each other.
const MAX_PAIRS: usize = 12;
/// Share of a view's surface inside another image from which they are a pair however far they are turned.
const MIN_SHARED: f64 = 0.3;
/// Depths of a view that stand for its surface, along each side.
const GRID: usize = 12;
/// Pairs of one view among all keyframes: those that see most of the same surface.
const MAX_COVISIBLE: usize = 8;
/// Keyframes whose features are remembered, at least.
const MIN_HELD: usize = 64;
/// Where one view puts a feature and where the other does, by rough poses and depth, is apart by at most this share of the
/// depth; of neighbours in time, since poses drift.
const NEAR_SHARE: f64 = 0.3;
/// Longer side of the image that `sfm.max_error_px` is meant for.
const ERROR_SIDE_PX: f64 = 640.0;
/// The focal length that verification rests on is the network's, so it is laxer than with a calibrated camera.
const LAXITY: f64 = 1.5;

/// Matches of one pair that are reported; an even choice of more.
const MAX_REPORTED: usize = 64;

/// Matches of features, by number.
type Numbers = Vec<(u32, u32)>;

/// Finds and remembers features of keyframes and the matches between them.
#[derive(Debug)]
pub struct Matcher {
    finder: FeatureExtractor,
    max_features: usize,
    max_side: u32,
    max_error_px: f64,
    max_held: usize,
    seed: u64,
    held: BTreeMap<u32, StoredFeatures>,
    /// By keyframe ids in rising order; empty where two do not match.
    pairs: BTreeMap<(u32, u32), Numbers>,
    /// Pairs that match and were not reported yet.
    unreported: BTreeSet<(u32, u32)>,
}

#[derive(Debug)]
struct StoredFeatures {
    features: Features,
    comparable: PreparedDescriptors,
    signature: PreparedDescriptors,
    size: (u32, u32),
    /// Pixels of the keyframe's image to one of the working image, along either axis.
    image_px: [f64; 2],
}

impl StoredFeatures {
    /// Where a feature lies in the keyframe's image.
    fn in_image(&self, feature: u32) -> [f32; 2] {
        let px = self.features.pixels[feature as usize];
        [
            (px.x * self.image_px[0]) as f32,
            (px.y * self.image_px[1]) as f32,
        ]
    }
}

impl Matcher {
    /// An error where the parameters name a network for features that is not there.
    pub fn new(sfm: &SfmParams, max_held: usize, seed: u64) -> Result<Self, FeaturesError> {
        Ok(Self {
            finder: FeatureExtractor::new(&sfm.features())?,
            max_features: sfm.max_features,
            max_side: sfm.max_side,
            max_error_px: sfm.max_error_px,
            max_held: max_held.max(MIN_HELD),
            seed,
            held: BTreeMap::new(),
            pairs: BTreeMap::new(),
            unreported: BTreeSet::new(),
        })
    }

    /// Features of the views and the matches between them; a view whose keyframe has no image in `images` and is
    /// not remembered has none.
    pub fn matched(
        &mut self,
        views: &[View],
        images: &BTreeMap<u32, Arc<RgbImage>>,
        params: &AlignParams,
    ) -> Matched {
        self.look(views, images);
        self.matched_pairs(
            views,
            &candidates(views, params.max_pair_deg),
            params.max_matches,
        )
    }

    /// The same of many views that were looked at before: what was matched among them then, and pairs that see the
    /// same surface.
    pub fn matched_anew(&mut self, views: &[View], params: &AlignParams) -> Matched {
        let ix_of: BTreeMap<u32, usize> = views
            .iter()
            .enumerate()
            .map(|(ix, v)| (v.keyframe_id, ix))
            .collect();
        let mut chosen = covisible(views);
        if !params.loops {
            let id = |ix: usize| views[ix].keyframe_id;
            chosen.retain(|&(a, b)| id(a).abs_diff(id(b)) <= MIN_GAP);
        }
        chosen.extend(self.pairs.keys().filter_map(|(a, b)| {
            let (a, b) = (*ix_of.get(a)?, *ix_of.get(b)?);
            Some((a.min(b), a.max(b)))
        }));
        chosen.sort_unstable();
        chosen.dedup();
        self.matched_pairs(views, &chosen, params.max_matches)
    }

    /// The same without looking for new pairs.
    pub(crate) fn matched_known(&self, views: &[View]) -> Matched {
        let ids = views.iter().enumerate();
        let ix_of: BTreeMap<u32, usize> = ids.map(|(ix, v)| (v.keyframe_id, ix)).collect();
        let pair = |(ends, features): (&(u32, u32), &Numbers)| {
            let (first, second) = (*ix_of.get(&ends.0)?, *ix_of.get(&ends.1)?);
            (first < second && !features.is_empty()).then(|| Pair {
                first,
                second,
                features: features.clone(),
            })
        };
        Matched {
            pairs: self.pairs.iter().filter_map(pair).collect(),
            views: views.iter().map(|view| self.view(view)).collect(),
        }
    }

    /// Keeps what two views that see the same place have in common.
    pub(crate) fn remember(&mut self, (older, newer): (u32, u32), kept: &KeptView, max: usize) {
        if let (Some(a), Some(b)) = (kept.get(&older), kept.get(&newer)) {
            let found = self.verified([&a.0, &b.0], max);
            self.keep_pair((older, newer), found);
        }
    }

    fn keep_pair(&mut self, ids: (u32, u32), found: Numbers) {
        if !found.is_empty() {
            self.unreported.insert(ids);
        }
        self.pairs.insert(ids, found);
    }

    /// Matches of pairs that were not taken before, at most 64 of each.
    pub fn take_new_matches(&mut self) -> Vec<PairMatches> {
        let fresh = std::mem::take(&mut self.unreported);
        let of_pair = |ids: (u32, u32)| {
            let (first, second) = (self.held.get(&ids.0)?, self.held.get(&ids.1)?);
            let numbers = self.pairs.get(&ids)?;
            let every = numbers.len().div_ceil(MAX_REPORTED).max(1);
            let pixels = |&(i, j): &(u32, u32)| [first.in_image(i), second.in_image(j)];
            Some(PairMatches {
                keyframe_ids: [ids.0, ids.1],
                pixels: numbers.iter().step_by(every).map(pixels).collect(),
            })
        };
        fresh.into_iter().filter_map(of_pair).collect()
    }

    /// How many of the coarsest features of two keyframes match.
    pub(crate) fn votes(&self, a: u32, b: u32) -> usize {
        let signature = |id: &u32| self.held.get(id).map(|held| &held.signature);
        let both = signature(&a).zip(signature(&b));
        both.map_or(0, |(a, b)| matches(a, b).len())
    }

    fn matched_pairs(
        &mut self,
        views: &[View],
        candidates: &[(usize, usize)],
        max_matches: usize,
    ) -> Matched {
        let id = |ix: usize| views[ix].keyframe_id;
        let fresh: Vec<(usize, usize)> = candidates
            .iter()
            .copied()
            .filter(|&(a, b)| !self.pairs.contains_key(&key(id(a), id(b))))
            .collect();
        let found: Vec<((u32, u32), Numbers)> = fresh
            .par_iter()
            .map(|&(a, b)| {
                let (a, b) = if id(a) < id(b) { (a, b) } else { (b, a) };
                let both = [&views[a], &views[b]];
                let found = if id(a).abs_diff(id(b)) <= MIN_GAP {
                    self.near(both, max_matches)
                } else {
                    self.verified(both, max_matches)
                };
                ((id(a), id(b)), found)
            })
            .collect();
        for (ids, found) in found {
            self.keep_pair(ids, found);
        }
        let pair = |&(first, second): &(usize, usize)| {
            let found = self.pairs.get(&key(id(first), id(second)))?;
            let is_flipped = id(first) > id(second);
            let turned = |&(i, j): &(u32, u32)| if is_flipped { (j, i) } else { (i, j) };
            (!found.is_empty()).then(|| Pair {
                first,
                second,
                features: found.iter().map(turned).collect(),
            })
        };
        Matched {
            pairs: candidates.iter().filter_map(pair).collect(),
            views: views.iter().map(|view| self.view(view)).collect(),
        }
    }

    fn look(&mut self, views: &[View], images: &BTreeMap<u32, Arc<RgbImage>>) {
        let fresh: Vec<(u32, &Arc<RgbImage>)> = views
            .iter()
            .filter(|view| !self.held.contains_key(&view.keyframe_id))
            .filter_map(|view| Some((view.keyframe_id, images.get(&view.keyframe_id)?)))
            .collect();
        let look = |(id, image): &(u32, &Arc<RgbImage>)| {
            let rgb_image = working_image(image, self.max_side);
            let features = self.finder.features(&rgb_image, self.max_features);
            let held = StoredFeatures {
                comparable: PreparedDescriptors::new(&features.descriptors),
                signature: PreparedDescriptors::new(&features.signature()),
                features,
                size: (rgb_image.width as u32, rgb_image.height as u32),
                image_px: [
                    image.width_px as f64 / rgb_image.width as f64,
                    image.height_px as f64 / rgb_image.height as f64,
                ],
            };
            (*id, held)
        };
        let found: Vec<(u32, StoredFeatures)> = fresh.par_iter().map(look).collect();
        self.held.extend(found);
        while self.held.len() > self.max_held.max(views.len()) {
            let oldest = self.held.keys().copied().find(|id| {
                let is_needed = views.iter().any(|view| view.keyframe_id == *id);
                !is_needed
            });
            let Some(oldest) = oldest else { break };
            self.held.remove(&oldest);
            self.pairs.retain(|(a, b), _| *a != oldest && *b != oldest);
            self.unreported
                .retain(|(a, b)| *a != oldest && *b != oldest);
        }
    }

    /// Of the working image.
    fn lens(&self, view: &View) -> Intrinsics {
        let i = &view.intrinsics;
        let held = self.held.get(&view.keyframe_id);
        let size = held.map_or_else(
            || working_size(i.width_px, i.height_px, self.max_side),
            |held| held.size,
        );
        i.resized(size.0, size.1)
    }

    pub(crate) fn view(&self, view: &View) -> WindowView {
        let held = self.held.get(&view.keyframe_id);
        WindowView {
            cam_from_submap: view.submap_from_cam.inverse(),
            lens: self.lens(view),
            is_held: false,
            pixels: held.map_or_else(Vec::new, |held| held.features.pixels.clone()),
        }
    }

    /// The view's depth at each of its features.
    pub(crate) fn depths(&self, view: &View) -> Vec<Option<f64>> {
        let aligned_view = self.view(view);
        let at = |pixel: &DVec2| depth_at(&view.depth, &aligned_view.lens, *pixel);
        aligned_view.pixels.iter().map(at).collect()
    }

    /// Matches of two views, the one with the lower id first, that agree with one rigid scene.
    pub(crate) fn verified(&self, both: [&View; 2], max_matches: usize) -> Numbers {
        self.find_inliers(both, max_matches, &|_, _| true)
    }

    /// The same of views whose rough poses count: where surfaces look alike, a match may be of another one.
    fn near(&self, [a, b]: [&View; 2], max_matches: usize) -> Numbers {
        let lenses = [self.lens(a), self.lens(b)];
        let b_from_a = b.submap_from_cam.inverse() * a.submap_from_cam;
        self.find_inliers([a, b], max_matches, &|at_a, at_b| {
            let Some(depth) = depth_at(&a.depth, &lenses[0], at_a) else {
                return true;
            };
            let by_a = b_from_a.transform_point(lenses[0].ray_in_cam(at_a) * depth);
            let z = depth_at(&b.depth, &lenses[1], at_b).unwrap_or(by_a.z);
            let by_b = lenses[1].ray_in_cam(at_b) * z;
            by_a.distance(by_b) <= NEAR_SHARE * depth.max(z)
        })
    }

    fn find_inliers(
        &self,
        [a, b]: [&View; 2],
        max_matches: usize,
        may_match: &dyn Fn(DVec2, DVec2) -> bool,
    ) -> Numbers {
        let (Some(first), Some(second)) =
            (self.held.get(&a.keyframe_id), self.held.get(&b.keyframe_id))
        else {
            return Vec::new();
        };
        let mut raw = matches(&first.comparable, &second.comparable);
        raw.retain(|&(i, j)| {
            may_match(
                first.features.pixels[i as usize],
                second.features.pixels[j as usize],
            )
        });
        raw.truncate(max_matches);
        if raw.len() < MIN_PAIR {
            return Vec::new();
        }
        let pixels = |&(i, j): &(u32, u32)| -> (DVec2, DVec2) {
            (
                first.features.pixels[i as usize],
                second.features.pixels[j as usize],
            )
        };
        let pairs: Vec<_> = raw.iter().map(pixels).collect();
        let lenses = [self.lens(a), self.lens(b)];
        let longest = f64::from(first.size.0.max(first.size.1));
        let limit = LAXITY * self.max_error_px * longest / ERROR_SIDE_PX;
        let seed = self.seed ^ (u64::from(a.keyframe_id) << 32 | u64::from(b.keyframe_id));
        let Some(found) = motion(&pairs, [&lenses[0], &lenses[1]], limit, seed) else {
            return Vec::new();
        };
        let inliers: Numbers = found.inliers.iter().map(|&i| raw[i]).collect();
        if inliers.len() < MIN_PAIR {
            return Vec::new();
        }
        inliers
    }
}

fn key(a: u32, b: u32) -> (u32, u32) {
    (a.min(b), a.max(b))
}

/// Pairs (first < second) turned by less than `max_pair_deg`, or that look at the same surface: for each view the
/// ones turned least, so that the number grows with the views and not with their square.
pub fn candidates(views: &[View], max_pair_deg: f64) -> Vec<(usize, usize)> {
    let n = views.len();
    let mut chosen = Vec::new();
    let angle = |i: usize, j: usize| views[i].submap_from_cam.angle_to(&views[j].submap_from_cam);
    for i in 0..n {
        let mut near: Vec<(f64, usize)> = (0..n)
            .filter(|&j| j != i && views[j].submap == views[i].submap)
            .map(|j| (angle(i, j), j))
            .filter(|&(angle, j)| {
                angle < max_pair_deg.to_radians()
                    || shared_surface(&views[i], &views[j]) > MIN_SHARED
            })
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        near.truncate(MAX_PAIRS);
        chosen.extend(near.into_iter().map(|(_, j)| (i.min(j), i.max(j))));
    }
    chosen.sort_unstable();
    chosen.dedup();
    chosen
}

/// Pairs (first < second) of views that see most of the same surface, wherever they are turned.
fn covisible(views: &[View]) -> Vec<(usize, usize)> {
    let of_view = |i: usize| {
        let mut near: Vec<(f64, usize)> = (0..views.len())
            .filter(|&j| j != i)
            .map(|j| (shared_surface(&views[i], &views[j]), j))
            .filter(|(share, _)| *share > MIN_SHARED)
            .collect();
        near.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        near.truncate(MAX_COVISIBLE);
        near.into_iter().map(move |(_, j)| (i.min(j), i.max(j)))
    };
    (0..views.len())
        .into_par_iter()
        .flat_map_iter(of_view)
        .collect()
}

/// Share of the surface of `a` that lies inside the image of `b`.
fn shared_surface(a: &View, b: &View) -> f64 {
    let (width, height) = (a.depth.width_px as usize, a.depth.height_px as usize);
    let lens = a.intrinsics.resized(a.depth.width_px, a.depth.height_px);
    let b_from_a = b.submap_from_cam.inverse() * a.submap_from_cam;
    let (mut inside, mut all) = (0.0, 0.0);
    for cell in 0..GRID * GRID {
        let x = (cell % GRID * 2 + 1) * width / (2 * GRID);
        let y = (cell / GRID * 2 + 1) * height / (2 * GRID);
        let Some((depth, _)) = a.depth.verified(y * width + x) else {
            continue;
        };
        let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        let point: DVec3 = lens.ray_in_cam(pixel) * f64::from(depth);
        all += 1.0;
        let landed = b.intrinsics.project(b_from_a.transform_point(point));
        let (w, h) = (
            f64::from(b.intrinsics.width_px),
            f64::from(b.intrinsics.height_px),
        );
        let is_inside = |p: DVec2| p.x >= 0.0 && p.y >= 0.0 && p.x < w && p.y < h;
        if landed.is_some_and(is_inside) {
            inside += 1.0;
        }
    }
    if all > 0.0 { inside / all } else { 0.0 }
}
