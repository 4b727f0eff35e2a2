//! What an inertial measurement unit (IMU) measured between images.

use std::collections::VecDeque;
use std::sync::Arc;

use glam::DVec3;

use crate::time::Stamp;

/// Samples that lie further apart leave a gap, which nothing is integrated across.
pub const MAX_GAP_NANOS: i64 = 50_000_000;

/// One measurement, in the axes of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuSample {
    pub stamp: Stamp,
    /// rad/s.
    pub angular_velocity: DVec3,
    /// m/s^2, the specific force: at rest it points up with 9.81.
    pub acceleration: DVec3,
}

/// Where an IMU sits and what its noise is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuModel {
    /// In the camera's axes, metres.
    pub imu_in_cam: DVec3,
    /// rad/s per root of a hertz.
    pub gyro_noise: f64,
    /// m/s^2 per root of a hertz.
    pub accelerometer_noise: f64,
}

/// At the camera, with the noise of MEMS sensors on robots and telephones.
impl Default for ImuModel {
    fn default() -> Self {
        Self {
            imu_in_cam: DVec3::ZERO,
            gyro_noise: 1e-3,
            accelerometer_noise: 1e-2,
        }
    }
}

/// What came between the frame before and this one.
#[derive(Debug, Clone, PartialEq)]
pub struct ImuSpan {
    /// Oldest first, each stamp once. The first is the last one before the frame before, and the last one the first that is not
    /// before this frame, where there are such.
    pub samples: Arc<[ImuSample]>,
    pub model: ImuModel,
}

impl ImuSample {
    /// What it would have measured at a time between two samples, as if both changed evenly.
    fn between(&self, later: &Self, stamp: Stamp) -> Self {
        let whole = later.stamp.secs_since(self.stamp).max(1e-12);
        let share = (stamp.secs_since(self.stamp) / whole).clamp(0.0, 1.0);
        Self {
            stamp,
            angular_velocity: self.angular_velocity.lerp(later.angular_velocity, share),
            acceleration: self.acceleration.lerp(later.acceleration, share),
        }
    }
}

/// Samples of frames that follow one another, as one stream. Old ones are forgotten.
#[derive(Debug, Clone)]
pub struct ImuLog {
    samples: VecDeque<ImuSample>,
    model: ImuModel,
    kept_nanos: i64,
}

impl ImuLog {
    /// Keeps the newest `kept_secs`.
    pub fn new(kept_secs: f64) -> Self {
        Self {
            samples: VecDeque::new(),
            model: ImuModel::default(),
            kept_nanos: (1e9 * kept_secs) as i64,
        }
    }

    /// Spans come in order of time. One that begins before the last has ended adds what is newer; where time has begun anew,
    /// everything before is forgotten.
    pub fn push(&mut self, span: &ImuSpan) {
        self.model = span.model;
        let first = span.samples.first().map(|s| s.stamp);
        let is_before = |first: Stamp| {
            self.samples
                .front()
                .is_some_and(|oldest| first < oldest.stamp)
        };
        if first.is_some_and(is_before) {
            self.samples.clear();
        }
        for sample in span.samples.iter() {
            if self.newest().is_none_or(|newest| newest < sample.stamp) {
                self.samples.push_back(*sample);
            }
        }
        let Some(newest) = self.newest() else {
            return;
        };
        let oldest = newest.nanos.saturating_sub(self.kept_nanos);
        while self.samples.front().is_some_and(|s| s.stamp.nanos < oldest) {
            self.samples.pop_front();
        }
    }

    pub fn newest(&self) -> Option<Stamp> {
        self.samples.back().map(|s| s.stamp)
    }

    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    pub fn model(&self) -> &ImuModel {
        &self.model
    }

    /// The samples from one time to another, with interpolated ones at both ends. `None` where they don't reach, or leave a gap.
    pub fn between(&self, from: Stamp, to: Stamp) -> Option<Vec<ImuSample>> {
        if from >= to {
            return None;
        }
        let after = |stamp: Stamp| self.samples.partition_point(|s| s.stamp <= stamp);
        let (first, last) = (after(from), self.samples.partition_point(|s| s.stamp < to));
        let at = |next: usize, stamp: Stamp| {
            let (before, next) = (
                self.samples.get(next.checked_sub(1)?)?,
                self.samples.get(next)?,
            );
            Some(before.between(next, stamp))
        };
        // A sample at the very end is both its neighbours.
        let start = at(first, from).or_else(|| self.exact(from))?;
        let end = self.exact(to).or_else(|| at(last, to))?;
        let mut samples = vec![start];
        samples.extend(self.samples.range(first..last));
        samples.push(end);
        let is_whole = |two: &[ImuSample]| {
            two[1].stamp.nanos.saturating_sub(two[0].stamp.nanos) <= MAX_GAP_NANOS
        };
        let bounds_are_near = {
            let (before, behind) = (
                self.samples.get(first.saturating_sub(1))?,
                self.samples.get(last)?,
            );
            let near = |a: Stamp, b: Stamp| b.nanos.saturating_sub(a.nanos).abs() <= MAX_GAP_NANOS;
            near(before.stamp, from) && near(to, behind.stamp)
        };
        (bounds_are_near && samples.windows(2).all(is_whole)).then_some(samples)
    }

    fn exact(&self, stamp: Stamp) -> Option<ImuSample> {
        let ix = self
            .samples
            .binary_search_by_key(&stamp, |s| s.stamp)
            .ok()?;
        self.samples.get(ix).copied()
    }

    /// Everything that is kept.
    pub fn span(&self) -> ImuSpan {
        ImuSpan {
            samples: self.samples.iter().copied().collect(),
            model: self.model,
        }
    }

    /// Forgets what lies before the last sample that is not after `stamp`.
    pub fn forget_before(&mut self, stamp: Stamp) {
        let n = self.samples.partition_point(|s| s.stamp <= stamp);
        self.samples.drain(..n.saturating_sub(1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(millis: i64) -> ImuSample {
        ImuSample {
            stamp: Stamp::from_nanos(millis * 1_000_000),
            angular_velocity: DVec3::X * millis as f64,
            acceleration: DVec3::Z * millis as f64,
        }
    }

    fn log(millis: &[i64]) -> ImuLog {
        let mut log = ImuLog::new(10.0);
        log.push(&ImuSpan {
            samples: millis.iter().map(|m| sample(*m)).collect(),
            model: ImuModel::default(),
        });
        log
    }

    fn at(millis: i64) -> Stamp {
        Stamp::from_nanos(millis * 1_000_000)
    }

    #[test]
    fn ends_between_samples_are_interpolated_and_ends_on_samples_are_those() {
        let log = log(&[0, 10, 20, 30]);
        let part = log.between(at(4), at(26)).unwrap();
        assert_eq!(part, [4, 10, 20, 26].map(sample).to_vec());
        let part = log.between(at(0), at(30)).unwrap();
        assert_eq!(part, [0, 10, 20, 30].map(sample).to_vec());
        let part = log.between(at(10), at(20)).unwrap();
        assert_eq!(part, [10, 20].map(sample).to_vec());
        assert_eq!(
            log.between(at(12), at(18)).unwrap(),
            [12, 18].map(sample).to_vec()
        );
    }

    #[test]
    fn gaps_and_ends_that_are_not_reached_give_nothing() {
        let log = log(&[0, 10, 20, 100, 110]);
        assert_eq!(log.between(at(-5), at(15)), None);
        assert_eq!(log.between(at(5), at(115)), None);
        assert_eq!(log.between(at(5), at(105)), None);
        assert_eq!(log.between(at(30), at(40)), None);
        assert_eq!(log.between(at(15), at(15)), None);
        assert!(log.between(at(100), at(110)).is_some());
    }

    #[test]
    fn repeated_samples_count_once_and_time_may_begin_anew() {
        let mut log = log(&[0, 10, 20]);
        log.push(&ImuSpan {
            samples: [10, 20, 30].map(sample).to_vec().into(),
            model: ImuModel::default(),
        });
        assert_eq!(log.span().samples.len(), 4);
        log.forget_before(at(25));
        assert_eq!(log.span().samples.to_vec(), [20, 30].map(sample).to_vec());
        log.push(&ImuSpan {
            samples: [5, 10].map(sample).to_vec().into(),
            model: ImuModel::default(),
        });
        assert_eq!(log.newest(), Some(at(10)));
    }
}
