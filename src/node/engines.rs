//! Parameters -> an engine to map with, at the start and after a fault.

use std::sync::Arc;

use splat_engine::cpu::engine::CpuEngine;
use splat_engine::traits::Engine;
use splat_engine::wgpu::engine::WgpuEngine;
use splat_gpu::backend::Backend;
use splat_gpu::device::Wanted;
use splat_gpu::error::GpuError;

/// Where an engine works.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Cpu,
    /// Any adapter, software Vulkan included.
    Gpu,
    /// Software Vulkan is slower than the native engine, so only hardware will do.
    HardwareGpu,
}

type Open = dyn Fn(Kind, bool) -> Result<Box<dyn Engine>, GpuError> + Send + Sync;

/// Opens engines; tests put their own in place.
#[derive(Clone)]
pub struct Engines(Arc<Open>);

impl std::fmt::Debug for Engines {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Engines")
    }
}

impl Default for Engines {
    fn default() -> Self {
        Self::of(open)
    }
}

impl Engines {
    /// `open` is given where the engine is to work, and whether the same input must give the same map.
    pub fn of(
        open: impl Fn(Kind, bool) -> Result<Box<dyn Engine>, GpuError> + Send + Sync + 'static,
    ) -> Self {
        Self(Arc::new(open))
    }

    pub fn open(&self, kind: Kind, deterministic: bool) -> Result<Box<dyn Engine>, GpuError> {
        (self.0)(kind, deterministic)
    }

    /// The best engine that the parameters allow.
    pub fn best(&self, backend: Backend, deterministic: bool) -> Result<Box<dyn Engine>, GpuError> {
        let error = match self.open(kind_of(backend), deterministic) {
            Err(error) if backend == Backend::Auto => error,
            opened => return opened,
        };
        tracing::info!("mapping on the CPU: {error}");
        self.open(Kind::Cpu, deterministic)
    }
}

/// The first that is tried.
pub fn kind_of(backend: Backend) -> Kind {
    match backend {
        Backend::Cpu => Kind::Cpu,
        Backend::Wgpu => Kind::Gpu,
        Backend::Auto => Kind::HardwareGpu,
    }
}

fn open(kind: Kind, deterministic: bool) -> Result<Box<dyn Engine>, GpuError> {
    if kind == Kind::Cpu {
        return Ok(Box::new(CpuEngine::new()));
    }
    Ok(Box::new(WgpuEngine::new(Wanted {
        any_kind: kind == Kind::Gpu,
        subgroups: true,
        float_atomics: !deterministic,
        lanes: None,
    })?))
}
