//! The splats on the GPU: parameters and optimiser state, one row a splat in each of five buffers.
//!
//! 480 bytes a splat at SH degree 3. Each buffer grows by half; a row never changes its place unless `retain` says so.

use crate::densify::ScreenGradients;
use splat_gpu::buffer::Buffer;
use splat_gpu::commands::Commands;
use splat_gpu::device::Gpu;
use splat_gpu::error::GpuError;
use splat_types::splats::splats::Splats;

/// Floats of a row of `geometry`: mean and opacity logit; quaternion; log-scale and updates since its moments were 0;
/// base colour and the step that saw it last.
const GEOMETRY: usize = 16;
const MOMENTS: usize = 32;
const MIN_ROWS: usize = 1024;

/// Where a row of `moments` has the updates in all.
const AGE: usize = 19;
/// Where it has the sum of the screen gradients, and how many they are.
const SCREEN_SUM: usize = 27;
const SCREEN_COUNT: usize = 31;
/// Where rows of `geometry` and of `moments` have the opacity logit, and the second moment of it.
const LOGIT: usize = 3;
const LOGIT_SECOND: usize = 7;

/// Buffers with room for `capacity` rows, of which `n` are splats.
#[derive(Debug)]
pub(crate) struct SplatMemory {
    pub(crate) n: usize,
    pub(crate) sh_degree: u8,
    capacity: usize,
    pub(crate) geometry: Buffer,
    pub(crate) moments: Buffer,
    pub(crate) sh_rest: Buffer,
    pub(crate) sh_moments: Buffer,
    pub(crate) anchors: Buffer,
}

/// Numbers of SH above degree 0 of a splat.
pub(crate) fn n_sh_rest(degree: u8) -> usize {
    3 * ((usize::from(degree) + 1).pow(2) - 1)
}

/// Words of their optimiser state: first moments as pairs of bf16, one second moment a band.
fn n_sh_moments(degree: u8) -> usize {
    n_sh_rest(degree).div_ceil(2) + usize::from(degree)
}

/// Bytes of a splat in all buffers.
pub(crate) fn bytes_per_splat(degree: u8) -> usize {
    4 * (GEOMETRY + MOMENTS + n_sh_rest(degree) + n_sh_moments(degree) + 1)
}

/// Splats that an adapter has room for in its largest buffers.
pub(crate) fn max_splats(gpu: &Gpu, degree: u8) -> usize {
    let widest = MOMENTS.max(n_sh_rest(degree));
    (gpu.max_buffer_bytes() / (4 * widest as u64)) as usize
}

impl SplatMemory {
    pub(crate) fn new(gpu: &Gpu, sh_degree: u8) -> Result<Self, GpuError> {
        Self::with_capacity(gpu, sh_degree, MIN_ROWS)
    }

    fn with_capacity(gpu: &Gpu, sh_degree: u8, capacity: usize) -> Result<Self, GpuError> {
        let float = |label, width| gpu.storage::<f32>(label, capacity * width);
        Ok(Self {
            n: 0,
            sh_degree,
            capacity,
            geometry: float("geometry", GEOMETRY)?,
            moments: float("moments", MOMENTS)?,
            sh_rest: float("sh_rest", n_sh_rest(sh_degree))?,
            sh_moments: float("sh_moments", n_sh_moments(sh_degree))?,
            anchors: float("anchors", 1)?,
        })
    }

    /// Makes room for `n` rows in all; the old ones stay where they are. true: buffers were replaced.
    pub(crate) fn reserve(&mut self, gpu: &Gpu, n: usize) -> Result<bool, GpuError> {
        if n <= self.capacity {
            return Ok(false);
        }
        let capacity = n
            .max(self.capacity + self.capacity / 2)
            .min(max_splats(gpu, self.sh_degree))
            .max(n);
        let mut grown = Self::with_capacity(gpu, self.sh_degree, capacity)?;
        grown.n = self.n;
        let mut commands = Commands::new(gpu);
        let widths = self.widths();
        for ((from, to), width) in self.buffers().iter().zip(grown.buffers()).zip(widths) {
            commands.copy(from, to, (4 * width * self.n) as u64);
        }
        commands.submit();
        *self = grown;
        Ok(true)
    }

    /// Writes splats behind the last. There must be room.
    pub(crate) fn append(&mut self, gpu: &Gpu, splats: &Splats, now: u32) {
        self.write(gpu, self.n, splats, now);
        let zeros = vec![0.0_f32; MOMENTS.max(n_sh_moments(self.sh_degree)) * splats.len()];
        gpu.write(
            &self.moments,
            self.n * MOMENTS,
            &zeros[..MOMENTS * splats.len()],
        );
        let width = n_sh_moments(self.sh_degree);
        gpu.write(
            &self.sh_moments,
            self.n * width,
            &zeros[..width * splats.len()],
        );
        self.n += splats.len();
    }

    /// Overwrites the parameters of all, optimiser state and update counts stay.
    pub(crate) fn overwrite(&mut self, gpu: &Gpu, splats: &Splats) -> Result<(), GpuError> {
        let old: Vec<f32> = gpu.read(&self.geometry, 0..self.n * GEOMETRY)?;
        let mut rows = geometry_rows(splats, 0);
        for (row, old) in rows
            .chunks_exact_mut(GEOMETRY)
            .zip(old.chunks_exact(GEOMETRY))
        {
            (row[11], row[15]) = (old[11], old[15]);
        }
        gpu.write(&self.geometry, 0, &rows);
        gpu.write(&self.sh_rest, 0, &sh_rest_rows(splats));
        gpu.write(&self.anchors, 0, &splats.anchors);
        Ok(())
    }

    /// Keeps row i when `keep[i]`, in order.
    pub(crate) fn retain(&mut self, gpu: &Gpu, keep: &[bool]) -> Result<(), GpuError> {
        let kept = Self::with_capacity(gpu, self.sh_degree, self.capacity)?;
        let mut commands = Commands::new(gpu);
        let mut n = 0;
        for (begin, end) in runs(keep) {
            for ((from, to), width) in self.buffers().iter().zip(kept.buffers()).zip(self.widths())
            {
                let bytes = 4 * width as u64;
                let (at, to_at) = (begin as u64 * bytes, n as u64 * bytes);
                commands.copy_at(from, at, to, to_at, (end - begin) as u64 * bytes);
            }
            n += end - begin;
        }
        commands.submit();
        *self = Self { n, ..kept };
        Ok(())
    }

    pub(crate) fn read(&self, gpu: &Gpu) -> Result<Splats, GpuError> {
        let geometry: Vec<f32> = gpu.read(&self.geometry, 0..self.n * GEOMETRY)?;
        let rest: Vec<f32> = gpu.read(&self.sh_rest, 0..self.n * n_sh_rest(self.sh_degree))?;
        let mut splats = self.unpack(&geometry, &rest);
        splats.anchors = gpu.read(&self.anchors, 0..self.n)?;
        Ok(splats)
    }

    pub(crate) fn update_counts(&self, gpu: &Gpu) -> Result<Vec<u16>, GpuError> {
        let rows: Vec<f32> = gpu.read(&self.moments, 0..self.n * MOMENTS)?;
        let rows = rows.chunks_exact(MOMENTS);
        Ok(rows.map(|row| row[AGE] as u16).collect())
    }

    /// Of splats from `first` on, whose moments are 0.
    pub(crate) fn set_update_counts(&self, gpu: &Gpu, first: usize, update_counts: &[u16]) {
        let mut rows = vec![0.0_f32; MOMENTS * update_counts.len()];
        for (row, age) in rows.chunks_exact_mut(MOMENTS).zip(update_counts) {
            row[AGE] = f32::from(*age);
        }
        gpu.write(&self.moments, first * MOMENTS, &rows);
    }

    /// Reads the sums of the screen gradients and puts them to 0.
    pub(crate) fn take_screen_gradients(&self, gpu: &Gpu) -> Result<ScreenGradients, GpuError> {
        let mut rows: Vec<f32> = gpu.read(&self.moments, 0..self.n * MOMENTS)?;
        let mut taken = ScreenGradients::default();
        for row in rows.chunks_exact_mut(MOMENTS) {
            taken.sums.push(row[SCREEN_SUM]);
            taken.counts.push(row[SCREEN_COUNT] as u32);
            (row[SCREEN_SUM], row[SCREEN_COUNT]) = (0.0, 0.0);
        }
        gpu.write(&self.moments, 0, &rows);
        Ok(taken)
    }

    /// Holds the opacity logits to at most `max_logit` and clears their moments.
    pub(crate) fn reset_opacities(&self, gpu: &Gpu, max_logit: f32) -> Result<(), GpuError> {
        let mut rows: Vec<f32> = gpu.read(&self.geometry, 0..self.n * GEOMETRY)?;
        let mut moments: Vec<f32> = gpu.read(&self.moments, 0..self.n * MOMENTS)?;
        for row in rows.chunks_exact_mut(GEOMETRY) {
            row[LOGIT] = row[LOGIT].min(max_logit);
        }
        for row in moments.chunks_exact_mut(MOMENTS) {
            (row[LOGIT], row[LOGIT_SECOND]) = (0.0, 0.0);
        }
        gpu.write(&self.geometry, 0, &rows);
        gpu.write(&self.moments, 0, &moments);
        Ok(())
    }

    pub(crate) fn n_bytes(&self) -> u64 {
        self.buffers().iter().map(|buffer| buffer.n_bytes()).sum()
    }

    /// Rows as the shaders lay them out -> splats, anchors 0.
    pub(crate) fn unpack(&self, geometry: &[f32], rest: &[f32]) -> Splats {
        let mut splats = Splats {
            sh_degree: self.sh_degree,
            anchors: vec![0; self.n],
            ..Splats::default()
        };
        let width = n_sh_rest(self.sh_degree);
        for (i, row) in geometry.chunks_exact(GEOMETRY).enumerate() {
            splats.means.push([row[0], row[1], row[2]]);
            splats.opacity_logits.push(row[3]);
            splats.quats.push([row[4], row[5], row[6], row[7]]);
            splats.log_scales.push([row[8], row[9], row[10]]);
            splats.sh.extend_from_slice(&row[12..15]);
            splats
                .sh
                .extend_from_slice(&rest[i * width..(i + 1) * width]);
        }
        splats
    }

    /// A copy of the rows that gradients may take the place of.
    pub(crate) fn scratch(&self, gpu: &Gpu) -> Result<[Buffer; 2], GpuError> {
        let geometry = gpu.storage::<f32>("geometry", self.n * GEOMETRY)?;
        let rest = gpu.storage::<f32>("sh_rest", self.n * n_sh_rest(self.sh_degree))?;
        let mut commands = Commands::new(gpu);
        commands.copy(&self.geometry, &geometry, (4 * self.n * GEOMETRY) as u64);
        let n_bytes = 4 * self.n * n_sh_rest(self.sh_degree);
        commands.copy(&self.sh_rest, &rest, n_bytes as u64);
        commands.submit();
        Ok([geometry, rest])
    }

    fn write(&self, gpu: &Gpu, first: usize, splats: &Splats, now: u32) {
        gpu.write(
            &self.geometry,
            first * GEOMETRY,
            &geometry_rows(splats, now),
        );
        let width = n_sh_rest(self.sh_degree);
        gpu.write(&self.sh_rest, first * width, &sh_rest_rows(splats));
        gpu.write(&self.anchors, first, &splats.anchors);
    }

    fn buffers(&self) -> [&Buffer; 5] {
        [
            &self.geometry,
            &self.moments,
            &self.sh_rest,
            &self.sh_moments,
            &self.anchors,
        ]
    }

    /// Words of a row of each.
    fn widths(&self) -> [usize; 5] {
        let degree = self.sh_degree;
        [
            GEOMETRY,
            MOMENTS,
            n_sh_rest(degree),
            n_sh_moments(degree),
            1,
        ]
    }
}

fn geometry_rows(splats: &Splats, now: u32) -> Vec<f32> {
    let stride = splats.sh_stride();
    let mut rows = Vec::with_capacity(GEOMETRY * splats.len());
    for i in 0..splats.len() {
        rows.extend(splats.means[i]);
        rows.push(splats.opacity_logits[i]);
        rows.extend(splats.quats[i]);
        rows.extend(splats.log_scales[i]);
        // Updates since its moments were 0.
        rows.push(0.0);
        rows.extend_from_slice(&splats.sh[i * stride..i * stride + 3]);
        rows.push(now as f32);
    }
    rows
}

fn sh_rest_rows(splats: &Splats) -> Vec<f32> {
    splats
        .sh
        .chunks_exact(splats.sh_stride())
        .flat_map(|row| &row[3..])
        .copied()
        .collect()
}

/// Begin and end of each run of `true`.
fn runs(keep: &[bool]) -> Vec<(usize, usize)> {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for (i, _) in keep.iter().enumerate().filter(|(_, keep)| **keep) {
        match runs.last_mut() {
            Some((_, end)) if *end == i => *end += 1,
            _ => runs.push((i, i + 1)),
        }
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::bytes_per_splat;

    #[test]
    fn a_splat_and_its_optimiser_fit_the_memory_it_may_take() {
        assert_eq!(bytes_per_splat(3), 480);
        assert_eq!(bytes_per_splat(0), 196);
    }
}
