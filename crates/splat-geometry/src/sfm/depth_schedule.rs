//! Live: of which keyframe depth is worked out next.
//!
//! Depth is matched best against keyframes on both sides, and is only known where others have the same. The newest keyframe has
//! neighbours on one side. Where keyframes come fast, its depth waits for those that follow; where they come slowly, it is worked
//! out at once, and again when they have come.

use std::collections::BTreeMap;

use splat_types::time::Stopwatch;

/// So many later keyframes make it worth while to match one, or to match it again.
const N_LATER: u64 = 3;
/// Seconds that a keyframe waits for later ones.
const MAX_WAIT_SECS: f64 = 0.3;

/// The keyframes whose depth may still get better.
#[derive(Debug)]
pub(crate) struct DepthSchedule {
    keyframes: BTreeMap<u32, Waiting>,
    max_keyframes: usize,
    n_reported: u64,
}

#[derive(Debug)]
struct Waiting {
    /// How many were reported before it.
    number: u64,
    since: Stopwatch,
    /// How many later ones there were when it was matched last.
    n_later_when_matched: Option<u64>,
    /// Its depth was compared with that of the later ones.
    is_verified: bool,
}

impl Waiting {
    /// It was matched with enough keyframes after it.
    fn has_later_sources(&self) -> bool {
        self.n_later_when_matched.is_some_and(|n| n >= N_LATER)
    }
}

/// What is to be done for a keyframe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Due {
    /// It is to be matched.
    Match(u32),
    /// Keyframes beside it have depth that they had not when it was matched: theirs and its own are to be compared again.
    Verify(u32),
}

impl DepthSchedule {
    /// For the newest `max_keyframes`.
    pub(crate) fn new(max_keyframes: usize) -> Self {
        Self {
            keyframes: BTreeMap::new(),
            max_keyframes,
            n_reported: 0,
        }
    }

    /// The pose of a keyframe has been reported; of one that was reported before nothing changes.
    pub(crate) fn note_reported(&mut self, keyframe_id: u32) {
        let newest = self.keyframes.last_key_value().map(|(id, _)| *id);
        let is_full = self.keyframes.len() >= self.max_keyframes;
        let is_old = is_full && newest.is_some_and(|newest| newest >= keyframe_id);
        if is_old || self.keyframes.contains_key(&keyframe_id) {
            return;
        }
        let waiting = Waiting {
            number: self.n_reported,
            since: Stopwatch::start(),
            n_later_when_matched: None,
            is_verified: false,
        };
        self.n_reported += 1;
        self.keyframes.insert(keyframe_id, waiting);
        while self.keyframes.len() > self.max_keyframes {
            self.keyframes.pop_first();
        }
    }

    /// A keyframe is being matched, or cannot be.
    pub(crate) fn note_matched(&mut self, keyframe_id: u32) {
        let n_reported = self.n_reported;
        if let Some(waiting) = self.keyframes.get_mut(&keyframe_id) {
            waiting.n_later_when_matched = Some(n_reported - 1 - waiting.number);
        }
    }

    pub(crate) fn note_verified(&mut self, keyframe_id: u32) {
        if let Some(waiting) = self.keyframes.get_mut(&keyframe_id) {
            waiting.is_verified = true;
        }
    }

    /// Keyframes that were never matched.
    pub(crate) fn unmatched(&self) -> impl Iterator<Item = u32> + '_ {
        let unmatched = |(_, waiting): &(&u32, &Waiting)| waiting.n_later_when_matched.is_none();
        self.keyframes.iter().filter(unmatched).map(|(id, _)| *id)
    }

    /// The newest first: what is seen now is to be shown.
    pub(crate) fn next(&self) -> Option<Due> {
        let newest_first = || self.keyframes.iter().rev();
        let n_later = |waiting: &Waiting| self.n_reported - 1 - waiting.number;
        let is_first = |waiting: &Waiting| {
            waiting.n_later_when_matched.is_none()
                && (n_later(waiting) >= N_LATER || waiting.since.secs() > MAX_WAIT_SECS)
        };
        if let Some((id, _)) = newest_first().find(|(_, waiting)| is_first(waiting)) {
            return Some(Due::Match(*id));
        }
        let is_early = |waiting: &Waiting| {
            waiting.n_later_when_matched.is_some()
                && !waiting.has_later_sources()
                && n_later(waiting) >= N_LATER
        };
        if let Some((id, _)) = newest_first().find(|(_, waiting)| is_early(waiting)) {
            return Some(Due::Match(*id));
        }
        let verifiable = self.keyframes.iter().find(|(_, waiting)| {
            !waiting.is_verified
                && waiting.has_later_sources()
                && self.are_matched_after(waiting.number)
        });
        verifiable.map(|(id, _)| Due::Verify(*id))
    }

    /// Whether the keyframes just after that one have been matched, with those after them.
    fn are_matched_after(&self, number: u64) -> bool {
        let mut n_matched = 0;
        for waiting in self.keyframes.values() {
            if waiting.number > number && waiting.number <= number + N_LATER {
                n_matched += u64::from(waiting.has_later_sources());
            }
        }
        n_matched == N_LATER
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is due until nothing is, each done at once.
    fn all_due(schedule: &mut DepthSchedule) -> Vec<Due> {
        let next = || {
            let due = schedule.next()?;
            match due {
                Due::Match(id) => schedule.note_matched(id),
                Due::Verify(id) => schedule.note_verified(id),
            }
            Some(due)
        };
        std::iter::from_fn(next).take(100).collect()
    }

    #[test]
    fn fast_keyframes_are_matched_once_with_those_after_them_the_newest_first() {
        let mut schedule = DepthSchedule::new(8);
        (0..4).for_each(|id| schedule.note_reported(id));
        assert_eq!(all_due(&mut schedule), [Due::Match(0)]);
        assert_eq!(schedule.unmatched().collect::<Vec<u32>>(), [1, 2, 3]);
        (4..7).for_each(|id| schedule.note_reported(id));
        let matched = [Due::Match(3), Due::Match(2), Due::Match(1)];
        assert_eq!(all_due(&mut schedule)[..3], matched);
        assert_eq!(schedule.next(), None, "compared once");
    }

    #[test]
    fn depth_is_compared_once_more_when_later_keyframes_have_theirs() {
        let mut schedule = DepthSchedule::new(16);
        (0..4).for_each(|id| schedule.note_reported(id));
        assert_eq!(all_due(&mut schedule), [Due::Match(0)]);
        (4..7).for_each(|id| schedule.note_reported(id));
        assert!(all_due(&mut schedule).ends_with(&[Due::Verify(0)]));
        schedule.note_reported(3);
        assert_eq!(schedule.next(), None, "reported again");
    }

    #[test]
    fn a_slow_keyframe_is_matched_soon_and_again_when_later_ones_have_come() {
        let mut schedule = DepthSchedule::new(8);
        schedule.note_reported(0);
        std::thread::sleep(std::time::Duration::from_secs_f64(1.1 * MAX_WAIT_SECS));
        assert_eq!(all_due(&mut schedule), [Due::Match(0)]);
        (1..4).for_each(|id| schedule.note_reported(id));
        assert_eq!(all_due(&mut schedule), [Due::Match(0)]);
    }

    #[test]
    fn only_the_newest_keyframes_wait() {
        let mut schedule = DepthSchedule::new(4);
        (0..100).for_each(|id| schedule.note_reported(id));
        assert_eq!(schedule.unmatched().count(), 4);
        schedule.note_reported(7);
        assert_eq!(schedule.unmatched().min(), Some(96));
    }
}
