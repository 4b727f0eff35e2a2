//! Keyframes with poses of any origin -> verified matches between pairs of them, each pair once.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use crate::alignment::matches::Matcher;
use crate::alignment::params::AlignParams;
use crate::answer::{PairMatches, View};
use crate::error::FeaturesError;
use crate::sfm::params::SfmParams;
use splat_types::frame::Batch;
use splat_types::image::RgbImage;

/// Keyframes of earlier batches that new ones are matched with.
const RECENT: usize = 12;
/// Images that wait for a pose of their keyframe, at most.
const MAX_WAITING: usize = 64;

/// Matches keyframes with those that got their poses just before, by features of their images.
#[derive(Debug)]
pub struct PairMatcher {
    matcher: Matcher,
    limits: AlignParams,
    recent: VecDeque<View>,
    waiting: BTreeMap<u32, Arc<RgbImage>>,
}

impl PairMatcher {
    /// An error where the parameters name a network for features that is not there.
    pub fn new(sfm: &SfmParams, seed: u64) -> Result<Self, FeaturesError> {
        Ok(Self {
            matcher: Matcher::new(sfm, 0, seed)?,
            limits: AlignParams::default(),
            recent: VecDeque::new(),
            waiting: BTreeMap::new(),
        })
    }

    /// Matches that `views` add, of keyframes of this batch or of one before. Views without depth are held out to measure quality, and
    /// have none.
    pub fn matches(&mut self, views: &[View], batch: &Batch) -> Vec<PairMatches> {
        let images = batch.keyframes.iter();
        self.waiting
            .extend(images.map(|k| (k.id, Arc::clone(&k.frame.image))));
        let has_depth = |view: &&View| view.depth.median().is_some();
        let fresh: Vec<View> = views.iter().filter(has_depth).cloned().collect();
        let is_fresh = |id: u32| fresh.iter().any(|v| v.keyframe_id == id);
        self.recent.retain(|old| !is_fresh(old.keyframe_id));
        let mut all: Vec<View> = self.recent.iter().cloned().collect();
        all.extend(fresh.iter().cloned());
        self.matcher.matched(&all, &self.waiting, &self.limits);
        self.waiting.retain(|id, _| !is_fresh(*id));
        while self.waiting.len() > MAX_WAITING {
            self.waiting.pop_first();
        }
        self.recent = all.split_off(all.len().saturating_sub(RECENT)).into();
        self.matcher.take_new_matches()
    }
}
