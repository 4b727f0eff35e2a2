//! The views on the GPU: a record of pose, camera and exposure each, the image that is wanted, and the shared network.

use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3};

use crate::appearance::{AppearanceMlp, AppearanceNetwork, first_appearance};
use crate::pose_network::{Embedding, PoseNetwork, WIDTH, first_embedding};
use crate::settings::{FirstEmbedding, PoseNetworkSettings};
use crate::view::{Correspondence, SSIM_REACH, TrainingView};
use crate::wgpu::types::{
    APPEARANCE_NET, LOG_FOCAL, NET_FLOATS, NET_SIZE, VIEW_APPEARANCE, VIEW_EMBEDDING,
    VIEW_EMBEDDING_AGE, VIEW_EXPOSURE, VIEW_PINHOLE, VIEW_POSE_AGE, VIEW_POSE_M, VIEW_QUAT,
    VIEW_STRIDE, VIEW_TRANSLATION,
};
use splat_gpu::buffer::Buffer;
use splat_gpu::commands::Commands;
use splat_gpu::device::Gpu;
use splat_gpu::error::GpuError;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

const MIN_VIEWS: usize = 64;
const N_POSE: usize = 6;

#[derive(Debug)]
pub(crate) struct Views {
    pub(crate) all: Vec<View>,
    /// `VIEW_STRIDE` floats a view.
    pub(crate) records: Buffer,
    capacity: usize,
    /// Parameters, moments, and what else all views share.
    pub(crate) network: Buffer,
    /// Settings of the network once it has started.
    pub(crate) pose_network: Option<PoseNetworkSettings>,
    /// Whether a step has moved the appearance network.
    pub(crate) has_appearance: bool,
}

/// What the host has to know of a view.
#[derive(Debug)]
pub(crate) struct View {
    /// Its `cam_from_world` is the base pose that was last written, in full precision.
    pub(crate) training: TrainingView,
    /// Photo with pixel weights, then depth with confidence.
    pub(crate) wanted: Buffer,
    pub(crate) mask_sum: f32,
    /// Weight of all pixels over that of those whose whole SSIM window lies in the image; 0 where there are none.
    pub(crate) valid_share: f32,
    pub(crate) confidence_sum: f32,
    pub(crate) matches: Vec<Correspondence>,
}

impl Views {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            all: Vec::new(),
            records: gpu.storage::<f32>("views", MIN_VIEWS * VIEW_STRIDE)?,
            capacity: MIN_VIEWS,
            network: gpu.storage::<f32>("network", NET_FLOATS)?,
            pose_network: None,
            has_appearance: false,
        })
    }

    pub(crate) fn add(&mut self, gpu: &Gpu, training: TrainingView) -> Result<usize, GpuError> {
        if self.all.len() == self.capacity {
            let capacity = 2 * self.capacity;
            let grown = gpu.storage::<f32>("views", capacity * VIEW_STRIDE)?;
            let mut commands = Commands::new(gpu);
            commands.copy(&self.records, &grown, self.records.n_bytes());
            commands.submit();
            gpu.forget_bindings();
            (self.records, self.capacity) = (grown, capacity);
        }
        let view = View::new(gpu, training)?;
        let ix = self.all.len();
        let pose = view.training.cam_from_world;
        let embedding = ix * VIEW_STRIDE + VIEW_EMBEDDING;
        let kind = self
            .pose_network
            .map_or(FirstEmbedding::default(), |network| network.embedding);
        gpu.write(&self.records, embedding, &first_embedding(kind, ix));
        let appearance = ix * VIEW_STRIDE + VIEW_APPEARANCE;
        gpu.write(&self.records, appearance, &first_appearance(ix));
        self.write_camera(gpu, ix, &view.training.intrinsics);
        self.all.push(view);
        self.set_pose(gpu, ix, pose)?;
        Ok(ix)
    }

    pub(crate) fn write_camera(&self, gpu: &Gpu, ix: usize, intrinsics: &Intrinsics) {
        let i = intrinsics;
        let pinhole = [i.fx, i.fy, i.cx, i.cy].map(|v| v as f32);
        gpu.write(&self.records, ix * VIEW_STRIDE + VIEW_PINHOLE, &pinhole);
    }

    /// Moves the base so that base and network together are `cam_from_world`; the view's own optimiser starts again.
    pub(crate) fn set_pose(
        &mut self,
        gpu: &Gpu,
        ix: usize,
        cam_from_world: Rigid,
    ) -> Result<(), GpuError> {
        let base = match self.network(gpu)? {
            None => cam_from_world,
            Some(pose_network) => {
                let at = ix * VIEW_STRIDE + VIEW_EMBEDDING;
                let embedding = embedding_of(&gpu.read(&self.records, at..at + WIDTH)?);
                let output = pose_network.forward(&embedding).output;
                (pose_network.motion(&output) * cam_from_world).renormalized()
            }
        };
        self.write_base(gpu, ix, &base);
        let record = ix * VIEW_STRIDE;
        gpu.write(&self.records, record + VIEW_POSE_M, &[0.0_f32; 2 * N_POSE]);
        gpu.write(&self.records, record + VIEW_POSE_AGE, &[0.0_f32]);
        let moments = record + VIEW_EMBEDDING + WIDTH;
        gpu.write(&self.records, moments, &[0.0_f32; 2 * WIDTH]);
        gpu.write(&self.records, record + VIEW_EMBEDDING_AGE, &[0.0_f32]);
        Ok(())
    }

    /// Refined poses: base and network together.
    pub(crate) fn poses(&self, gpu: &Gpu) -> Result<Vec<Rigid>, GpuError> {
        let (records, bases) = self.bases(gpu)?;
        let Some(pose_network) = self.network(gpu)? else {
            return Ok(bases);
        };
        let pose = |(record, base): (&[f32], &Rigid)| {
            let embedding = embedding_of(&record[VIEW_EMBEDDING..][..WIDTH]);
            pose_network.apply(base, &embedding)
        };
        let records = records.chunks_exact(VIEW_STRIDE);
        Ok(records.zip(&bases).map(pose).collect())
    }

    /// All records, and the poses before the network that they hold.
    fn bases(&self, gpu: &Gpu) -> Result<(Vec<f32>, Vec<Rigid>), GpuError> {
        let records: Vec<f32> = gpu.read(&self.records, 0..self.all.len() * VIEW_STRIDE)?;
        let base = |(record, view): (&[f32], &View)| {
            let written = &view.training.cam_from_world;
            // What no step has moved is as exact as it was given.
            if record[VIEW_QUAT..VIEW_QUAT + 7] == numbers_of(written) {
                *written
            } else {
                base_of(record)
            }
        };
        let by_view = records.chunks_exact(VIEW_STRIDE).zip(&self.all);
        let bases = by_view.map(base).collect();
        Ok((records, bases))
    }

    /// A motion of the map acts on the bases as on the poses: the network's motion stands left of both.
    pub(crate) fn move_cameras(&mut self, gpu: &Gpu, new_from_old: &Rigid) -> Result<(), GpuError> {
        let old_from_new = new_from_old.inverse();
        for (ix, base) in self.bases(gpu)?.1.into_iter().enumerate() {
            self.write_base(gpu, ix, &(base * old_from_new).renormalized());
        }
        Ok(())
    }

    /// What the old network did stays in the bases; a new one starts.
    pub(crate) fn start_pose_network(
        &mut self,
        gpu: &Gpu,
        settings: &PoseNetworkSettings,
    ) -> Result<(), GpuError> {
        let poses = self.poses(gpu)?;
        let mut parameters = PoseNetwork::new(settings).mlp.parameters;
        // Moments and age; the focal factor behind them stays.
        parameters.resize(3 * NET_SIZE + 1, 0.0);
        gpu.write(&self.network, 0, &parameters);
        for (ix, pose) in poses.iter().enumerate() {
            self.write_base(gpu, ix, pose);
            let record = ix * VIEW_STRIDE;
            let mut row = [0.0_f32; 3 * WIDTH];
            row[..WIDTH].copy_from_slice(&first_embedding(settings.embedding, ix));
            gpu.write(&self.records, record + VIEW_EMBEDDING, &row);
            gpu.write(&self.records, record + VIEW_EMBEDDING_AGE, &[0.0_f32]);
        }
        self.pose_network = Some(*settings);
        Ok(())
    }

    pub(crate) fn focal_factor(&self, gpu: &Gpu) -> Result<f64, GpuError> {
        let log: Vec<f32> = gpu.read(&self.network, LOG_FOCAL..LOG_FOCAL + 1)?;
        Ok(log.first().map_or(1.0, |log| f64::from(*log).exp()))
    }

    pub(crate) fn exposures(&self, gpu: &Gpu) -> Result<Vec<[[f32; 3]; 2]>, GpuError> {
        let records: Vec<f32> = gpu.read(&self.records, 0..self.all.len() * VIEW_STRIDE)?;
        let mut network = AppearanceNetwork::default();
        if self.has_appearance {
            let at = APPEARANCE_NET;
            let n = AppearanceMlp::N_PARAMETERS;
            network.mlp.parameters = gpu.read(&self.network, at..at + n)?;
        }
        let exposure = |record: &[f32]| {
            let embedding = std::array::from_fn(|i| record[VIEW_APPEARANCE + i]);
            let mut exposure = network.exposure(&embedding);
            let own = &record[VIEW_EXPOSURE..VIEW_EXPOSURE + 6];
            for (value, own) in exposure.as_flattened_mut().iter_mut().zip(own) {
                *value += own;
            }
            exposure
        };
        Ok(records.chunks_exact(VIEW_STRIDE).map(exposure).collect())
    }

    /// What a step needs that moves the appearance network.
    pub(crate) fn start_appearance(&mut self, gpu: &Gpu) {
        if !self.has_appearance {
            let parameters = AppearanceNetwork::default().mlp.parameters;
            gpu.write(&self.network, APPEARANCE_NET, &parameters);
            self.has_appearance = true;
        }
    }

    /// The network as it is, when it has started.
    fn network(&self, gpu: &Gpu) -> Result<Option<PoseNetwork>, GpuError> {
        let Some(settings) = &self.pose_network else {
            return Ok(None);
        };
        let mut pose_network = PoseNetwork::new(settings);
        pose_network.mlp.parameters = gpu.read(&self.network, 0..NET_SIZE)?;
        Ok(Some(pose_network))
    }

    fn write_base(&mut self, gpu: &Gpu, ix: usize, base: &Rigid) {
        self.all[ix].training.cam_from_world = *base;
        gpu.write(
            &self.records,
            ix * VIEW_STRIDE + VIEW_QUAT,
            &numbers_of(base),
        );
    }
}

impl View {
    fn new(gpu: &Gpu, training: TrainingView) -> Result<Self, GpuError> {
        let words = wanted(&training);
        Ok(Self {
            wanted: gpu.storage_of("wanted", &words)?,
            mask_sum: mask_sum(&training),
            valid_share: valid_share(&training),
            confidence_sum: confidence_sum(&training),
            matches: Vec::new(),
            training,
        })
    }

    /// Takes another image, mask or depth; where there is no memory for it, the old ones stay.
    pub(crate) fn upload(&mut self, gpu: &Gpu, training: TrainingView) -> Result<(), GpuError> {
        let words = wanted(&training);
        if words.len() as u64 * 4 <= self.wanted.n_bytes() {
            gpu.write(&self.wanted, 0, &words);
        } else {
            self.wanted = gpu.storage_of("wanted", &words)?;
            gpu.forget_bindings();
        }
        self.training = training;
        self.mask_sum = mask_sum(&self.training);
        self.valid_share = valid_share(&self.training);
        self.confidence_sum = confidence_sum(&self.training);
        Ok(())
    }

    /// Only where the view stands stays.
    pub(crate) fn rest(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        let image = &self.training.image;
        let unloaded = RgbImage::unloaded(image.width_px, image.height_px);
        self.training.image = Arc::new(unloaded);
        (self.training.depth, self.training.mask) = (None, None);
        self.matches = Vec::new();
        self.wanted = gpu.storage_of("wanted", &[0_u32])?;
        gpu.forget_bindings();
        Ok(())
    }

    /// Size of the depth map; none is 0 x 0.
    pub(crate) fn depth_size(&self) -> [u32; 2] {
        match &self.training.depth {
            Some(depth) if is_whole(depth) => [depth.width_px, depth.height_px],
            _ => [0; 2],
        }
    }
}

fn is_whole(depth: &DepthMap) -> bool {
    let n = depth.width_px as usize * depth.height_px as usize;
    n > 0 && depth.depth.len() >= n && depth.confidence.len() >= n
}

fn wanted(view: &TrainingView) -> Vec<u32> {
    if view.image.is_unloaded() {
        return vec![0];
    }
    let weights = view.mask.as_deref();
    let pixels = view.image.pixels.chunks_exact(3).enumerate();
    let mut words: Vec<u32> = pixels
        .map(|(p, rgb)| {
            let weight = weights.map_or(u8::MAX, |weights| weights[p]);
            u32::from_le_bytes([rgb[0], rgb[1], rgb[2], weight])
        })
        .collect();
    if let Some(depth) = view.depth.as_deref().filter(|depth| is_whole(depth)) {
        let n = depth.width_px as usize * depth.height_px as usize;
        words.extend((0..n).flat_map(|at| {
            let (given, verified) = (depth.depth[at], depth.verified(at));
            let is_depth = given > 0.0 && given.is_finite();
            let known = verified.unwrap_or((if is_depth { given } else { 0.0 }, 0.0));
            [known.0, known.1].map(f32::to_bits)
        }));
    }
    words
}

fn valid_share(view: &TrainingView) -> f32 {
    let (width, height) = (view.image.width_px, view.image.height_px);
    let inside = |at: u32, side: u32| at >= SSIM_REACH && at + SSIM_REACH < side;
    let valid: f64 = match &view.mask {
        None => {
            let [w, h] = [width, height].map(|side| side.saturating_sub(2 * SSIM_REACH));
            f64::from(w) * f64::from(h)
        }
        Some(mask) => {
            let pixels = mask.iter().zip(0_u32..);
            let valid =
                pixels.filter(|(_, p)| inside(p % width, width) && inside(p / width, height));
            valid.map(|(byte, _)| f64::from(*byte)).sum::<f64>() / 255.0
        }
    };
    if valid > 0.0 {
        (f64::from(mask_sum(view)) / valid) as f32
    } else {
        0.0
    }
}

fn mask_sum(view: &TrainingView) -> f32 {
    match &view.mask {
        None => (view.image.pixels.len() / 3) as f32,
        Some(mask) => {
            let sum: u64 = mask.iter().map(|byte| u64::from(*byte)).sum();
            (sum as f64 / 255.0) as f32
        }
    }
}

/// Over the pixels of the image, each with the nearest pixel of the depth map.
fn confidence_sum(view: &TrainingView) -> f32 {
    let depth = view.depth.as_deref().filter(|depth| is_whole(depth));
    let Some(depth) = depth.filter(|_| !view.image.is_unloaded()) else {
        return 0.0;
    };
    let (width, height) = (view.image.width_px as usize, view.image.height_px as usize);
    let (map_width, map_height) = (depth.width_px as usize, depth.height_px as usize);
    let mut sum = 0.0;
    for y in 0..height {
        let row = (2 * y + 1) * map_height / (2 * height) * map_width;
        for x in 0..width {
            let at = row + (2 * x + 1) * map_width / (2 * width);
            if let Some((_, confidence)) = depth.verified(at) {
                let weight = view
                    .mask
                    .as_ref()
                    .map_or(1.0, |mask| f64::from(mask[y * width + x]) / 255.0);
                sum += weight * f64::from(confidence);
            }
        }
    }
    sum as f32
}

/// As a record has it: quaternion, translation.
fn numbers_of(pose: &Rigid) -> [f32; 7] {
    let (q, t) = (pose.rotation, pose.translation);
    [q.w, q.x, q.y, q.z, t.x, t.y, t.z].map(|v| v as f32)
}

fn base_of(record: &[f32]) -> Rigid {
    let at = |k: usize| f64::from(record[k]);
    let rotation = DQuat::from_xyzw(
        at(VIEW_QUAT + 1),
        at(VIEW_QUAT + 2),
        at(VIEW_QUAT + 3),
        at(VIEW_QUAT),
    );
    let t = VIEW_TRANSLATION;
    Rigid::new(
        rotation.normalize(),
        DVec3::new(at(t), at(t + 1), at(t + 2)),
    )
}

fn embedding_of(numbers: &[f32]) -> Embedding {
    std::array::from_fn(|i| numbers[i])
}

/// A camera for an image that no step makes.
pub(crate) fn camera_of(
    intrinsics: &Intrinsics,
    cam_from_world: &Rigid,
) -> crate::wgpu::types::Camera {
    let i = intrinsics;
    let rotation: DMat3 = cam_from_world.rotation_matrix();
    let column = |v: DVec3| [v.x as f32, v.y as f32, v.z as f32, 0.0];
    let (width, height) = (f64::from(i.width_px), f64::from(i.height_px));
    let (beyond_x, beyond_y) = (0.15 * width / i.fx, 0.15 * height / i.fy);
    let bounds = [
        -(i.cx / i.fx + beyond_x),
        -(i.cy / i.fy + beyond_y),
        (width - i.cx) / i.fx + beyond_x,
        (height - i.cy) / i.fy + beyond_y,
    ];
    crate::wgpu::types::Camera {
        rotation_x: column(rotation.x_axis),
        rotation_y: column(rotation.y_axis),
        rotation_z: column(rotation.z_axis),
        translation: column(cam_from_world.translation),
        center: column(cam_from_world.inverse().translation),
        pinhole: [i.fx, i.fy, i.cx, i.cy].map(|v| v as f32),
        slope_bounds: bounds.map(|v| v as f32),
        gain: [1.0; 4],
        ..crate::wgpu::types::Camera::default()
    }
}
