//! What bundle adjustment with depth moves, and where it starts: poses as given, points where the depth puts them.

use glam::DVec3;

use crate::alignment::depths::{Depths, by_depth};
use crate::alignment::matched::Matched;
use crate::alignment::tracks::{Track, observation};
use crate::two_view::triangulate::triangulate;
use splat_types::transform::Rigid;

#[derive(Debug, Clone)]
pub(crate) struct State {
    pub(crate) poses: Vec<Rigid>,
    pub(crate) log_scales: Vec<f64>,
    pub(crate) log_focal: f64,
    pub(crate) points: Vec<DVec3>,
    pub(crate) tracks: Vec<Track>,
}

impl State {
    /// Points start where the depth of their observations puts them on average: rays of poses that are a degree off hardly meet.
    pub(crate) fn new(matched: &Matched, tracks: &[Track], depths: &Depths) -> Self {
        let mut state = Self {
            poses: matched.views.iter().map(|s| s.cam_from_submap).collect(),
            log_scales: vec![0.0; matched.views.len()],
            log_focal: 0.0,
            points: Vec::new(),
            tracks: Vec::new(),
        };
        for track in tracks {
            let point = by_depth(matched, track, depths).or_else(|| {
                let observations: Vec<_> =
                    track.iter().map(|&at| observation(matched, at)).collect();
                triangulate(&observations)
            });
            if let Some(point) = point.filter(|p| p.is_finite()) {
                state.points.push(point);
                state.tracks.push(track.clone());
            }
        }
        state
    }
}
