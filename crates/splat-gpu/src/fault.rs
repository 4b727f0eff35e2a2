//! What goes wrong behind calls that answer nothing (no memory, work refused, device lost) -> an error to ask for.

use std::sync::{Arc, OnceLock};

use crate::error::GpuError;

/// The first fault of a device. No number read after it means anything: work that was refused leaves zeros.
#[derive(Debug)]
pub(crate) struct Fault {
    first: Arc<OnceLock<String>>,
}

impl Fault {
    pub(crate) fn watching(device: &wgpu::Device) -> Self {
        let first = Arc::new(OnceLock::new());
        let refused = Arc::clone(&first);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            tracing::error!("the GPU refuses: {error}");
            refused.get_or_init(|| error.to_string());
        }));
        let lost = Arc::clone(&first);
        device.set_device_lost_callback(move |reason, message| {
            lost.get_or_init(|| format!("device lost ({reason:?}) {message}"));
        });
        Self { first }
    }

    pub(crate) fn note(&self, reason: &str) {
        self.first.get_or_init(|| reason.to_owned());
    }

    pub(crate) fn check(&self, adapter: &str) -> Result<(), GpuError> {
        match self.first.get() {
            None => Ok(()),
            Some(reason) => Err(GpuError::GaveUp {
                adapter: adapter.to_owned(),
                reason: reason.clone(),
            }),
        }
    }
}
