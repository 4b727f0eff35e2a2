//! Host side of the structs in `shaders/lib/` that splats need: same names, order and padding;
//! `tests/it/shader_layouts.rs` compares them.

use bytemuck::{Pod, Zeroable};

use crate::loss_weights::LossWeights;

/// `Step` of `shaders/lib/step.wgsl`. Many fields: names of that struct, one by one, as the layout test compares them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Step {
    pub width_px: u32,
    pub height_px: u32,
    pub n_tiles_x: u32,
    pub n_tiles_y: u32,
    pub n_splats: u32,
    pub max_instances: u32,
    pub view_ix: u32,
    pub n_steps: u32,
    pub sh_degree: u32,
    pub sh_stored: u32,
    pub sh_interval: u32,
    pub flags: u32,
    pub depth_mode: u32,
    pub depth_width: u32,
    pub depth_height: u32,
    pub lr_mean: f32,
    pub lr_mean_decay: f32,
    pub lr_scale: f32,
    pub lr_quat: f32,
    pub lr_opacity: f32,
    pub lr_sh0: f32,
    pub lr_sh_rest: f32,
    pub lr_rotation: f32,
    pub lr_translation: f32,
    pub lr_pose_network: f32,
    pub lr_focal: f32,
    pub lr_exposure: f32,
    pub lr_appearance: f32,
    pub noise: f32,
    pub noise_seed: u32,
    pub ssim_weight: f32,
    pub ssim_share: f32,
    pub ssim_margin: u32,
    pub near: f32,
    pub weights: LossWeights,
    pub mask_sum: f32,
    pub confidence_sum: f32,
    pub camera_scale: f32,
    pub epipolar_rho_x: f32,
    pub epipolar_rho_y: f32,
    pub epipolar_rho_z: f32,
    pub epipolar_theta_x: f32,
    pub epipolar_theta_y: f32,
    pub epipolar_theta_z: f32,
}

/// Bits of `Step::flags`.
pub const FLAG_TRAIN_SPLATS: u32 = 1;
pub const FLAG_GRADIENTS: u32 = 2;
pub const FLAG_POSE_DIRECT: u32 = 4;
pub const FLAG_POSE_SHARED: u32 = 8;
pub const FLAG_DEPTH: u32 = 16;
pub const FLAG_POSE_NETWORK: u32 = 32;
pub const FLAG_ALL_SPLATS: u32 = 64;
pub const FLAG_SCREEN_GRADIENTS: u32 = 128;
pub const FLAG_APPEARANCE: u32 = 256;

/// `Camera` of `shaders/lib/camera.wgsl`. Many fields: names of that struct.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Camera {
    pub rotation_x: [f32; 4],
    pub rotation_y: [f32; 4],
    pub rotation_z: [f32; 4],
    pub translation: [f32; 4],
    pub center: [f32; 4],
    pub pinhole: [f32; 4],
    pub slope_bounds: [f32; 4],
    pub gain: [f32; 4],
    pub offset: [f32; 4],
    pub n_visible: u32,
    pub n_instances: u32,
    pub is_full: u32,
    pub n_wanted: u32,
    pub n_done: u32,
    pub padding_0: u32,
    pub padding_1: u32,
    pub padding_2: u32,
}

/// `Projected` of `shaders/lib/projected.wgsl`. Many fields: names of that struct.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Projected {
    pub center_px: [f32; 2],
    pub depth: f32,
    pub opacity: f32,
    pub conic_a: f32,
    pub conic_b: f32,
    pub conic_c: f32,
    pub splat_ix: u32,
    pub red: f32,
    pub green: f32,
    pub blue: f32,
    pub cut: f32,
    pub extent_px: [f32; 2],
    pub n_tiles: u32,
    pub first_instance: u32,
}

/// `Moves` of `shaders/lib/moves.wgsl`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Moves {
    pub n_splats: u32,
    pub n_added: u32,
    pub seed: u32,
    pub kind: u32,
    pub weight_bits: u32,
    pub active_steps: u32,
    pub n_steps: u32,
    pub sh_stored: u32,
    pub min_opacity: f32,
    pub by_image: u32,
    pub keeps_age: u32,
    pub padding_1: u32,
}

pub const ARGS_VISIBLE: u64 = 0;
pub const ARGS_SORT_VISIBLE: u64 = 4;
pub const ARGS_INSTANCES: u64 = 8;
pub const ARGS_SORT_INSTANCES: u64 = 12;
pub const TILE_PX: u32 = 16;

/// Places in a view's record, in f32.
pub const VIEW_QUAT: usize = 0;
pub const VIEW_TRANSLATION: usize = 4;
pub const VIEW_PINHOLE: usize = 8;
pub const VIEW_EXPOSURE: usize = 12;
pub const VIEW_POSE_M: usize = 18;
pub const VIEW_POSE_AGE: usize = 30;
pub const VIEW_EMBEDDING_AGE: usize = 56;
pub const VIEW_EMBEDDING: usize = 64;
pub const VIEW_APPEARANCE: usize = 256;
pub const VIEW_STRIDE: usize = 320;

/// Places in the buffer of the shared networks, in f32.
pub const NET_SIZE: usize = 8905;
pub const LOG_FOCAL: usize = 26716;
pub const APPEARANCE_NET: usize = 26720;
pub const NET_FLOATS: usize = 43635;
