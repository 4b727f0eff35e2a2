//! Storage on the GPU: bytes with a label, counted against the device's total.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Bytes held, and the most that ever were.
#[derive(Debug, Default)]
pub struct Meter {
    held: AtomicU64,
    peak: AtomicU64,
}

/// A buffer of a device; freed when dropped and no submitted work needs it.
#[derive(Debug)]
pub struct Buffer {
    pub(crate) raw: wgpu::Buffer,
    /// Different from every other buffer of the process.
    pub(crate) id: u64,
    meter: Arc<Meter>,
}

impl Buffer {
    pub(crate) fn new(raw: wgpu::Buffer, meter: &Arc<Meter>) -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let held = meter.held.fetch_add(raw.size(), Ordering::Relaxed) + raw.size();
        meter.peak.fetch_max(held, Ordering::Relaxed);
        Self {
            raw,
            id: NEXT.fetch_add(1, Ordering::Relaxed),
            meter: Arc::clone(meter),
        }
    }

    pub fn n_bytes(&self) -> u64 {
        self.raw.size()
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        self.meter
            .held
            .fetch_sub(self.raw.size(), Ordering::Relaxed);
    }
}

impl Meter {
    /// Bytes that are held.
    pub fn held_bytes(&self) -> u64 {
        self.held.load(Ordering::Relaxed)
    }

    /// Most bytes that were held at one time.
    pub fn peak_bytes(&self) -> u64 {
        self.peak.load(Ordering::Relaxed)
    }
}
