//! Plane sweep and semi-global matching on a GPU: the same depth as on the CPU, but for rounding in the costs.
//!
//! Only the costs are floats. Their sums over the paths are whole numbers, and the host places each winner between its
//! planes with the arithmetic of the CPU. Equal input gives equal bits on one adapter.

use crate::mvs::gpu_types::{self, MAX_SWEEP_PLANES, SWEEP_TILE_X, SWEEP_TILE_Y};
use crate::mvs::kernels::{self, MVS_COST, MVS_PATHS, MVS_WINNER};
use crate::mvs::params::MvsParams;
use crate::mvs::sgm::{self, Dip, Winners};
use crate::mvs::stereo::SweepTask;
use crate::mvs::view::{MvsView, Prepared, RawDepth, prepared};
use crate::mvs::zncc::{self, Statistics};
use splat_gpu::buffer::Buffer;
use splat_gpu::commands::Commands;
use splat_gpu::device::{Gpu, Wanted};
use splat_gpu::error::GpuError;

/// Most that one sweep may hold on the adapter. Parameters keep within it: costs and sums take 3 bytes of each of at
/// most 2^27 cells (whole words of four planes), and 16 sources of 2048x2048 pixels a quarter of it.
const MAX_BYTES: u64 = 1 << 30;

/// An adapter that matches, with buffers that last from sweep to sweep and grow when one needs more.
#[derive(Debug)]
pub struct GpuMatcher {
    gpu: Gpu,
    room: Option<Room>,
}

#[derive(Debug)]
struct Room {
    sizes: Sizes,
    sweep: Buffer,
    luma: Buffer,
    statistics: Buffer,
    warps: Buffer,
    starts: Buffer,
    penalties: Buffer,
    costs: Buffer,
    sums: Buffer,
    dips: Buffer,
}

/// Elements of the buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sizes {
    n_pixels: usize,
    /// Of the reference and all sources.
    n_luma: usize,
    n_sources: usize,
    n_starts: usize,
    /// Words of `costs`.
    n_words: usize,
}

impl GpuMatcher {
    /// The shaders are compiled here, so that a fault shows before anything is matched.
    pub fn open(wanted: Wanted) -> Result<Self, GpuError> {
        let gpu = Gpu::open(wanted)?;
        gpu.compile(kernels::ALL)?;
        Ok(Self { gpu, room: None })
    }

    /// For logs.
    pub fn adapter(&self) -> &str {
        self.gpu.name()
    }

    /// As `mvs::sweep`, on the adapter. After an error other than `TooLarge`, the adapter is of no use any more.
    pub fn sweep(
        &mut self,
        reference: &MvsView,
        sources: &[&MvsView],
        (near, far): (f64, f64),
        params: &MvsParams,
    ) -> Result<RawDepth, GpuError> {
        let reference = Prepared::new(reference, params);
        let sources = prepared(sources, params);
        let sources: Vec<&Prepared> = sources.iter().collect();
        match SweepTask::new(&reference, &sources, (near, far), params) {
            Some(task) => Ok(task.raw_depth(self.winners(&task)?)),
            None => Ok(RawDepth::empty(reference.intrinsics)),
        }
    }

    pub(crate) fn winners(&mut self, task: &SweepTask<'_>) -> Result<Winners, GpuError> {
        let grey = &task.reference.grey;
        self.make_room(Sizes::of(task))?;
        let (gpu, room) = (&self.gpu, self.room.as_ref().expect("made above"));
        room.fill(gpu, task);
        let n_pixels = grey.values.len();
        let n_words = task.planes.n.div_ceil(4);
        let n_tiles = grey.width.div_ceil(SWEEP_TILE_X as usize)
            * grey.height.div_ceil(SWEEP_TILE_Y as usize);
        let mut commands = Commands::new(gpu);
        commands.clear(&room.sums);
        let of_cost = [
            &room.sweep,
            &room.luma,
            &room.statistics,
            &room.warps,
            &room.starts,
            &room.costs,
        ];
        commands.dispatch(&MVS_COST, &of_cost, (n_tiles * n_words) as u32)?;
        let of_paths = [&room.sweep, &room.costs, &room.penalties, &room.sums];
        let n_paths = 2 * grey.height + 6 * grey.width;
        commands.dispatch(&MVS_PATHS, &of_paths, n_paths as u32)?;
        let of_winner = [&room.sweep, &room.costs, &room.sums, &room.dips];
        commands.dispatch(&MVS_WINNER, &of_winner, n_pixels.div_ceil(64) as u32)?;
        commands.submit();
        let dips: Vec<gpu_types::Dip> = gpu.read(&room.dips, 0..n_pixels)?;
        Ok(winners(&dips, task.planes.n))
    }

    /// Cost of each cell of the sweep before, as the CPU has them.
    #[cfg(test)]
    pub(crate) fn costs(&self, task: &SweepTask<'_>) -> Vec<u8> {
        let n_words = task.planes.n.div_ceil(4);
        let n_pixels = task.reference.grey.values.len();
        let room = self.room.as_ref().expect("a sweep was made");
        let words: Vec<u32> = self.gpu.read(&room.costs, 0..n_words * n_pixels).unwrap();
        words
            .chunks_exact(n_words)
            .flat_map(|pixel| bytemuck::cast_slice::<u32, u8>(pixel)[..task.planes.n].to_vec())
            .collect()
    }

    #[cfg(test)]
    pub(crate) fn peak_bytes(&self) -> u64 {
        self.gpu.meter().peak_bytes()
    }

    /// Room for so many pixels of one plane.
    #[cfg(test)]
    pub(crate) fn make_room_for(&mut self, n_pixels: usize) -> Result<(), GpuError> {
        self.make_room(Sizes {
            n_pixels,
            n_luma: 2 * n_pixels,
            n_sources: 1,
            n_starts: 1,
            n_words: n_pixels,
        })
    }

    /// As when the adapter is unplugged.
    #[cfg(test)]
    pub(crate) fn lose(&self) {
        self.gpu.lose();
    }

    /// Buffers that hold at least so much.
    fn make_room(&mut self, sizes: Sizes) -> Result<(), GpuError> {
        let held = self.room.as_ref().map(|room| room.sizes);
        if held.is_some_and(|held| held.larger(&sizes) == held) {
            return Ok(());
        }
        // The old ones first: both together would be more than was promised.
        self.room = None;
        self.gpu.forget_bindings();
        let larger = held.map_or(sizes, |held| held.larger(&sizes));
        let is_fit = larger.n_bytes() <= MAX_BYTES;
        let room = Room::new(&self.gpu, if is_fit { larger } else { sizes })?;
        self.room = Some(room);
        Ok(())
    }
}

impl Room {
    /// Uploads what the stages read.
    fn fill(&self, gpu: &Gpu, task: &SweepTask<'_>) {
        let (grey, planes) = (&task.reference.grey, &task.planes);
        let settings = gpu_types::Sweep {
            width_px: grey.width as u32,
            height_px: grey.height as u32,
            n_planes: planes.n as u32,
            n_words: planes.n.div_ceil(4) as u32,
            n_sources: task.warps.len() as u32,
            small_step: u32::from(sgm::SMALL_STEP),
            noise_variance: zncc::NOISE_VARIANCE,
            unseen_zncc: zncc::UNSEEN_ZNCC,
            own_share: zncc::OWN_SHARE,
            most_off: zncc::MOST_OFF,
            ..gpu_types::Sweep::default()
        };
        gpu.write(&self.sweep, 0, &[settings]);
        gpu.write(&self.statistics, 0, &statistics(task));
        gpu.write(&self.penalties, 0, &penalties(task));
        gpu.write(&self.luma, 0, &grey.values);
        let mut first = grey.values.len();
        for (ix, warp) in task.warps.iter().enumerate() {
            let [step_x, step_y, _] = warp.pixel_map.map(rounded);
            let there = gpu_types::Warp {
                step_x,
                step_y,
                width_px: warp.source.width as u32,
                height_px: warp.source.height as u32,
                first: first as u32,
                shown: (first + warp.source.values.len()) as u32,
            };
            gpu.write(&self.warps, ix, &[there]);
            gpu.write(&self.luma, first, &warp.source.values);
            first += warp.source.values.len();
            gpu.write(&self.luma, first, &warp.shown);
            first += warp.shown.len();
            let starts: Vec<[f32; 4]> = (0..planes.n)
                .map(|plane| warp.homogeneous(0.0, 0.0, planes.inverse_depth(plane as f64)))
                .map(|start| rounded(start.to_array()))
                .collect();
            gpu.write(&self.starts, ix * planes.n, &starts);
        }
    }
}

impl Sizes {
    fn of(task: &SweepTask<'_>) -> Self {
        let n_planes = task.planes.n;
        assert!(
            n_planes <= MAX_SWEEP_PLANES as usize,
            "mvs.depth_planes goes to {MAX_SWEEP_PLANES}"
        );
        let n_pixels = task.reference.grey.values.len();
        let of_sources = task
            .warps
            .iter()
            .map(|warp| warp.source.values.len() + warp.shown.len());
        Self {
            n_pixels,
            n_luma: n_pixels + of_sources.sum::<usize>(),
            n_sources: task.warps.len(),
            n_starts: task.warps.len() * n_planes,
            n_words: n_pixels * n_planes.div_ceil(4),
        }
    }

    /// In all buffers but the settings.
    fn n_bytes(&self) -> u64 {
        // Statistics, penalty and dip; cost and two sums.
        let (per_pixel, per_word) = (16 + 4 + size_of::<gpu_types::Dip>(), 4 + 8);
        let n_bytes = per_pixel * self.n_pixels
            + per_word * self.n_words
            + 4 * self.n_luma
            + size_of::<gpu_types::Warp>() * self.n_sources
            + 16 * self.n_starts;
        n_bytes as u64
    }

    fn larger(&self, other: &Self) -> Self {
        Self {
            n_pixels: self.n_pixels.max(other.n_pixels),
            n_luma: self.n_luma.max(other.n_luma),
            n_sources: self.n_sources.max(other.n_sources),
            n_starts: self.n_starts.max(other.n_starts),
            n_words: self.n_words.max(other.n_words),
        }
    }
}

impl Room {
    /// An error where the sweep is more than promised, or one buffer more than the adapter allows.
    fn new(gpu: &Gpu, sizes: Sizes) -> Result<Self, GpuError> {
        if sizes.n_bytes() > MAX_BYTES {
            return Err(GpuError::TooLarge {
                what: "a sweep",
                needed: sizes.n_bytes(),
                limit: MAX_BYTES,
                adapter: gpu.name().to_owned(),
            });
        }
        Ok(Self {
            sizes,
            sweep: gpu.uniform("sweep", &gpu_types::Sweep::default()),
            luma: gpu.storage::<f32>("luma", sizes.n_luma)?,
            statistics: gpu.storage::<[f32; 4]>("statistics", sizes.n_pixels)?,
            warps: gpu.storage::<gpu_types::Warp>("warps", sizes.n_sources)?,
            starts: gpu.storage::<[f32; 4]>("starts", sizes.n_starts)?,
            penalties: gpu.storage::<u32>("penalties", sizes.n_pixels)?,
            costs: gpu.storage::<u32>("costs", sizes.n_words)?,
            sums: gpu.storage::<u32>("sums", 2 * sizes.n_words)?,
            dips: gpu.storage::<gpu_types::Dip>("dips", sizes.n_pixels)?,
        })
    }
}

fn rounded([x, y, z]: [f64; 3]) -> [f32; 4] {
    [x as f32, y as f32, z as f32, 0.0]
}

fn statistics(task: &SweepTask<'_>) -> Vec<[f32; 4]> {
    let grey = &task.reference.grey;
    let of = Statistics::of(grey);
    let pixels = (0..grey.height).flat_map(|y| (0..grey.width).map(move |x| (x, y)));
    let at = |(x, y)| y * zncc::padded(grey.width) + x;
    pixels
        .map(at)
        .map(|ix| [of.sum[ix], of.spread[ix], of.one_over_n[ix], of.slack[ix]])
        .collect()
}

/// Bytes: the penalty for a jump between a pixel and the one left, above left, above, above right.
fn penalties(task: &SweepTask<'_>) -> Vec<u32> {
    let grey = &task.reference.grey;
    let mut all = Vec::with_capacity(grey.values.len());
    for y in 0..grey.height {
        let (row, above) = (grey.row(y), grey.row(y.saturating_sub(1)));
        for (x, luma) in row.iter().enumerate() {
            // Beyond the border no path comes from: any number will do.
            let (left, right) = (x.saturating_sub(1), (x + 1).min(grey.width - 1));
            let others = [row[left], above[left], above[x], above[right]];
            let bytes = others.map(|other| sgm::jump_penalty(*luma, other) as u8);
            all.push(u32::from_le_bytes(bytes));
        }
    }
    all
}

fn winners(dips: &[gpu_types::Dip], n_planes: usize) -> Winners {
    let mut winners = Winners {
        plane: vec![-1.0; dips.len()],
        score: vec![0.0; dips.len()],
        margin: vec![0.0; dips.len()],
    };
    for (ix, found) in dips.iter().enumerate() {
        let plane = found.plane as usize;
        // The surface lies outside of the range.
        if plane == 0 || plane + 1 >= n_planes {
            continue;
        }
        let dip = Dip {
            plane,
            before: found.before_at as u16,
            lowest: (found.before_at >> 16) as u16,
            after: found.after_second as u16,
            second: (found.after_second >> 16) as u16,
        };
        winners.plane[ix] = dip.fractional_plane();
        winners.score[ix] = sgm::score_of(found.cost as u8);
        winners.margin[ix] = dip.margin();
    }
    winners
}
