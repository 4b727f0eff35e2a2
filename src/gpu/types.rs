//! Host side of the structs in `shaders/lib/`: same names, order and padding; `tests/it/shaders.rs` compares them.

/// `Camera` of `shaders/lib/camera.wgsl`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C)]
pub struct Camera {
    pub rotation_x: [f32; 4],
    pub rotation_y: [f32; 4],
    pub rotation_z: [f32; 4],
    pub translation: [f32; 4],
    pub pinhole: [f32; 4],
    pub width_px: u32,
    pub height_px: u32,
    pub n_splats: u32,
    pub sh_degree: u32,
}

/// `ProjectedSplat` of `shaders/lib/camera.wgsl`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C)]
pub struct ProjectedSplat {
    pub mean_px: [f32; 2],
    pub depth: f32,
    pub opacity: f32,
    pub conic: [f32; 4],
    pub colour: [f32; 4],
    pub extent_px: [f32; 2],
    pub padding: [f32; 2],
}
