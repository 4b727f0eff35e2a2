//! Where keyframes saw the model's landmarks -> matches between the views of the map, for the epipolar loss.

use std::collections::BTreeMap;

use crate::geometry::Sightings;
use crate::map::SplatMap;
use crate::map::keyframes::Placed;
use crate::splat::Match;

/// More matches of a view tell its pose no better and cost time in every step.
const MAX_MATCHES: usize = 400;

impl SplatMap {
    /// Remembers what was seen; the newest word on a keyframe counts.
    pub(super) fn note_sightings(&mut self, sightings: Vec<Sightings>) {
        if self.params.epipolar_weight <= 0.0 {
            return;
        }
        for seen in sightings {
            let pixels = seen.landmarks.into_iter().collect();
            self.keyframes.sightings.insert(seen.keyframe_id, pixels);
        }
    }

    /// Gives every view its matches with all others.
    pub(super) fn match_views(&mut self) {
        for (id, placed) in &self.keyframes.placed {
            let mut matches = Vec::new();
            let Some(own) = self.keyframes.sightings.get(id) else {
                continue;
            };
            for (other_id, other) in self.keyframes.placed.iter().filter(|(o, _)| *o != id) {
                if let Some(pixels) = self.keyframes.sightings.get(other_id) {
                    matches.extend(shared(placed, own, other, pixels));
                }
            }
            // An even choice keeps all neighbours.
            let every = matches.len().div_ceil(MAX_MATCHES).max(1);
            let matches: Vec<Match> = matches.into_iter().step_by(every).collect();
            self.engine.set_matches(placed.view_ix, &matches);
        }
    }
}

/// Landmarks that both have seen, in the pixels of the training pictures.
fn shared(
    own: &Placed,
    own_pixels: &BTreeMap<u32, [f32; 2]>,
    other: &Placed,
    other_pixels: &BTreeMap<u32, [f32; 2]>,
) -> Vec<Match> {
    let scaled = |placed: &Placed, px: [f32; 2]| {
        let (from, to) = (&placed.keyframe.frame.image, &placed.image);
        let x = px[0] * to.width_px as f32 / from.width_px as f32;
        [x, px[1] * to.height_px as f32 / from.height_px as f32]
    };
    let found = own_pixels.iter().filter_map(|(landmark, px)| {
        Some(Match {
            own_px: scaled(own, *px),
            other_view_ix: other.view_ix as u32,
            other_px: scaled(other, *other_pixels.get(landmark)?),
            weight: 1.0,
        })
    });
    found.collect()
}
