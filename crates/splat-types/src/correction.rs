//! How the map moved as a whole: what clients that hold an older state of it need to carry theirs over.

use crate::transform::Similarity;

/// Why the map moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reason {
    /// A loop was closed, or all poses were adjusted together.
    Loop,
    /// Another submap joined.
    Merge,
    /// The map was thrown away, or a larger submap took its place: nothing is carried over.
    Reset,
    /// A saved map took its place: nothing is carried over.
    Loaded,
    /// Splat ids began anew; nothing moved.
    Renumbered,
}

/// The old map and the new one differ by more than optimisation moves them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapCorrection {
    /// Of snapshots that show it.
    pub epoch: u32,
    /// Revision of the first snapshot that shows it.
    pub revision: u32,
    /// Best fit over the registered keyframes; single ones may have moved otherwise.
    pub new_world_from_old_world: Similarity,
    /// How far the newest keyframe moved, units of the new world frame.
    pub translation: f64,
    /// How far the newest keyframe turned, radians.
    pub rotation_rad: f64,
    pub reason: Reason,
}

impl MapCorrection {
    /// Nothing moves, or nothing is carried over, as the reason says.
    pub fn identity(reason: Reason) -> Self {
        Self {
            epoch: 0,
            revision: 0,
            new_world_from_old_world: Similarity::IDENTITY,
            translation: 0.0,
            rotation_rad: 0.0,
            reason,
        }
    }

    /// Another map takes the place of the present one.
    pub fn restart(is_loaded: bool) -> Self {
        Self::identity(if is_loaded {
            Reason::Loaded
        } else {
            Reason::Reset
        })
    }

    /// This one and the one before it as one. Translation and rotation add up: an upper bound.
    #[must_use]
    pub fn after(self, before: &Self) -> Self {
        if self.is_restart() {
            return self;
        }
        if before.is_restart() {
            return Self {
                epoch: self.epoch,
                revision: self.revision,
                ..*before
            };
        }
        let reason = match (before.reason, self.reason) {
            (Reason::Merge, _) | (_, Reason::Merge) => Reason::Merge,
            (Reason::Loop, _) | (_, Reason::Loop) => Reason::Loop,
            (_, reason) => reason,
        };
        let scale = self.new_world_from_old_world.scale;
        Self {
            new_world_from_old_world: self.new_world_from_old_world
                * before.new_world_from_old_world,
            translation: self.translation + scale * before.translation,
            rotation_rad: self.rotation_rad + before.rotation_rad,
            reason,
            ..self
        }
    }

    /// Whether nothing of the old map is carried over.
    pub fn is_restart(&self) -> bool {
        matches!(self.reason, Reason::Reset | Reason::Loaded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn loop_of(scale: f64, translation: f64) -> MapCorrection {
        MapCorrection {
            epoch: 3,
            revision: 7,
            new_world_from_old_world: Similarity {
                scale,
                ..Similarity::IDENTITY
            },
            translation,
            rotation_rad: 0.1,
            ..MapCorrection::identity(Reason::Loop)
        }
    }

    #[test]
    fn lengths_of_two_corrections_add_up_in_the_unit_of_the_newer_map() {
        let both = loop_of(2.0, 1.0).after(&loop_of(3.0, 0.5));
        assert!((both.new_world_from_old_world.scale - 6.0).abs() < 1e-12);
        assert!((both.translation - 2.0).abs() < 1e-12);
        assert!((both.rotation_rad - 0.2).abs() < 1e-12);
    }

    #[test]
    fn across_a_restart_nothing_is_carried_over() {
        let reset = MapCorrection::identity(Reason::Reset);
        let found = loop_of(2.0, 1.0).after(&reset);
        assert_eq!(found.new_world_from_old_world, Similarity::IDENTITY);
        assert_eq!((found.reason, found.epoch), (Reason::Reset, 3));
        assert_eq!(reset.after(&loop_of(2.0, 1.0)), reset);
    }

    #[test]
    fn a_merge_before_or_after_a_loop_is_a_merge() {
        let merge = MapCorrection::identity(Reason::Merge);
        assert_eq!(merge.after(&loop_of(1.0, 0.0)).reason, Reason::Merge);
        assert_eq!(loop_of(1.0, 0.0).after(&merge).reason, Reason::Merge);
    }
}
