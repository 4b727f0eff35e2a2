//! Records dispatches and copies; one submission runs them in order.

use crate::buffer::Buffer;
use crate::device::Gpu;
use crate::error::GpuError;
use crate::kernel::{
    Kernel, SCAN_APPLY, SCAN_BLOCKS, SCAN_SUMS, SORT_COUNT, SORT_ROWS, SORT_SCATTER,
    SORT_SCATTER_SUBGROUPS,
};
use crate::profile::MAX_TIMED;
use crate::types::{SCAN_BLOCK, SORT_BLOCK, SortPass};

/// Groups that one dimension of a dispatch may have.
const MAX_GROUPS: u32 = 65_535;

/// Work that has not been submitted.
#[derive(Debug)]
pub struct Commands<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    pass: Option<wgpu::ComputePass<'static>>,
    /// Kernels between two timestamps each.
    timed: Vec<&'static str>,
}

/// Buffers of prefix sums and sorts, for up to `max_keys` numbers.
#[derive(Debug)]
pub struct SortBuffers {
    block_sums: Buffer,
    table: Buffer,
    offsets: Buffer,
    passes: Vec<Buffer>,
    totals: Buffer,
}

/// Keys with values, and room to sort them.
#[derive(Debug)]
pub struct Pairs {
    pub keys: Buffer,
    pub values: Buffer,
    spare_keys: Buffer,
    spare_values: Buffer,
}

impl<'a> Commands<'a> {
    pub fn new(gpu: &'a Gpu) -> Self {
        let encoder = gpu
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Self {
            gpu,
            encoder,
            pass: None,
            timed: Vec::new(),
        }
    }

    /// Runs a kernel on `n_groups` workgroups.
    pub fn dispatch(
        &mut self,
        kernel: &'static Kernel,
        buffers: &[&Buffer],
        n_groups: u32,
    ) -> Result<(), GpuError> {
        if n_groups == 0 {
            return Ok(());
        }
        let rows = n_groups.div_ceil(MAX_GROUPS);
        self.bind(kernel, buffers)?
            .dispatch_workgroups(n_groups.min(MAX_GROUPS), rows, 1);
        Ok(())
    }

    /// Runs a kernel on as many workgroups as three words from `first_word` on say.
    pub fn dispatch_indirect(
        &mut self,
        kernel: &'static Kernel,
        buffers: &[&Buffer],
        args: &Buffer,
        first_word: u64,
    ) -> Result<(), GpuError> {
        self.bind(kernel, buffers)?
            .dispatch_workgroups_indirect(&args.raw, 4 * first_word);
        Ok(())
    }

    pub fn gpu(&self) -> &'a Gpu {
        self.gpu
    }

    /// Zeroes a buffer.
    pub fn clear(&mut self, buffer: &Buffer) {
        self.pass = None;
        self.encoder.clear_buffer(&buffer.raw, 0, None);
    }

    /// Copies the first `n_bytes`.
    pub fn copy(&mut self, from: &Buffer, to: &Buffer, n_bytes: u64) {
        self.copy_at(from, 0, to, 0, n_bytes);
    }

    pub fn copy_at(&mut self, from: &Buffer, from_at: u64, to: &Buffer, to_at: u64, n_bytes: u64) {
        if n_bytes > 0 {
            self.pass = None;
            self.encoder
                .copy_buffer_to_buffer(&from.raw, from_at, &to.raw, to_at, n_bytes);
        }
    }

    /// Exclusive prefix sums of the first `length[0]` numbers, the total behind them; room for `max_length` numbers.
    pub fn scan(
        &mut self,
        sort: &SortBuffers,
        [numbers, length, sums_before]: [&Buffer; 3],
        max_length: u32,
    ) -> Result<(), GpuError> {
        let n_groups = max_length.div_ceil(SCAN_BLOCK).max(1);
        let sums = &sort.block_sums;
        self.dispatch(&SCAN_SUMS, &[numbers, length, sums], n_groups)?;
        self.dispatch(&SCAN_BLOCKS, &[length, sums], 1)?;
        self.dispatch(&SCAN_APPLY, &[numbers, length, sums, sums_before], n_groups)
    }

    /// Sorts `length[0]` pairs by the lowest `8 * n_passes` bits of their keys; equal keys keep their order.
    pub fn sort(
        &mut self,
        sort: &SortBuffers,
        pairs: &mut Pairs,
        length: &Buffer,
        (args, first_word): (&Buffer, u64),
        n_passes: usize,
    ) -> Result<(), GpuError> {
        for pass in &sort.passes[..n_passes] {
            let count = [pass, &pairs.keys, length, &sort.table];
            self.dispatch_indirect(&SORT_COUNT, &count, args, first_word)?;
            let rows = [&sort.table, length, &sort.offsets, &sort.totals];
            self.dispatch(&SORT_ROWS, &rows, 256)?;
            let scatter = [
                pass,
                &pairs.keys,
                &pairs.values,
                length,
                &sort.offsets,
                &sort.totals,
                &pairs.spare_keys,
                &pairs.spare_values,
            ];
            let kernel = if SORT_SCATTER_SUBGROUPS.suits(self.gpu.lanes()) {
                &SORT_SCATTER_SUBGROUPS
            } else {
                &SORT_SCATTER
            };
            self.dispatch_indirect(kernel, &scatter, args, first_word)?;
            std::mem::swap(&mut pairs.keys, &mut pairs.spare_keys);
            std::mem::swap(&mut pairs.values, &mut pairs.spare_values);
        }
        Ok(())
    }

    pub fn submit(mut self) {
        self.pass = None;
        let mut profile = self.gpu.profile.borrow_mut();
        let Some(profile) = profile.as_mut().filter(|_| !self.timed.is_empty()) else {
            self.gpu.queue.submit([self.encoder.finish()]);
            return;
        };
        let n = 2 * self.timed.len();
        self.encoder
            .resolve_query_set(&profile.queries, 0..n as u32, &profile.ticks.raw, 0);
        self.gpu.queue.submit([self.encoder.finish()]);
        // A device that is lost says so to whoever reads results next.
        if let Ok(ticks) = self.gpu.read::<u64>(&profile.ticks, 0..n) {
            profile.add(&self.timed, &ticks);
        }
    }

    fn bind(
        &mut self,
        kernel: &'static Kernel,
        buffers: &[&Buffer],
    ) -> Result<&mut wgpu::ComputePass<'static>, GpuError> {
        let pipeline = self.gpu.pipeline(kernel)?;
        let key = (
            kernel.name,
            buffers.iter().map(|b| b.id).collect::<Vec<_>>(),
        );
        let mut groups = self.gpu.bind_groups.borrow_mut();
        let group = groups.entry(key).or_insert_with(|| {
            let entries: Vec<_> = buffers
                .iter()
                .zip(0..)
                .map(|(buffer, binding)| wgpu::BindGroupEntry {
                    binding,
                    resource: buffer.raw.as_entire_binding(),
                })
                .collect();
            self.gpu
                .device
                .create_bind_group(&wgpu::BindGroupDescriptor {
                    label: Some(kernel.name),
                    layout: &pipeline.layout,
                    entries: &entries,
                })
        });
        let encoder = &mut self.encoder;
        let profile = self.gpu.profile.borrow();
        let queries = profile.as_ref().map(|profile| &profile.queries);
        let mut timestamps = None;
        if let Some(query_set) = queries.filter(|_| self.timed.len() < MAX_TIMED) {
            self.pass = None;
            let first = 2 * self.timed.len() as u32;
            self.timed.push(kernel.name);
            timestamps = Some(wgpu::ComputePassTimestampWrites {
                query_set,
                beginning_of_pass_write_index: Some(first),
                end_of_pass_write_index: Some(first + 1),
            });
        }
        let pass = self.pass.get_or_insert_with(|| {
            let descriptor = wgpu::ComputePassDescriptor {
                label: None,
                timestamp_writes: timestamps,
            };
            encoder.begin_compute_pass(&descriptor).forget_lifetime()
        });
        pass.set_pipeline(&pipeline.compute);
        pass.set_bind_group(0, &*group, &[]);
        Ok(pass)
    }
}

impl SortBuffers {
    pub fn new(gpu: &Gpu, max_keys: u32) -> Result<Self, GpuError> {
        let n_table = 256 * max_keys.div_ceil(SORT_BLOCK).max(1) as usize;
        let passes = [0, 8, 16, 24].map(|shift| {
            let pass = SortPass {
                shift,
                ..SortPass::default()
            };
            gpu.uniform("sort_pass", &pass)
        });
        Ok(Self {
            block_sums: gpu.storage::<u32>(
                "block_sums",
                (max_keys as usize).div_ceil(SCAN_BLOCK as usize),
            )?,
            table: gpu.storage::<u32>("sort_table", n_table)?,
            offsets: gpu.storage::<u32>("sort_offsets", n_table)?,
            passes: passes.into(),
            totals: gpu.storage::<u32>("sort_totals", 256)?,
        })
    }
}
impl Pairs {
    pub fn new(gpu: &Gpu, max_pairs: usize) -> Result<Self, GpuError> {
        Ok(Self {
            keys: gpu.storage::<u32>("keys", max_pairs)?,
            values: gpu.storage::<u32>("values", max_pairs)?,
            spare_keys: gpu.storage::<u32>("spare_keys", max_pairs)?,
            spare_values: gpu.storage::<u32>("spare_values", max_pairs)?,
        })
    }
}
