//! Buffers of one image: what lies between the splats and the loss. They grow and are used again.

use crate::wgpu::types::{Camera, Projected, Step, TILE_PX};
use splat_gpu::buffer::Buffer;
use splat_gpu::commands::{Pairs, SortBuffers};
use splat_gpu::device::Gpu;
use splat_gpu::error::GpuError;

/// Instances that there is room for at first, per splat and per tile: a map of small splats needs about three a splat.
const INSTANCES_PER_SPLAT: usize = 4;
const MIN_INSTANCES: usize = 1 << 14;

/// Room that there must be.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Room {
    pub(crate) n_splats: usize,
    pub(crate) n_pixels: usize,
    pub(crate) n_tiles: usize,
    pub(crate) n_instances: usize,
}

#[derive(Debug)]
pub(crate) struct Frame {
    pub(crate) room: Room,
    pub(crate) step: Buffer,
    pub(crate) camera: Buffer,
    /// One word each, as lengths of scans and sorts.
    pub(crate) n_splat_blocks: Buffer,
    pub(crate) n_visible: Buffer,
    pub(crate) n_instances: Buffer,
    pub(crate) args: Buffer,
    pub(crate) stats: Buffer,
    pub(crate) per_splat: PerSplat,
    pub(crate) per_instance: PerInstance,
    pub(crate) per_pixel: PerPixel,
}

#[derive(Debug)]
pub(crate) struct PerSplat {
    pub(crate) visible_bits: Buffer,
    pub(crate) block_counts: Buffer,
    pub(crate) block_offsets: Buffer,
    pub(crate) projected: Buffer,
    pub(crate) depths: Pairs,
    pub(crate) tile_counts: Buffer,
    pub(crate) first_instances: Buffer,
    pub(crate) splat_sums: Buffer,
    pub(crate) pose_sums: Buffer,
    pub(crate) sort: SortBuffers,
}

#[derive(Debug)]
pub(crate) struct PerInstance {
    pub(crate) tiles: Pairs,
    pub(crate) owners: Buffer,
    pub(crate) instances: Buffer,
    pub(crate) places: Buffer,
    pub(crate) slots: Buffer,
    pub(crate) sort: SortBuffers,
}

#[derive(Debug)]
pub(crate) struct PerPixel {
    pub(crate) tile_ranges: Buffer,
    pub(crate) n_used: Buffer,
    pub(crate) image: Buffer,
    pub(crate) depth_sum: Buffer,
    /// Moments, and after them the blurred terms.
    pub(crate) moments: Buffer,
    pub(crate) terms: Buffer,
    pub(crate) ssim_sums: Buffer,
    pub(crate) v_image: Buffer,
    pub(crate) behind: Buffer,
    pub(crate) loss_sums: Buffer,
}

impl Frame {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
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

    /// Makes room for an image of these splats.
    pub(crate) fn fit(
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
            let room = Room {
                n_pixels: self.room.n_pixels.max(n_pixels),
                n_tiles: self.room.n_tiles.max(n_tiles),
                ..self.room
            };
            self.per_pixel = PerPixel::new(gpu, room)?;
            self.room = room;
            gpu.forget_bindings();
        }
        Ok(())
    }

    pub(crate) fn grow_instances(&mut self, gpu: &Gpu, n: usize) -> Result<(), GpuError> {
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
            image: floats("image", 4 * n)?,
            depth_sum: floats("depth_sum", n)?,
            moments: floats("ssim_moments", 16 * n)?,
            terms: floats("ssim_terms", 12 * n)?,
            ssim_sums: floats("ssim_sums", n_groups)?,
            v_image: floats("v_image", 4 * n)?,
            behind: floats("behind", n)?,
            loss_sums: floats("loss_sums", 12 * n_groups)?,
        })
    }
}
