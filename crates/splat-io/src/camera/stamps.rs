//! The camera's clock -> the wall clock that stamps are in. Time never runs back.

use splat_types::time::Stamp;

/// Readings of which the quickest is taken: the others were interrupted.
pub const N_READINGS: usize = 9;
/// A reading that took longer says nothing about a step of the wall clock.
const MAX_READING_NANOS: i64 = 1_000_000;
/// The wall clock was set when it moved by so much against the camera's.
const STEP_NANOS: i64 = 50_000_000;
/// An image that claims to be older than this carries a stamp of another clock.
const MAX_AGE_NANOS: i64 = 10_000_000_000;

/// The camera's clock before and after the wall clock was read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockReading {
    pub before_nanos: i64,
    pub wall: Stamp,
    pub after_nanos: i64,
}

impl ClockReading {
    /// Wall clock less camera's clock.
    fn offset_nanos(&self) -> i64 {
        let middle = self.before_nanos + self.took_nanos() / 2;
        self.wall.nanos.saturating_sub(middle)
    }

    fn took_nanos(&self) -> i64 {
        self.after_nanos.saturating_sub(self.before_nanos)
    }
}

#[derive(Debug, Clone, Copy)]
pub struct StampMap {
    offset_nanos: i64,
    has_warned: bool,
}

impl StampMap {
    /// By the quickest of some readings.
    pub fn of(readings: impl IntoIterator<Item = ClockReading>) -> Self {
        let quickest = readings.into_iter().min_by_key(ClockReading::took_nanos);
        Self {
            offset_nanos: quickest.map_or(0, |reading| reading.offset_nanos()),
            has_warned: false,
        }
    }

    /// When an image was taken; when it came, where the driver does not say or cannot be believed. Drivers that
    /// stamp the end of an image's transfer beforehand put it into the future.
    pub fn stamp(&mut self, taken_nanos: Option<i64>, now: &ClockReading) -> Stamp {
        self.follow(now);
        let arrived = now.after_nanos;
        let is_sane = |taken: &i64| arrived.saturating_sub(*taken) <= MAX_AGE_NANOS;
        let taken = taken_nanos.filter(is_sane).unwrap_or(arrived).min(arrived);
        Stamp::from_nanos(taken.saturating_add(self.offset_nanos))
    }

    /// A wall clock that was set forward is followed. Set back it is not: frames would be out of order until it has
    /// caught up.
    fn follow(&mut self, now: &ClockReading) {
        if now.took_nanos() > MAX_READING_NANOS {
            return;
        }
        let step = now.offset_nanos().saturating_sub(self.offset_nanos);
        if step > STEP_NANOS {
            let secs = step as f64 * 1e-9;
            tracing::warn!("the wall clock was set forward by {secs:.3} s; stamps follow");
            self.offset_nanos = now.offset_nanos();
        } else if step < -STEP_NANOS && !self.has_warned {
            let secs = -step as f64 * 1e-9;
            tracing::warn!("the wall clock was set back by {secs:.3} s; stamps go on as before");
            self.has_warned = true;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR: i64 = 3_600_000_000_000;

    fn reading(before: i64, wall: i64, after: i64) -> ClockReading {
        ClockReading {
            before_nanos: before,
            wall: Stamp::from_nanos(wall),
            after_nanos: after,
        }
    }

    #[test]
    fn the_quickest_reading_sets_the_offset() {
        let map = StampMap::of([
            reading(0, 1_000_900, 1_000_000),
            reading(2_000_000, 3_000_050, 2_000_100),
            reading(3_000_000, 4_500_000, 3_400_000),
        ]);
        assert_eq!(map.offset_nanos, 1_000_000);
    }

    #[test]
    fn stamps_in_the_future_and_of_other_clocks_become_the_time_of_arrival() {
        let now = reading(HOUR, 5 * HOUR, HOUR);
        let mut map = StampMap::of([now]);
        let mut stamp = |taken| map.stamp(taken, &now).nanos;
        assert_eq!(stamp(Some(HOUR - 7)), 5 * HOUR - 7);
        assert_eq!(stamp(Some(HOUR + 34_000_000)), 5 * HOUR);
        assert_eq!(stamp(Some(i64::MAX)), 5 * HOUR);
        assert_eq!(stamp(Some(0)), 5 * HOUR);
        assert_eq!(stamp(Some(i64::MIN)), 5 * HOUR);
        assert_eq!(stamp(None), 5 * HOUR);
    }

    #[test]
    fn a_wall_clock_set_forward_is_followed_and_one_set_back_is_not() {
        let mut map = StampMap::of([reading(0, HOUR, 0)]);
        let forward = reading(10, 3 * HOUR, 10);
        assert_eq!(map.stamp(Some(10), &forward).nanos, 3 * HOUR);
        let back = reading(20, HOUR, 20);
        assert_eq!(map.stamp(Some(20), &back).nanos, 3 * HOUR + 10);
        let slow = reading(30, 9 * HOUR, 30 + 2 * MAX_READING_NANOS);
        assert_eq!(map.stamp(Some(30), &slow).nanos, 3 * HOUR + 20);
    }
}
