//! Steps on their way: what is submitted, what had room, what is made again; and what a step's uniform holds.

use crate::epipolar::{self, Eye};
use crate::settings::{DepthMode, PoseMode, StepSettings};
use crate::view::SSIM_REACH;
use crate::wgpu::engine::WgpuEngine;
use crate::wgpu::passes;
use crate::wgpu::types::{
    Camera, FLAG_ALL_SPLATS, FLAG_APPEARANCE, FLAG_DEPTH, FLAG_POSE_DIRECT, FLAG_POSE_NETWORK,
    FLAG_POSE_SHARED, FLAG_SCREEN_GRADIENTS, FLAG_TRAIN_SPLATS, Step, TILE_PX,
};
use splat_gpu::commands::Commands;
use splat_gpu::error::GpuError;

/// Steps between looks at whether there was room.
const LOOK_EVERY: usize = 16;
/// Room that is made beyond what was wanted: neighbouring views want about the same.
const SPARE_ROOM: f64 = 1.25;

impl WgpuEngine {
    /// Waits for the steps that were submitted, makes room where they had none, and makes those again.
    /// Fails once the device is lost.
    pub(crate) fn confirm(&mut self) -> Result<(), GpuError> {
        self.gpu.check()?;
        while !self.unconfirmed.is_empty() {
            let camera = self.look()?;
            if camera.is_full == 0 {
                self.unconfirmed.clear();
            } else {
                // Before anything else: where there is no memory, these steps are still to be made.
                self.make_room(&camera)?;
                self.unconfirmed.drain(..camera.n_done as usize);
            }
            self.reset_counts(camera);
            for (view_ix, settings, number) in self.unconfirmed.clone() {
                self.submit(view_ix, &settings, number)?;
            }
        }
        Ok(())
    }

    pub(crate) fn look(&self) -> Result<Camera, GpuError> {
        let cameras: Vec<Camera> = self.gpu.read(&self.frame.camera, 0..1)?;
        Ok(cameras.first().copied().unwrap_or_default())
    }

    pub(crate) fn make_room(&mut self, camera: &Camera) -> Result<(), GpuError> {
        let n = (f64::from(camera.n_wanted) * SPARE_ROOM) as usize;
        tracing::debug!("room for {n} instances of splats in tiles");
        self.frame.grow_instances(&self.gpu, n)
    }

    pub(crate) fn reset_counts(&self, camera: Camera) {
        let reset = Camera {
            is_full: 0,
            n_done: 0,
            ..camera
        };
        self.gpu.write(&self.frame.camera, 0, &[reset]);
    }

    fn submit(
        &mut self,
        view_ix: usize,
        settings: &StepSettings,
        number: u32,
    ) -> Result<(), GpuError> {
        let view = &self.views.all[view_ix];
        let image = &view.training.image;
        let size = [image.width_px, image.height_px];
        self.frame.fit(&self.gpu, self.memory.n, size)?;
        if settings.lr_appearance > 0.0 {
            self.views.start_appearance(&self.gpu);
        }
        let view = &self.views.all[view_ix];
        let mut step = self.step_of(view_ix, settings, number);
        self.add_epipolar(view_ix, settings, &mut step)?;
        self.write_step(&step);
        let mut commands = Commands::new(&self.gpu);
        passes::camera(&mut commands, &self.frame, &self.views)?;
        passes::forward(&mut commands, &mut self.frame, &self.memory, &step)?;
        let updated = [&self.memory.geometry, &self.memory.sh_rest];
        passes::backward(
            &mut commands,
            &self.frame,
            updated,
            &self.memory,
            &view.wanted,
            &step,
        )?;
        passes::update_view(&mut commands, &self.frame, &self.views)?;
        commands.submit();
        Ok(())
    }

    /// The matches' gradient at the poses as they are: only then does a step wait for the ones before.
    fn add_epipolar(
        &self,
        view_ix: usize,
        settings: &StepSettings,
        step: &mut Step,
    ) -> Result<(), GpuError> {
        let matches = &self.views.all[view_ix].matches;
        if settings.epipolar_weight <= 0.0 || matches.is_empty() || settings.pose == PoseMode::Held
        {
            return Ok(());
        }
        let poses = self.views.poses(&self.gpu)?;
        let factor = self.views.focal_factor(&self.gpu)?;
        let eye = |ix: usize| {
            Some(Eye {
                intrinsics: self
                    .views
                    .all
                    .get(ix)?
                    .training
                    .intrinsics
                    .refocused(factor),
                cam_from_world: *poses.get(ix)?,
            })
        };
        let Some(own) = eye(view_ix) else {
            return Ok(());
        };
        let (_, gradient) = epipolar::epipolar(&own, matches, |ix| eye(ix as usize));
        let weighted = gradient.map(|g| (f64::from(settings.epipolar_weight) * g) as f32);
        [
            step.epipolar_rho_x,
            step.epipolar_rho_y,
            step.epipolar_rho_z,
            step.epipolar_theta_x,
            step.epipolar_theta_y,
            step.epipolar_theta_z,
        ] = weighted;
        Ok(())
    }

    pub(crate) fn write_step(&self, step: &Step) {
        self.gpu.write(&self.frame.step, 0, &[*step]);
        let n_blocks = step.n_splats.div_ceil(256);
        self.gpu.write(&self.frame.n_splat_blocks, 0, &[n_blocks]);
    }

    pub(crate) fn step_of(&self, view_ix: usize, settings: &StepSettings, number: u32) -> Step {
        let view = &self.views.all[view_ix];
        let s = settings;
        let [depth_width, depth_height] = view.depth_size();
        let image = &view.training.image;
        let has_depth = depth_width > 0
            && s.weights.depth_weight > 0.0
            && s.depth_mode == DepthMode::InverseDepth;
        let flag = |is_set: bool, flag: u32| if is_set { flag } else { 0 };
        let flags = flag(s.train_splats, FLAG_TRAIN_SPLATS)
            | flag(s.moves_alone(), FLAG_POSE_DIRECT)
            | flag(s.pose == PoseMode::Shared, FLAG_POSE_SHARED)
            | flag(has_depth, FLAG_DEPTH)
            | flag(s.accumulate_screen_gradients, FLAG_SCREEN_GRADIENTS)
            | flag(self.views.pose_network.is_some(), FLAG_POSE_NETWORK)
            | flag(self.views.has_appearance, FLAG_APPEARANCE)
            | flag(s.train_splats && s.all_splats, FLAG_ALL_SPLATS);
        Step {
            view_ix: view_ix as u32,
            n_steps: number,
            sh_interval: s.sh_interval,
            flags,
            depth_mode: match s.depth_mode {
                DepthMode::InverseDepth => 0,
                DepthMode::PaperCode => 1,
                DepthMode::PaperAlpha => 2,
            },
            depth_width,
            depth_height,
            lr_mean: s.lr_mean,
            lr_mean_decay: s.lr_mean_decay,
            lr_scale: s.lr_scale,
            lr_quat: s.lr_quat,
            lr_opacity: s.lr_opacity,
            lr_sh0: s.lr_sh0,
            lr_sh_rest: s.lr_sh_rest,
            lr_rotation: s.lr_pose_rotation,
            lr_translation: s.lr_pose_translation,
            lr_pose_network: s.lr_pose_network,
            lr_focal: s.lr_focal,
            lr_exposure: s.lr_exposure,
            lr_appearance: s.lr_appearance,
            noise: s.noise,
            noise_seed: s.noise_seed,
            ssim_weight: s.ssim_weight,
            ssim_share: if s.ssim_valid { view.valid_share } else { 1.0 },
            ssim_margin: if s.ssim_valid { SSIM_REACH } else { 0 },
            weights: s.weights,
            mask_sum: view.mask_sum,
            confidence_sum: view.confidence_sum,
            camera_scale: self.views.pose_network.map_or(0.0, |r| r.camera_scale),
            ..self.image_of([image.width_px, image.height_px], s.sh_degree)
        }
    }

    /// What an image needs, training or not.
    pub(crate) fn image_of(&self, [width_px, height_px]: [u32; 2], sh_degree: u8) -> Step {
        Step {
            width_px,
            height_px,
            n_tiles_x: width_px.div_ceil(TILE_PX),
            n_tiles_y: height_px.div_ceil(TILE_PX),
            n_splats: self.memory.n as u32,
            max_instances: self.frame.room.n_instances as u32,
            sh_degree: u32::from(sh_degree.min(self.memory.sh_degree)),
            sh_stored: u32::from(self.memory.sh_degree),
            near: self.near,
            ..Step::default()
        }
    }

    pub(crate) fn try_step(
        &mut self,
        view_ix: usize,
        settings: &StepSettings,
    ) -> Result<(), GpuError> {
        let number = self
            .n_trained
            .wrapping_add(u32::from(settings.train_splats));
        self.submit(view_ix, settings, number)?;
        self.n_trained = number;
        self.unconfirmed
            .push_back((view_ix, settings.clone(), number));
        if self.unconfirmed.len() >= LOOK_EVERY {
            self.confirm()?;
        }
        Ok(())
    }
}
