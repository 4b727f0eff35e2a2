//! The stages of an image and of a step, in order, as dispatches.

use crate::wgpu::frame::Frame;
use crate::wgpu::kernels::{
    CULL, DEPTH_STRETCH, EMIT, GATHER, INSTANCE_ARGS, PHOTO_GRADIENT, PROJECT, PROJECT_BACKWARD,
    RANGES, RASTER, RASTER_BACKWARD, RASTER_BACKWARD_ATOMIC, SSIM_BACK, SSIM_ROWS, SSIM_TERMS,
    TILE_COUNTS, UPDATE_UNSEEN, UPDATE_VIEW, VIEW_CAMERA, VISIBLE_ARGS,
};
use crate::wgpu::memory::SplatMemory;
use crate::wgpu::types::{
    ARGS_INSTANCES, ARGS_SORT_INSTANCES, ARGS_SORT_VISIBLE, ARGS_VISIBLE, FLAG_ALL_SPLATS,
    FLAG_GRADIENTS, Step,
};
use crate::wgpu::views::Views;
use splat_gpu::buffer::Buffer;
use splat_gpu::commands::Commands;
use splat_gpu::error::GpuError;

/// Bits that one pass of the sort takes, and passes that the depth's 32 bits need.
const DIGIT_BITS: u32 = 8;
const DEPTH_PASSES: usize = 4;
/// Pixels along the blur that a thread of the loss takes, and threads of a group.
const LOSS_RUN: u32 = 4;
const LOSS_GROUP: u32 = 64;

/// Splats and camera -> image.
pub(crate) fn forward(
    commands: &mut Commands<'_>,
    frame: &mut Frame,
    memory: &SplatMemory,
    step: &Step,
) -> Result<(), GpuError> {
    find_visible(commands, frame, memory, step)?;
    let (s, i, p) = (&frame.per_splat, &mut frame.per_instance, &frame.per_pixel);
    commands.clear(&p.tile_ranges);
    commands.clear(&p.n_used);
    let order = &s.depths.values;
    let counts = [&frame.camera, order, &s.projected, &s.tile_counts];
    commands.dispatch_indirect(&TILE_COUNTS, &counts, &frame.args, ARGS_VISIBLE)?;
    let counted = [&s.tile_counts, &frame.n_visible, &s.first_instances];
    commands.scan(&s.sort, counted, step.n_splats)?;
    let instance_args = [
        &frame.step,
        &s.first_instances,
        &frame.camera,
        &frame.n_instances,
        &frame.args,
    ];
    commands.dispatch(&INSTANCE_ARGS, &instance_args, 1)?;
    let emit = [
        &frame.step,
        &frame.camera,
        order,
        &s.first_instances,
        &s.projected,
        &i.tiles.keys,
        &i.tiles.values,
        &i.owners,
    ];
    commands.dispatch_indirect(&EMIT, &emit, &frame.args, ARGS_VISIBLE)?;
    let n_tiles = step.n_tiles_x * step.n_tiles_y;
    // The number of tiles itself is a key too: that of no tile.
    let n_passes = (u32::BITS - n_tiles.leading_zeros()).div_ceil(DIGIT_BITS) as usize;
    let over_instances = (&frame.args, ARGS_SORT_INSTANCES);
    commands.sort(
        &i.sort,
        &mut i.tiles,
        &frame.n_instances,
        over_instances,
        n_passes,
    )?;
    let ranges = [
        &frame.step,
        &frame.camera,
        &i.tiles.keys,
        &i.tiles.values,
        &i.owners,
        &i.instances,
        &i.places,
        &p.tile_ranges,
    ];
    commands.dispatch_indirect(&RANGES, &ranges, &frame.args, ARGS_INSTANCES)?;
    let raster = [
        &frame.step,
        &s.projected,
        &i.instances,
        &p.tile_ranges,
        &p.image,
        &p.depth_sum,
        &p.n_used,
    ];
    commands.dispatch(&RASTER, &raster, n_tiles)
}

/// Splats and camera -> the visible ones as ellipses, in order of depth.
fn find_visible(
    commands: &mut Commands<'_>,
    frame: &mut Frame,
    memory: &SplatMemory,
    step: &Step,
) -> Result<(), GpuError> {
    let s = &mut frame.per_splat;
    let n_blocks = step.n_splats.div_ceil(256);
    let cull = [
        &frame.step,
        &frame.camera,
        &memory.geometry,
        &s.visible_bits,
        &s.block_counts,
    ];
    commands.dispatch(&CULL, &cull, n_blocks)?;
    let counted = [&s.block_counts, &frame.n_splat_blocks, &s.block_offsets];
    commands.scan(&s.sort, counted, n_blocks)?;
    let visible_args = [
        &frame.step,
        &s.block_offsets,
        &frame.camera,
        &frame.n_visible,
        &frame.args,
    ];
    commands.dispatch(&VISIBLE_ARGS, &visible_args, 1)?;
    let project = [
        &frame.step,
        &frame.camera,
        &memory.geometry,
        &memory.sh_rest,
        &s.visible_bits,
        &s.block_offsets,
        &s.projected,
        &s.depths.keys,
        &s.depths.values,
    ];
    commands.dispatch(&PROJECT, &project, n_blocks)?;
    let over_visible = (&frame.args, ARGS_SORT_VISIBLE);
    commands.sort(
        &s.sort,
        &mut s.depths,
        &frame.n_visible,
        over_visible,
        DEPTH_PASSES,
    )
}

/// Image against photo, and all the way back to the splats; `geometry` and `sh_rest` are updated, or replaced by their
/// gradients when the step's flags say so.
pub(crate) fn backward(
    commands: &mut Commands<'_>,
    frame: &Frame,
    [geometry, sh_rest]: [&Buffer; 2],
    memory: &SplatMemory,
    wanted: &Buffer,
    step: &Step,
) -> Result<(), GpuError> {
    let (s, p) = (&frame.per_splat, &frame.per_pixel);
    let in_rows = (step.width_px.div_ceil(LOSS_RUN) * step.height_px).div_ceil(LOSS_GROUP);
    let in_columns = (step.width_px * step.height_px.div_ceil(LOSS_RUN)).div_ceil(LOSS_GROUP);
    let rows = [&frame.step, &frame.camera, &p.image, wanted, &p.moments];
    commands.dispatch(&SSIM_ROWS, &rows, in_rows)?;
    let terms = [&frame.step, &p.moments, wanted, &p.terms, &p.ssim_sums];
    commands.dispatch(&SSIM_TERMS, &terms, in_columns)?;
    commands.dispatch(&SSIM_BACK, &[&frame.step, &p.terms, &p.moments], in_rows)?;
    let photo = [
        &frame.step,
        &frame.camera,
        &p.image,
        &p.depth_sum,
        wanted,
        &p.moments,
        &p.v_image,
        &p.behind,
        &p.loss_sums,
    ];
    commands.dispatch(&PHOTO_GRADIENT, &photo, in_columns)?;
    if step.depth_mode != 0 && step.depth_width > 0 && step.weights.depth_weight > 0.0 {
        let stretch = [
            &frame.step,
            &p.image,
            &p.depth_sum,
            wanted,
            &p.v_image,
            &p.behind,
            &p.loss_sums,
        ];
        commands.dispatch(&DEPTH_STRETCH, &stretch, 1)?;
    }
    sum_over_pixels(commands, frame, step)?;
    let project = [
        &frame.step,
        &frame.camera,
        &s.projected,
        &s.splat_sums,
        geometry,
        &memory.moments,
        sh_rest,
        &memory.sh_moments,
        &s.pose_sums,
    ];
    commands.dispatch_indirect(&PROJECT_BACKWARD, &project, &frame.args, ARGS_VISIBLE)?;
    if step.flags & (FLAG_ALL_SPLATS | FLAG_GRADIENTS) != FLAG_ALL_SPLATS {
        return Ok(());
    }
    let unseen = [
        &frame.step,
        &frame.camera,
        geometry,
        &memory.moments,
        sh_rest,
        &memory.sh_moments,
    ];
    commands.dispatch(&UPDATE_UNSEEN, &unseen, step.n_splats.div_ceil(256))
}

/// Gradients of the pixels -> those of each visible splat's 2D Gaussian.
fn sum_over_pixels(
    commands: &mut Commands<'_>,
    frame: &Frame,
    step: &Step,
) -> Result<(), GpuError> {
    let (s, i, p) = (&frame.per_splat, &frame.per_instance, &frame.per_pixel);
    let n_tiles = step.n_tiles_x * step.n_tiles_y;
    let is_atomic = commands.gpu().has_float_atomics();
    let sums = if is_atomic { &s.splat_sums } else { &i.slots };
    let raster = [
        &frame.step,
        &s.projected,
        &i.instances,
        &p.tile_ranges,
        &p.n_used,
        &p.v_image,
        &p.behind,
        sums,
    ];
    if is_atomic {
        commands.clear(&s.splat_sums);
        return commands.dispatch(&RASTER_BACKWARD_ATOMIC, &raster, n_tiles);
    }
    commands.dispatch(&RASTER_BACKWARD, &raster, n_tiles)?;
    let gather = [
        &frame.camera,
        &s.projected,
        &i.places,
        &i.slots,
        &s.splat_sums,
    ];
    commands.dispatch_indirect(&GATHER, &gather, &frame.args, ARGS_VISIBLE)
}

/// The view's record -> the camera of the step.
pub(crate) fn camera(
    commands: &mut Commands<'_>,
    frame: &Frame,
    views: &Views,
) -> Result<(), GpuError> {
    let buffers = [&frame.step, &views.records, &views.network, &frame.camera];
    commands.dispatch(&VIEW_CAMERA, &buffers, 1)
}

/// Sums of the way back -> the view, the network, and the statistics.
pub(crate) fn update_view(
    commands: &mut Commands<'_>,
    frame: &Frame,
    views: &Views,
) -> Result<(), GpuError> {
    let buffers = [
        &frame.step,
        &frame.camera,
        &frame.per_splat.pose_sums,
        &frame.per_pixel.loss_sums,
        &frame.per_pixel.ssim_sums,
        &views.records,
        &views.network,
        &frame.stats,
    ];
    commands.dispatch(&UPDATE_VIEW, &buffers, 1)
}
