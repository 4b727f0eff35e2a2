// What one pass over an image has to know; the host fills it. Mirrored by wgpu/types.rs of splat-engine.

#import flat

struct Step {
    width_px: u32,
    height_px: u32,
    n_tiles_x: u32,
    n_tiles_y: u32,
    n_splats: u32,
    max_instances: u32,
    view_ix: u32,
    n_steps: u32,
    // Degree that is used, bands that are stored, and updates between the first trainings of neighbouring bands.
    sh_degree: u32,
    sh_stored: u32,
    sh_interval: u32,
    // Bits of FLAG_*.
    flags: u32,
    depth_mode: u32,
    depth_width: u32,
    depth_height: u32,
    lr_mean: f32,
    lr_mean_decay: f32,
    lr_scale: f32,
    lr_quat: f32,
    lr_opacity: f32,
    lr_sh0: f32,
    lr_sh_rest: f32,
    lr_rotation: f32,
    lr_translation: f32,
    lr_pose_network: f32,
    lr_focal: f32,
    lr_exposure: f32,
    lr_appearance: f32,
    noise: f32,
    noise_seed: u32,
    ssim_weight: f32,
    // All pixels' weight over that of the pixels that SSIM is averaged over; 0: over none.
    ssim_share: f32,
    // Pixels at each edge that it leaves out.
    ssim_margin: u32,
    // Splats nearer than this are not drawn.
    near: f32,
    // Weights of the loss's terms, as loss_weights.rs of splat-engine declares them.
#import loss_weights
    // Sum of the pixels' weights, and of their depth confidences.
    mask_sum: f32,
    confidence_sum: f32,
    camera_scale: f32,
    // Weighted gradient of the matches by the pose; the host knows it.
    epipolar_rho_x: f32,
    epipolar_rho_y: f32,
    epipolar_rho_z: f32,
    epipolar_theta_x: f32,
    epipolar_theta_y: f32,
    epipolar_theta_z: f32,
}

const FLAG_TRAIN_SPLATS: u32 = 1u;
// Gradients take the place of parameters; the host binds copies.
const FLAG_GRADIENTS: u32 = 2u;
const FLAG_POSE_DIRECT: u32 = 4u;
const FLAG_POSE_SHARED: u32 = 8u;
const FLAG_DEPTH: u32 = 16u;
const FLAG_POSE_NETWORK: u32 = 32u;
// Also splats that the view does not see are moved.
const FLAG_ALL_SPLATS: u32 = 64u;
// Gradients by the projected means are added up.
const FLAG_SCREEN_GRADIENTS: u32 = 128u;
// The appearance network has begun.
const FLAG_APPEARANCE: u32 = 256u;

// On the bits: a compiler may assume that NaN never happens.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn is_finite3(v: vec3<f32>) -> bool {
    return is_finite(v.x) && is_finite(v.y) && is_finite(v.z);
}

fn is_finite4(v: vec4<f32>) -> bool {
    return is_finite3(v.xyz) && is_finite(v.w);
}
