//! How long each kernel takes on the device: timestamps before and after every dispatch.

use std::collections::BTreeMap;

use crate::buffer::Buffer;

/// Dispatches of one submission that are timed; those behind them run untimed.
pub(crate) const MAX_TIMED: usize = 512;

/// What a kernel has taken since the profile was started.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct KernelTime {
    /// Dispatches.
    pub n_runs: u64,
    /// On the device, all of them together.
    pub secs: f64,
}

/// Timestamps of one submission at a time, and their sums by kernel.
#[derive(Debug)]
pub(crate) struct Profile {
    pub(crate) queries: wgpu::QuerySet,
    /// Ticks, two a dispatch.
    pub(crate) ticks: Buffer,
    pub(crate) secs_per_tick: f64,
    pub(crate) times: BTreeMap<&'static str, KernelTime>,
}

impl Profile {
    /// `ticks`: begin and end of each of `kernels`.
    pub(crate) fn add(&mut self, kernels: &[&'static str], ticks: &[u64]) {
        for (kernel, ticks) in kernels.iter().zip(ticks.as_chunks::<2>().0) {
            let time = self.times.entry(kernel).or_default();
            time.n_runs += 1;
            // Some drivers let a clock that wraps around or was reset show.
            time.secs += ticks[1].saturating_sub(ticks[0]) as f64 * self.secs_per_tick;
        }
    }
}
