//! Warnings that would come again and again -> the log, at most one in a while.

use std::fmt::Display;

use splat_types::time::Stopwatch;

/// Seconds between warnings of one kind.
const LOG_SECS: f64 = 10.0;

/// Of one kind of warning.
#[derive(Debug, Default)]
pub(crate) struct RateLimitedLog {
    since: Option<Stopwatch>,
}

impl RateLimitedLog {
    pub(crate) fn warn(&mut self, text: impl Display) {
        if self.since.is_none_or(|watch| watch.secs() > LOG_SECS) {
            tracing::warn!("{text}");
            self.since = Some(Stopwatch::start());
        }
    }
}
