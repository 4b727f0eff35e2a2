//! moves: dead splats to live ones, more where there are many (MCMC), as shaders. Arithmetic and order of the draws are
//! those of `mcmc`; the host reads one number back, since with nothing alive nothing may grow.

use crate::mcmc;
use crate::settings::McmcSettings;
use crate::wgpu::kernels::{MOVE_COPY, MOVE_DRAW, MOVE_SHARE, MOVE_WEIGHTS};
use crate::wgpu::memory::SplatMemory;
use crate::wgpu::types::Moves;
use splat_gpu::buffer::Buffer;
use splat_gpu::commands::{Commands, SortBuffers};
use splat_gpu::device::Gpu;
use splat_gpu::error::GpuError;

/// Buffers of one pass.
struct Tables {
    weights: Buffer,
    dead: Buffer,
    shares: Buffer,
    starts: Buffer,
    dead_before: Buffer,
    sources: Buffer,
    n: Buffer,
    scan: SortBuffers,
}

/// Fills the places of the dead, then adds splats behind the last. With nothing alive, nothing changes.
pub(crate) fn relocate_and_grow(
    gpu: &Gpu,
    memory: &mut SplatMemory,
    settings: &McmcSettings,
    n_steps: u32,
) -> Result<(), GpuError> {
    let n = memory.n;
    if n == 0 {
        return Ok(());
    }
    let max_splats = settings
        .max_splats
        .min(crate::wgpu::memory::max_splats(gpu, memory.sh_degree));
    let n_added = mcmc::grown(n, settings.growth, max_splats) - n;
    if memory.reserve(gpu, n + n_added)? {
        gpu.forget_bindings();
    }
    let tables = Tables::new(gpu, n, n_added)?;
    let moves = Moves {
        n_splats: n as u32,
        seed: settings.seed,
        weight_bits: mcmc::weight_bits(n),
        active_steps: settings.active_steps,
        n_steps,
        sh_stored: u32::from(memory.sh_degree),
        min_opacity: settings.min_opacity,
        by_image: u32::from(settings.copies == mcmc::Relocation::Image),
        keeps_age: u32::from(settings.keeps_age),
        kind: mcmc::RELOCATION,
        ..Moves::default()
    };
    tables.fill(gpu, memory, moves)?;
    if n_added > 0 {
        let growth = Moves {
            n_added: n_added as u32,
            kind: mcmc::GROWTH,
            ..moves
        };
        tables.fill(gpu, memory, growth)?;
        let total: Vec<u32> = gpu.read(&tables.starts, n..n + 1)?;
        if total != [0] {
            memory.n += n_added;
        }
    }
    // The tables are this pass's own: nothing may keep them.
    gpu.forget_bindings();
    Ok(())
}

impl Tables {
    fn new(gpu: &Gpu, n: usize, n_added: usize) -> Result<Self, GpuError> {
        let words = |label, n| gpu.storage::<u32>(label, n);
        Ok(Self {
            weights: words("weights", n)?,
            dead: words("dead", n)?,
            shares: words("shares", n)?,
            starts: words("starts", n + 1)?,
            dead_before: words("dead_before", n + 1)?,
            sources: words("sources", n.max(n_added))?,
            n: gpu.storage_of("n", &[n as u32])?,
            scan: SortBuffers::new(gpu, n as u32)?,
        })
    }

    fn fill(&self, gpu: &Gpu, memory: &SplatMemory, moves: Moves) -> Result<(), GpuError> {
        let uniform = gpu.uniform("moves", &moves);
        let mut commands = Commands::new(gpu);
        let n_groups = moves.n_splats.div_ceil(256);
        let n_places = if moves.n_added == 0 {
            n_groups
        } else {
            moves.n_added.div_ceil(256)
        };
        let weights = [
            &uniform,
            &memory.geometry,
            &memory.sh_rest,
            &self.weights,
            &self.dead,
            &self.shares,
        ];
        commands.dispatch(&MOVE_WEIGHTS, &weights, n_groups)?;
        let weighed = [&self.weights, &self.n, &self.starts];
        commands.scan(&self.scan, weighed, moves.n_splats)?;
        let counted = [&self.dead, &self.n, &self.dead_before];
        commands.scan(&self.scan, counted, moves.n_splats)?;
        let draw = [
            &uniform,
            &self.starts,
            &self.dead,
            &self.dead_before,
            &self.sources,
            &self.shares,
        ];
        commands.dispatch(&MOVE_DRAW, &draw, n_places)?;
        let share = [
            &uniform,
            &self.shares,
            &memory.geometry,
            &memory.moments,
            &memory.sh_moments,
        ];
        commands.dispatch(&MOVE_SHARE, &share, n_groups)?;
        let copy = [
            &uniform,
            &self.sources,
            &memory.geometry,
            &memory.sh_rest,
            &memory.moments,
            &memory.sh_moments,
            &memory.anchors,
        ];
        commands.dispatch(&MOVE_COPY, &copy, n_places)?;
        commands.submit();
        Ok(())
    }
}
