//! What makes a place count as seen again, for loops of the estimator and of the alignment alike.
//!
//! Places that look alike are no rarer than places seen again, so a link is believed only if (1) others say the same,
//! (2) no other place fits about as well, and (3) it asks for no larger a drift than the way between may have gathered: a
//! corridor of equal doors asks for as much as was walked.

use glam::DVec3;

use crate::optim::pose_graph;
use splat_types::time::Stamp;
use splat_types::transform::Similarity;

/// Keyframes in between from which on a place is seen again; nearer ones are matched anyway.
pub const MIN_GAP: u32 = 20;
/// Links that must agree.
pub const MIN_LINKS: usize = 2;
/// Another place that has this share of a link's matches makes it doubtful.
pub const AMBIGUOUS: f64 = 0.6;
/// What links that say the same may differ in: share of the depth, radians, logarithm of scale.
const SAME: [f64; 3] = [0.2, 0.07, 0.15];
/// Of a way's drift: turn in radians, logarithm of scale.
const MAX_TURN: f64 = 0.35;
const MAX_SCALE: f64 = 0.3;

/// Where no pose is known between two parts of the way, the camera went at most so many times as fast as it mostly did.
const MAX_HASTE: f64 = 2.0;
/// The speed that most steps stay below.
const MOST: f64 = 0.9;

/// Whether two corrections move a place, of which the depth is known, to the same place.
pub fn is_same(place: DVec3, depth: f64, a: &Similarity, b: &Similarity) -> bool {
    let apart = pose_graph::apart(place, depth, a, b);
    apart.iter().zip(SAME).all(|(off, limit)| *off <= limit)
}

/// A camera centre, and when the camera was there.
pub type Stand = (Stamp, DVec3);

/// Whether a camera may have gone from the end of one part of the way to the begin of the next one, as both lie with a
/// link between them. `way` is what was walked between the ends of the link, which may have drifted.
pub fn may_have_walked(
    (before, behind): (&[Stand], &[Stand]),
    way_length: f64,
    max_drift: f64,
) -> bool {
    let (Some(from), Some(to)) = (before.last(), behind.first()) else {
        return true;
    };
    let speed = speed_of(before).max(speed_of(behind));
    let reach = MAX_HASTE * speed * to.0.secs_since(from.0).max(0.0);
    from.1.distance(to.1) <= reach + max_drift * way_length
}

/// Of a way through these places.
pub fn length(places: impl Iterator<Item = DVec3> + Clone) -> f64 {
    let steps = places.clone().zip(places.skip(1));
    steps.map(|(from, to)| from.distance(to)).sum()
}

/// What most steps stay below; 0 of a single stand.
fn speed_of(way: &[Stand]) -> f64 {
    let speed = |two: &[Stand]| {
        let secs = two[1].0.secs_since(two[0].0);
        (secs > 0.0).then(|| two[0].1.distance(two[1].1) / secs)
    };
    let mut speeds: Vec<f64> = way.windows(2).filter_map(speed).collect();
    speeds.sort_by(f64::total_cmp);
    let most = (MOST * speeds.len() as f64) as usize;
    speeds.get(most).or(speeds.last()).copied().unwrap_or(0.0)
}

/// Whether the way, camera centres in order, may have gathered a drift that the correction takes away at its end.
/// `max_drift`: share of the way's length.
pub fn may_have_drifted(way: &[DVec3], correction: &Similarity, max_drift: f64) -> bool {
    let Some(end) = way.last() else {
        return false;
    };
    let length = length(way.iter().copied());
    let shift = correction.transform_point(*end).distance(*end);
    shift <= max_drift * length
        && correction.angle() <= MAX_TURN
        && correction.scale.ln().abs() <= MAX_SCALE
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Half a metre in every half second, along x.
    fn way(range: std::ops::Range<usize>, shift: f64) -> Vec<Stand> {
        let stand = |i: usize| {
            let t = 0.5 * i as f64;
            (Stamp::from_secs(t), DVec3::X * (t + shift))
        };
        range.map(stand).collect()
    }

    #[test]
    fn a_part_of_the_way_that_begins_out_of_reach_was_joined_wrongly() {
        let before = way(0..20, 0.0);
        let fits = |behind: &[Stand], length| may_have_walked((&before, behind), length, 0.05);
        assert!(fits(&way(20..40, 0.0), 0.0));
        assert!(fits(&way(20..40, 0.4), 0.0), "a little faster");
        assert!(!fits(&way(20..40, 1.8), 0.0), "a bay ahead");
        assert!(!fits(&way(20..40, -1.8), 0.0), "a bay behind");
        assert!(fits(&way(20..40, 1.8), 30.0), "after a long way");
        assert!(fits(&way(24..40, 1.8), 0.0), "after some time unseen");
        assert!(fits(&[], 0.0));
    }
}
