//! Host side of the structs in `shaders/lib/sweep.wgsl`: same names, order and padding; `tests/it/shader_layouts.rs`
//! compares them.

use bytemuck::{Pod, Zeroable};

/// `Sweep` of `shaders/lib/sweep.wgsl`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Sweep {
    pub width_px: u32,
    pub height_px: u32,
    pub n_planes: u32,
    pub n_words: u32,
    pub n_sources: u32,
    pub small_step: u32,
    pub noise_variance: f32,
    pub unseen_zncc: f32,
    pub own_share: f32,
    pub most_off: f32,
    pub padding_0: u32,
    pub padding_1: u32,
}

/// `Warp` of `shaders/lib/sweep.wgsl`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Warp {
    pub step_x: [f32; 4],
    pub step_y: [f32; 4],
    pub width_px: u32,
    pub height_px: u32,
    pub first: u32,
    pub shown: u32,
}

/// `Dip` of `shaders/lib/sweep.wgsl`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Dip {
    pub plane: u32,
    pub cost: u32,
    pub before_at: u32,
    pub after_second: u32,
}

pub const SWEEP_WINDOW: u32 = 5;
pub const SWEEP_TILE_X: u32 = 32;
pub const SWEEP_TILE_Y: u32 = 16;
pub const MAX_SWEEP_PLANES: u32 = 512;
