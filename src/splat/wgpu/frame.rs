//! Buffers of one picture: what lies between the splats and the loss. They grow and are used again.

use crate::gpu::GpuError;
use crate::gpu::buffer::Buffer;
use crate::gpu::commands::{Pairs, SortBuffers};
use crate::gpu::device::Gpu;
use crate::gpu::types::{Camera, Projected, Step, TILE_PX};

/// Instances that there is room for at first, per splat and per tile: a map of small splats needs about three a splat.
const INSTANCES_PER_SPLAT: usize = 4;
const MIN_INSTANCES: usize = 1 << 14;

/// Room that there must be.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Room {
    pub(super) n_splats: usize,
    pub(super) n_pixels: usize,
    pub(super) n_tiles: usize,
    pub(super) n_instances: usize,
}

#[derive(Debug)]
pub(super) struct Frame {
    pub(super) room: Room,
    pub(super) step: Buffer,
    pub(super) camera: Buffer,
    /// One word each, as lengths of scans and sorts.
    pub(super) n_splat_blocks: Buffer,
    pub(super) n_visible: Buffer,
    pub(super) n_instances: Buffer,
    pub(super) args: Buffer,
    pub(super) stats: Buffer,
    pub(super) per_splat: PerSplat,
    pub(super) per_instance: PerInstance,
    pub(super) per_pixel: PerPixel,
}

#[derive(Debug)]
pub(super) struct PerSplat {
    pub(super) visible_bits: Buffer,
    pub(super) block_counts: Buffer,
    pub(super) block_offsets: Buffer,
    pub(super) projected: Buffer,
    pub(super) depths: Pairs,
    pub(super) tile_counts: Buffer,
    pub(super) first_instances: Buffer,
    pub(super) splat_sums: Buffer,
    pub(super) pose_sums: Buffer,
    pub(super) sort: SortBuffers,
}

#[derive(Debug)]
pub(super) struct PerInstance {
    pub(super) tiles: Pairs,
    pub(super) owners: Buffer,
    pub(super) instances: Buffer,
    pub(super) places: Buffer,
    pub(super) slots: Buffer,
    pub(super) sort: SortBuffers,
}

#[derive(Debug)]
pub(super) struct PerPixel {
    pub(super) tile_ranges: Buffer,
    pub(super) n_used: Buffer,
    pub(super) picture: Buffer,
    pub(super) depth_sum: Buffer,
    /// Moments, and after them the blurred terms.
    pub(super) moments: Buffer,
    pub(super) terms: Buffer,
    pub(super) ssim_sums: Buffer,
    pub(super) v_picture: Buffer,
    pub(super) behind: Buffer,
    pub(super) loss_sums: Buffer,
}

impl Frame {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let room = Room {
            n_splats: 1024,
            n_pixels: 64 * 64,
            n_tiles: 64,
            n_instances: MIN_INSTANCES,
        };
        Ok(Self {
            room,
            step: gpu.uniform("step", &Step::default()),
            camera: gpu.storage::<Camera>("camera", 1)?,
            n_splat_blocks: gpu.storage::<u32>("n_splat_blocks", 1)?,
            n_visible: gpu.storage::<u32>("n_visible", 1)?,
            n_instances: gpu.storage::<u32>("n_instances", 1)?,
            args: gpu.storage::<u32>("args", 16)?,
            stats: gpu.storage::<f32>("stats", 32)?,
            per_splat: PerSplat::new(gpu, room.n_splats)?,
            per_instance: PerInstance::new(gpu, room.n_instances)?,
            per_pixel: PerPixel::new(gpu, room)?,
        })
    }

    /// Makes room for a picture of these splats.
    pub(super) fn fit(
        &mut self,
        gpu: &Gpu,
        n_splats: usize,
        [width_px, height_px]: [u32; 2],
    ) -> Result<(), GpuError> {
        let n_tiles = width_px.div_ceil(TILE_PX) as usize * height_px.div_ceil(TILE_PX) as usize;
        let n_pixels = width_px as usize * height_px as usize;
        if n_splats > self.room.n_splats {
            let n = n_splats.max(self.room.n_splats + self.room.n_splats / 2);
            self.per_splat = PerSplat::new(gpu, n)?;
            self.room.n_splats = n;
            gpu.forget_bindings();
        }
        let n_instances = INSTANCES_PER_SPLAT * n_splats;
        if n_instances > self.room.n_instances {
            self.grow_instances(gpu, n_instances)?;
        }
        if n_pixels > self.room.n_pixels || n_tiles > self.room.n_tiles {
            self.room.n_pixels = self.room.n_pixels.max(n_pixels);
            self.room.n_tiles = self.room.n_tiles.max(n_tiles);
            self.per_pixel = PerPixel::new(gpu, self.room)?;
            gpu.forget_bindings();
        }
        Ok(())
    }

    pub(super) fn grow_instances(&mut self, gpu: &Gpu, n: usize) -> Result<(), GpuError> {
        self.per_instance = PerInstance::new(gpu, n)?;
        self.room.n_instances = n;
        gpu.forget_bindings();
        Ok(())
    }
}

impl PerSplat {
    fn new(gpu: &Gpu, n: usize) -> Result<Self, GpuError> {
        let n_blocks = n.div_ceil(256);
        let words = |label, n| gpu.storage::<u32>(label, n);
        Ok(Self {
            visible_bits: words("visible_bits", 8 * n_blocks)?,
            block_counts: words("block_counts", n_blocks)?,
            block_offsets: words("block_offsets", n_blocks + 1)?,
            projected: gpu.storage::<Projected>("projected", n)?,
            depths: Pairs::new(gpu, n)?,
            tile_counts: words("tile_counts", n)?,
            first_instances: words("first_instances", n + 1)?,
            splat_sums: words("splat_sums", 12 * n)?,
            pose_sums: words("pose_sums", 12 * n_blocks)?,
            sort: SortBuffers::new(gpu, n as u32)?,
        })
    }
}

impl PerInstance {
    fn new(gpu: &Gpu, n: usize) -> Result<Self, GpuError> {
        let words = |label, n| gpu.storage::<u32>(label, n);
        Ok(Self {
            tiles: Pairs::new(gpu, n)?,
            owners: words("owners", n)?,
            instances: words("instances", n)?,
            places: words("places", n)?,
            // Atomic sums need none.
            slots: words("slots", if gpu.has_float_atomics() { 0 } else { 12 * n })?,
            sort: SortBuffers::new(gpu, n as u32)?,
        })
    }
}

impl PerPixel {
    fn new(gpu: &Gpu, room: Room) -> Result<Self, GpuError> {
        let n = room.n_pixels;
        // A group of the loss has at least one column of pixels; partly filled ones count too.
        let n_groups = n.div_ceil(64) + 1;
        let floats = |label, n| gpu.storage::<f32>(label, n);
        Ok(Self {
            tile_ranges: floats("tile_ranges", 2 * room.n_tiles)?,
            n_used: floats("n_used", room.n_tiles)?,
            picture: floats("picture", 4 * n)?,
            depth_sum: floats("depth_sum", n)?,
            moments: floats("ssim_moments", 16 * n)?,
            terms: floats("ssim_terms", 12 * n)?,
            ssim_sums: floats("ssim_sums", n_groups)?,
            v_picture: floats("v_picture", 4 * n)?,
            behind: floats("behind", n)?,
            loss_sums: floats("loss_sums", 12 * n_groups)?,
        })
    }
}
