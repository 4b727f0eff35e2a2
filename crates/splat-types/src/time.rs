//! Time: stamps of data, and stopwatches for reports. The only home of `Instant::now`.

use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// A point in time of the data, in nanoseconds since the epoch of its source (header stamp).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Stamp {
    pub nanos: i64,
}

impl Stamp {
    pub fn from_nanos(nanos: i64) -> Self {
        Self { nanos }
    }

    /// Seconds are rounded to the nearest nanosecond; a value that does not fit saturates.
    pub fn from_secs(secs: f64) -> Self {
        Self {
            nanos: (secs * 1e9).round() as i64,
        }
    }

    /// The wall clock, for data that carries no time of its own.
    pub fn now() -> Self {
        let since = SystemTime::now().duration_since(UNIX_EPOCH);
        Self {
            nanos: since.map_or(0, saturated_nanos),
        }
    }

    pub fn secs(self) -> f64 {
        self.nanos as f64 * 1e-9
    }

    /// `self - earlier` in seconds; exact for stamps less than 2^53 ns apart.
    pub fn secs_since(self, earlier: Self) -> f64 {
        self.nanos.saturating_sub(earlier.nanos) as f64 * 1e-9
    }
}

/// Seconds with all nine decimals, exactly: `12.000000001`.
impl std::fmt::Display for Stamp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sign = if self.nanos < 0 { "-" } else { "" };
        let nanos = self.nanos.unsigned_abs();
        write!(
            f,
            "{sign}{}.{:09}",
            nanos / 1_000_000_000,
            nanos % 1_000_000_000
        )
    }
}

fn saturated_nanos(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}

/// Nanoseconds on a clock that nobody sets, since this was first asked.
pub fn monotonic_nanos() -> i64 {
    static START: OnceLock<Stopwatch> = OnceLock::new();
    saturated_nanos(START.get_or_init(Stopwatch::start).elapsed())
}

/// Wall time since it was started.
#[derive(Debug, Clone, Copy)]
pub struct Stopwatch {
    start: Instant,
}

impl Stopwatch {
    #[expect(clippy::disallowed_methods, reason = "the one home of Instant::now")]
    pub fn start() -> Self {
        Self {
            start: Instant::now(),
        }
    }

    pub fn elapsed(&self) -> Duration {
        self.start.elapsed()
    }

    pub fn secs(&self) -> f64 {
        self.elapsed().as_secs_f64()
    }
}
