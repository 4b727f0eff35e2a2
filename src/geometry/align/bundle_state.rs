//! What bundle adjustment with depth moves, and where it starts: poses as given, points where the depth puts them.

use glam::DVec3;

use super::Matched;
use super::agreeing::by_depth;
use super::tracks::{Track, sight};
use crate::geometry::triangulate::triangulate;
use crate::pose::Rigid;

/// What depth each feature of each view has; `None` where the network gave none.
pub type Depths = Vec<Vec<Option<f64>>>;

#[derive(Debug, Clone)]
pub(super) struct State {
    pub(super) poses: Vec<Rigid>,
    pub(super) log_scales: Vec<f64>,
    pub(super) log_focal: f64,
    pub(super) points: Vec<DVec3>,
    pub(super) tracks: Vec<Track>,
}

impl State {
    /// Points start where the depth of their sights puts them on average: rays of poses that are a degree off hardly meet.
    pub(super) fn new(matched: &Matched, tracks: &[Track], depths: &Depths) -> Self {
        let mut state = Self {
            poses: matched.shots.iter().map(|s| s.cam_from_batch).collect(),
            log_scales: vec![0.0; matched.shots.len()],
            log_focal: 0.0,
            points: Vec::new(),
            tracks: Vec::new(),
        };
        for track in tracks {
            let point = by_depth(matched, track, depths).or_else(|| {
                let sights: Vec<_> = track.iter().map(|&at| sight(matched, at)).collect();
                triangulate(&sights)
            });
            if let Some(point) = point.filter(|p| p.is_finite()) {
                state.points.push(point);
                state.tracks.push(track.clone());
            }
        }
        state
    }
}
