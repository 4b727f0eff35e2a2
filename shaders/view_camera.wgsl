// view_camera: a view's pose, focal factor, exposure and the shared networks -> the camera of a step.
// First stage of a step. One workgroup. Equations: docs/GRADIENTS.md, pose network.

#import step
#import camera
#import quat
#import pose_network
#import appearance

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read_write> views: array<f32>;
@group(0) @binding(2) var<storage, read> network: array<f32>;
@group(0) @binding(3) var<storage, read_write> camera: Camera;

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    let record = step.view_ix * VIEW_STRIDE;
    var shared_exposure = array<f32, 6>();
    if (step.flags & FLAG_APPEARANCE) != 0u {
        appearance_forward(record, lane);
        for (var i = 0u; i < 6u; i += 1u) {
            shared_exposure[i] = clamp(output[i], -max_abs_exposure(i), max_abs_exposure(i));
        }
    }
    network_forward(record, lane);
    if lane != 0u {
        return;
    }
    let q = record + VIEW_QUAT;
    var rotation = rotation_of(normalize(vec4<f32>(views[q], views[q + 1u], views[q + 2u], views[q + 3u])));
    let t = record + VIEW_TRANSLATION;
    var translation = vec3<f32>(views[t], views[t + 1u], views[t + 2u]);
    if (step.flags & FLAG_POSE_NETWORK) != 0u {
        // world_from_cam' = world_from_cam [R_d | scale dx], so that cam_from_world' = R_d' (cam_from_world - scale dx).
        let rows = orthonormal(increment_rows());
        let shift = step.camera_scale * vec3<f32>(output[0], output[1], output[2]);
        rotation = rows * rotation;
        translation = rows * (translation - shift);
    }
    let size_px = vec2<f32>(f32(step.width_px), f32(step.height_px));
    let p = record + VIEW_PINHOLE;
    let focal = exp(network[LOG_FOCAL]) * vec2<f32>(views[p], views[p + 1u]);
    let principal = vec2<f32>(views[p + 2u], views[p + 3u]);
    // 0.3 of half the image's slope beyond its edges, as gsplat does.
    let beyond = 0.3 * 0.5 * size_px / focal;
    camera.rotation_x = vec4<f32>(rotation[0], 0.0);
    camera.rotation_y = vec4<f32>(rotation[1], 0.0);
    camera.rotation_z = vec4<f32>(rotation[2], 0.0);
    camera.translation = vec4<f32>(translation, 0.0);
    camera.center = vec4<f32>(-(translation * rotation), 0.0);
    camera.pinhole = vec4<f32>(focal, principal);
    camera.slope_bounds = vec4<f32>(-(principal / focal + beyond), (size_px - principal) / focal + beyond);
    let e = record + VIEW_EXPOSURE;
    var exposure = shared_exposure;
    for (var i = 0u; i < 6u; i += 1u) {
        exposure[i] += views[e + i];
    }
    camera.gain = vec4<f32>(exp(vec3<f32>(exposure[0], exposure[1], exposure[2])), 0.0);
    camera.offset = vec4<f32>(exposure[3], exposure[4], exposure[5], 0.0);
    for (var i = 0u; i < 9u; i += 1u) {
        views[record + VIEW_NOW + i] = rotation[i / 3u][i % 3u];
    }
    for (var i = 0u; i < 3u; i += 1u) {
        views[record + VIEW_NOW + 9u + i] = translation[i];
    }
}
