//! What the model learnt of the way behind -> word that old splats and poses have moved as a whole.

use crate::map::SplatMap;
use crate::pose::Similarity;

/// Why the map moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reason {
    /// A place was seen again, or all was adjusted together.
    Loop,
    /// Another component joined.
    Merge,
}

/// The old map and the new one differ by more than optimisation moves them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correction {
    /// Of snapshots that show it.
    pub epoch: u32,
    /// Revision of the first snapshot that shows it.
    pub revision: u32,
    /// At the newest keyframe, which is where the camera is: others may have moved otherwise.
    pub new_map_from_old_map: Similarity,
    /// The farthest that a keyframe moved, map units, and the most that one turned, radians.
    pub shift: f64,
    pub turn: f64,
    pub reason: Reason,
}

impl SplatMap {
    /// The correction since this was last asked; several are told as one.
    pub fn take_correction(&mut self) -> Option<Correction> {
        self.correction.take()
    }

    pub(super) fn note_correction(&mut self, mut correction: Correction) {
        if let Some(before) = self.correction {
            correction.new_map_from_old_map =
                correction.new_map_from_old_map * before.new_map_from_old_map;
            correction.shift += before.shift;
            correction.turn += before.turn;
            if before.reason == Reason::Merge {
                correction.reason = Reason::Merge;
            }
        }
        self.correction = Some(correction);
    }
}
