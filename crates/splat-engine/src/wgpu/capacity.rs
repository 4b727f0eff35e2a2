//! How many splats there may be: what the adapter's buffers hold, and what a budget of bytes allows.

use crate::wgpu::engine::WgpuEngine;
use crate::wgpu::memory::{self, SplatMemory};
use splat_gpu::error::GpuError;
use splat_types::splats::splats::Splats;

/// Buffers have up to half as much room as they need, and are there twice while rows move.
const MAX_SPARE: u64 = 3;

/// Splats that fit beside everything else that is held.
pub(crate) fn splats_within(engine: &WgpuEngine, max_bytes: u64) -> usize {
    let of_splats = engine.memory.n_bytes();
    let of_rest = engine.gpu.meter().held_bytes().saturating_sub(of_splats);
    let free = max_bytes.saturating_sub(of_rest);
    let per_splat = memory::bytes_per_splat(engine.memory.sh_degree) as u64;
    (free / (MAX_SPARE * per_splat)) as usize
}

impl WgpuEngine {
    pub(crate) fn try_append(&mut self, splats: &Splats) -> Result<(), GpuError> {
        splats.assert_consistent();
        self.confirm()?;
        if self.memory.n == 0 && self.memory.sh_degree != splats.sh_degree {
            self.memory = SplatMemory::new(&self.gpu, splats.sh_degree)?;
            self.gpu.forget_bindings();
        }
        assert_eq!(
            self.memory.sh_degree, splats.sh_degree,
            "all splats of an engine have one SH degree"
        );
        let limit = memory::max_splats(&self.gpu, splats.sh_degree);
        let room = limit.saturating_sub(self.memory.n);
        if splats.len() > room {
            if !self.has_warned_of_room {
                tracing::warn!(
                    "adapter {} has room for {limit} splats of SH degree {}: more are left out; said once",
                    self.gpu.name(),
                    splats.sh_degree
                );
                self.has_warned_of_room = true;
            }
            let mut fitting = splats.clone();
            fitting.truncate(room);
            return self.append_fitting(&fitting);
        }
        self.append_fitting(splats)
    }

    fn append_fitting(&mut self, splats: &Splats) -> Result<(), GpuError> {
        if splats.is_empty() {
            return Ok(());
        }
        if self
            .memory
            .reserve(&self.gpu, self.memory.n + splats.len())?
        {
            self.gpu.forget_bindings();
        }
        self.memory.append(&self.gpu, splats, self.n_trained);
        Ok(())
    }
}
