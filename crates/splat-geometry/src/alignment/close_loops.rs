//! Links to places seen before -> a submap whose way between is warped until both ends meet, or two that become one.
//!
//! First a graph of poses spreads what the links ask for over the way, then all is adjusted as a whole. A loop after
//! which the matches along the way agree less was none: everything is put back.

use std::collections::{BTreeMap, BTreeSet};

use crate::alignment::global_ba::{GlobalBa, SubmapCorrection, TRACKS_PER_VIEW, score};
use crate::alignment::kept_views::KeptView;
use crate::alignment::loops::correction;
use crate::alignment::matches::Matcher;
use crate::alignment::pair_similarity::PairSimilarity;
use crate::alignment::params::AlignParams;
use crate::alignment::tracks::{Track, covering_tracks};
use crate::answer::View;
use crate::optim::pose_graph::Graph;
use crate::optim::pose_graph::edge::Edge;
use splat_types::transform::{Rigid, Similarity};

/// Of what matches along the way agreed on before, so much must be left.
const MIN_LEFT: f64 = 0.9;

impl GlobalBa {
    /// Looks whether one of the `fresh` keyframes sees a place again, and closes the loop.
    pub(crate) fn close_loop(
        &mut self,
        fresh: &[u32],
        matcher: &mut Matcher,
        params: &AlignParams,
    ) -> Option<SubmapCorrection> {
        let links = self.loops.found(&self.views, matcher, fresh, params);
        let (first, last) = (links.first()?, links.last()?);
        let submap = |id: u32| self.views.get(&id).map(|(view, _)| view.submap);
        let sides = [submap(first.older)?, submap(last.newer)?];
        let ids: Vec<u32> = self
            .views
            .values()
            .map(|(view, _)| view)
            .filter(|view| sides.contains(&view.submap))
            .map(|view| view.keyframe_id)
            .collect();
        let before = self.views.clone();
        let way = self.tracks_along(&ids, matcher);
        let score_before = self.score_of(&ids, &way, matcher, params);
        let is_distorted = self.bend(&ids, &links, sides);
        if is_distorted {
            links
                .iter()
                .for_each(|l| matcher.remember(l.ends(), &self.views, params.max_matches));
            self.closed.extend(links.iter().map(PairSimilarity::ends));
            self.merge_counts(sides);
            self.correct(sides[0].min(sides[1]), matcher, params);
        }
        let score_after = self.score_of(&ids, &way, matcher, params);
        let is_good = is_distorted && score_after >= MIN_LEFT * score_before;
        tracing::info!(
            older = first.older,
            newer = last.newer,
            n_links = links.len(),
            ?sides,
            is_distorted,
            score_before,
            score_after,
            "{}",
            if is_good {
                "a loop is closed"
            } else {
                "a loop is refused"
            }
        );
        if !is_good {
            self.views = before;
            self.loops.refuse(&links);
            return None;
        }
        Some(self.updates(&ids, &before, sides))
    }

    /// Tracks of what was matched so far, which knows nothing of the loop.
    fn tracks_along(&self, ids: &[u32], matcher: &Matcher) -> Vec<Track> {
        let matched = matcher.matched_known(&self.views_of(ids));
        covering_tracks(&matched, TRACKS_PER_VIEW)
    }

    fn score_of(
        &self,
        ids: &[u32],
        tracks: &[Track],
        matcher: &Matcher,
        params: &AlignParams,
    ) -> f64 {
        let matched = matcher.matched_known(&self.views_of(ids));
        let depths = ids.iter().map(|id| self.views[id].1.clone()).collect();
        score(&matched, tracks, &depths, params.depth_error)
    }

    fn views_of(&self, ids: &[u32]) -> Vec<View> {
        ids.iter().map(|id| self.views[id].0.clone()).collect()
    }

    /// Moves all so that the links fit; `false` where they do not even then.
    fn bend(&mut self, ids: &[u32], links: &[PairSimilarity], sides: [u32; 2]) -> bool {
        let Some(mut graph) = self.graph(ids, links, sides) else {
            return false;
        };
        if !graph.spread() {
            return false;
        }
        let stays = sides[0].min(sides[1]);
        for (id, node) in ids.iter().zip(&graph.nodes) {
            let Some((view, depths)) = self.views.get_mut(id) else {
                continue;
            };
            view.submap_from_cam = Rigid::new(node.rotation, node.translation).renormalized();
            view.submap = stays;
            view.depth.scale(node.scale);
            depths.iter_mut().flatten().for_each(|d| *d *= node.scale);
        }
        true
    }

    /// Keyframes as they stand, tied to their neighbours and by the links.
    fn graph(&self, ids: &[u32], links: &[PairSimilarity], sides: [u32; 2]) -> Option<Graph> {
        let ix_of: BTreeMap<u32, usize> =
            ids.iter().enumerate().map(|(ix, id)| (*id, ix)).collect();
        let views: Vec<&View> = ids.iter().map(|id| &self.views[id].0).collect();
        let poses: Vec<Similarity> = views.iter().map(|v| v.submap_from_cam.into()).collect();
        let mut edges = Vec::new();
        for side in BTreeSet::from(sides) {
            let own: Vec<usize> = (0..ids.len())
                .filter(|&ix| views[ix].submap == side)
                .collect();
            edges.extend(Edge::along(&own, &poses, |ix| depth(views[ix])));
        }
        let closed = self.closed.iter().filter_map(|(older, newer)| {
            let (first, second) = (*ix_of.get(older)?, *ix_of.get(newer)?);
            Some(Edge::as_is(&poses, (first, second), depth(views[second])))
        });
        edges.extend(closed);
        for link in links {
            let (first, second) = (*ix_of.get(&link.older)?, *ix_of.get(&link.newer)?);
            edges.push(Edge::link(
                link.older_from_newer,
                (first, second),
                depth(views[second]),
            ));
        }
        let mut nodes = poses;
        if sides[0] != sides[1] {
            let moved = correction(&self.views, links.first()?)?;
            for (node, view) in nodes.iter_mut().zip(&views) {
                if view.submap == sides[1] {
                    *node = moved * *node;
                }
            }
        }
        let n_held = self.n_held(sides[0], ids.len()).max(1);
        Some(Graph {
            nodes,
            is_held: (0..ids.len()).map(|ix| ix < n_held).collect(),
            edges,
            moves_scale: true,
        })
    }

    /// What both sides counted is one submap's.
    fn merge_counts(&mut self, sides: [u32; 2]) {
        let (stays, gone) = (sides[0].min(sides[1]), sides[0].max(sides[1]));
        if stays == gone {
            return;
        }
        let added = self.n_added.remove(&gone).unwrap_or(0);
        *self.n_added.entry(stays).or_default() += added;
        self.n_corrected.remove(&gone);
    }

    /// Every keyframe of the submap as it stands, beside what was reported before.
    fn updates(&self, ids: &[u32], before: &KeptView, sides: [u32; 2]) -> SubmapCorrection {
        let revision = |id: &u32| {
            let ((view, depths), (_, old)) = (&self.views[id], &before[id]);
            let pairs = depths.iter().flatten().zip(old.iter().flatten());
            let grid = view.depth.depth.iter().zip(&before[id].0.depth.depth);
            let grid = grid.filter(|(new, old)| **new > 0.0 && **old > 0.0);
            let ratio = pairs.map(|(new, old)| new / old).next();
            let of_grid = grid
                .map(|(new, old)| f64::from(*new) / f64::from(*old))
                .next();
            crate::alignment::global_ba::revision(view, ratio.or(of_grid).unwrap_or(1.0))
        };
        SubmapCorrection {
            revised: ids.iter().map(revision).collect(),
            merged: (sides[0] != sides[1])
                .then(|| (sides[0].max(sides[1]), sides[0].min(sides[1]))),
            is_loop: true,
        }
    }
}

fn depth(view: &View) -> f64 {
    view.depth.median().map_or(1.0, f64::from)
}
