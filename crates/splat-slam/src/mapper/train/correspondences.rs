//! Where keyframes saw the model's landmarks -> matches between the views of the map, for the epipolar loss.

use std::collections::BTreeMap;

use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::store::KeyframeStore;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_engine::view::Correspondence;
use splat_geometry::answer::Observations;

/// More matches of a view report its pose no better and cost time in every step.
const MAX_MATCHES: usize = 400;

/// What keyframes saw.
#[derive(Debug, Default)]
pub(crate) struct SeenLandmarks {
    /// By landmark, the pixel in the keyframe's image.
    by_keyframe: BTreeMap<u32, BTreeMap<u32, [f32; 2]>>,
}

impl SeenLandmarks {
    /// Remembers what was seen; the newest word on a keyframe counts.
    pub(crate) fn record(&mut self, observations: &[Observations]) {
        for seen in observations {
            let landmarks = seen.landmarks.iter();
            let pixels = landmarks.map(|seen| (seen.id, seen.pixel)).collect();
            self.by_keyframe.insert(seen.keyframe_id, pixels);
        }
    }

    /// Gives every view its matches with all others.
    pub(crate) fn match_views(
        &self,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        for (id, registered) in keyframes.registered() {
            let mut matches = Vec::new();
            let Some(own) = self.by_keyframe.get(id) else {
                continue;
            };
            for (other_id, other) in keyframes.registered().iter().filter(|(o, _)| *o != id) {
                if let Some(pixels) = self.by_keyframe.get(other_id) {
                    matches.extend(shared(registered, own, other, pixels));
                }
            }
            // An even choice keeps all neighbours.
            let every = matches.len().div_ceil(MAX_MATCHES).max(1);
            let matches: Vec<Correspondence> = matches.into_iter().step_by(every).collect();
            engine.set_correspondences(registered.view_ix, &matches)?;
        }
        Ok(())
    }
}

/// Landmarks that both have seen, in the pixels of the training images.
fn shared(
    own: &RegisteredKeyframe,
    own_pixels: &BTreeMap<u32, [f32; 2]>,
    other: &RegisteredKeyframe,
    other_pixels: &BTreeMap<u32, [f32; 2]>,
) -> Vec<Correspondence> {
    let scaled = |registered: &RegisteredKeyframe, px: [f32; 2]| {
        let (from, to) = (&registered.keyframe.frame.image, &registered.image);
        let x = px[0] * to.width_px as f32 / from.width_px as f32;
        [x, px[1] * to.height_px as f32 / from.height_px as f32]
    };
    let found = own_pixels.iter().filter_map(|(landmark, px)| {
        Some(Correspondence {
            own_px: scaled(own, *px),
            other_view_ix: other.view_ix as u32,
            other_px: scaled(other, *other_pixels.get(landmark)?),
            weight: 1.0,
        })
    });
    found.collect()
}
