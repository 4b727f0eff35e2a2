//! Which machine matches: the CPU, or a GPU where that is asked for or is faster. Falls back to the CPU for good.

use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::mvs::gpu::GpuMatcher;
use crate::mvs::sgm::Winners;
use crate::mvs::stereo::SweepTask;
use crate::mvs::sweep::GiveWay;
use splat_gpu::backend::Backend;
use splat_gpu::device::Wanted;
use splat_gpu::error::GpuError;
use splat_types::time::Stopwatch;

#[derive(Debug)]
pub(crate) enum Matcher {
    Cpu,
    Gpu(Box<GpuMatcher>),
    /// The first sweep says which is faster.
    Undecided,
}

impl Matcher {
    /// An error where a GPU is asked for and there is none.
    pub(crate) fn new(backend: Backend) -> Result<Self, GpuError> {
        Ok(match backend {
            Backend::Auto => Self::Undecided,
            Backend::Cpu => Self::Cpu,
            Backend::Wgpu => Self::Gpu(Box::new(GpuMatcher::open(wanted(true))?)),
        })
    }

    pub(crate) fn winners(&mut self, task: &SweepTask<'_>, give_way: GiveWay<'_>) -> Winners {
        match std::mem::replace(self, Self::Cpu) {
            Self::Cpu => task.winners_giving_way(give_way),
            Self::Undecided => {
                // Software Vulkan is slower than native code, so only hardware will do.
                let (winners, faster) = timed(task, wanted(false));
                *self = faster;
                winners
            }
            Self::Gpu(mut gpu) => match caught(&mut gpu, task) {
                Ok(winners) => {
                    *self = Self::Gpu(gpu);
                    winners
                }
                Err(error) => {
                    tracing::warn!("depth is matched on the CPU from here on: {error}");
                    give_up(gpu, &error);
                    task.winners_giving_way(give_way)
                }
            },
        }
    }
}

fn wanted(any_kind: bool) -> Wanted {
    Wanted {
        any_kind,
        subgroups: true,
        float_atomics: false,
        lanes: None,
    }
}

/// The result of whichever machine is faster, and that machine.
pub(crate) fn timed(task: &SweepTask<'_>, wanted: Wanted) -> (Winners, Matcher) {
    let mut gpu = match GpuMatcher::open(wanted) {
        Ok(gpu) => Box::new(gpu),
        Err(error) => {
            tracing::debug!("depth is matched on the CPU: {error}");
            return (task.winners_on_cpu(), Matcher::Cpu);
        }
    };
    let watch = Stopwatch::start();
    let on_cpu = task.winners_on_cpu();
    let cpu_secs = watch.secs();
    // Once outside of the measurement: the first sweep makes the buffers.
    let measured = caught(&mut gpu, task).and_then(|_| {
        let watch = Stopwatch::start();
        Ok((caught(&mut gpu, task)?, watch.secs()))
    });
    match measured {
        Err(error) => {
            tracing::warn!("depth is matched on the CPU: {error}");
            give_up(gpu, &error);
            (on_cpu, Matcher::Cpu)
        }
        Ok((on_gpu, gpu_secs)) => {
            let is_faster = gpu_secs < cpu_secs;
            tracing::info!(
                "depth is matched on the {}: {:.1} ms a view on the CPU, {:.1} ms on {}",
                if is_faster { "GPU" } else { "CPU" },
                1e3 * cpu_secs,
                1e3 * gpu_secs,
                gpu.adapter()
            );
            if is_faster {
                (on_gpu, Matcher::Gpu(gpu))
            } else {
                (on_cpu, Matcher::Cpu)
            }
        }
    }
}

fn caught(gpu: &mut GpuMatcher, task: &SweepTask<'_>) -> Result<Winners, GpuError> {
    // wgpu panics where it waits for a device that was lost. What it leaves behind is not used any more.
    catch_unwind(AssertUnwindSafe(|| gpu.winners(task))).unwrap_or_else(|_| {
        Err(GpuError::GaveUp {
            adapter: gpu.adapter().to_owned(),
            reason: "device lost".to_owned(),
        })
    })
}

/// Frees the memory where that can be done.
fn give_up(gpu: Box<GpuMatcher>, error: &GpuError) {
    if matches!(error, GpuError::Hangs { .. }) {
        // Closing the device would wait for the work that never ends.
        std::mem::forget(gpu);
    } else if catch_unwind(AssertUnwindSafe(|| drop(gpu))).is_err() {
        tracing::debug!("a lost device could not be closed");
    }
}
