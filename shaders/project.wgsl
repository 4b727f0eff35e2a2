// project: splats -> ellipses on the screen with colour and depth.
// First stage of a frame. One thread per splat. Equations: docs/GRADIENTS.md, "Projection".

#import camera
#import quat

const NEAR: f32 = 0.01;
// Screen blur in px^2 that keeps every splat at least about a pixel wide.
const EPS_2D: f32 = 0.3;
const MIN_ALPHA: f32 = 1.0 / 255.0;
const MAX_SIGMAS: f32 = 3.33;
// Share of the half field of view by which the linearisation point may lie outside the picture.
const CLAMP_MARGIN: f32 = 0.3;
const SH_C0: f32 = 0.28209479;

@group(0) @binding(0) var<uniform> camera: Camera;
// x, y, z, opacity_logit.
@group(0) @binding(1) var<storage, read> means: array<vec4<f32>>;
// Natural logarithm along each own axis; w unused.
@group(0) @binding(2) var<storage, read> log_scales: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> quats: array<vec4<f32>>;
// Base colour coefficients; w unused.
@group(0) @binding(4) var<storage, read> sh_base: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> projected: array<ProjectedSplat>;

fn covariance_2d(p: vec3<f32>, log_scale: vec3<f32>, quat: vec4<f32>) -> vec3<f32> {
    let f = camera.pinhole.xy;
    let c = camera.pinhole.zw;
    let size = vec2<f32>(f32(camera.width_px), f32(camera.height_px));
    let margin = CLAMP_MARGIN * 0.5 * size / f;
    let t = p.z * clamp(p.xy / p.z, -(c / f + margin), (size - c) / f + margin);
    let rotation = mat3x3<f32>(camera.rotation_x.xyz, camera.rotation_y.xyz, camera.rotation_z.xyz);
    let scale = exp(log_scale);
    let axes = rotation * rotation_of(quat);
    let m = mat3x3<f32>(axes[0] * scale.x, axes[1] * scale.y, axes[2] * scale.z);
    // Rows of the projection's Jacobian times m.
    let u = (vec3<f32>(m[0].x, m[1].x, m[2].x) - t.x / p.z * vec3<f32>(m[0].z, m[1].z, m[2].z)) * f.x / p.z;
    let v = (vec3<f32>(m[0].y, m[1].y, m[2].y) - t.y / p.z * vec3<f32>(m[0].z, m[1].z, m[2].z)) * f.y / p.z;
    return vec3<f32>(dot(u, u) + EPS_2D, dot(u, v), dot(v, v) + EPS_2D);
}

@compute @workgroup_size(256)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let splat_ix = id.x;
    if splat_ix >= camera.n_splats {
        return;
    }
    projected[splat_ix].depth = 0.0;
    let p = cam_from_map(camera, means[splat_ix].xyz);
    let opacity = 1.0 / (1.0 + exp(-means[splat_ix].w));
    // Written so that a NaN fails the test.
    if !(p.z > NEAR && opacity >= MIN_ALPHA) {
        return;
    }
    let cov = covariance_2d(p, log_scales[splat_ix].xyz, quats[splat_ix]);
    let det = cov.x * cov.z - cov.y * cov.y;
    if !(det > 0.0) {
        return;
    }
    let mean_px = camera.pinhole.xy * p.xy / p.z + camera.pinhole.zw;
    let sigmas = min(MAX_SIGMAS, sqrt(2.0 * log(255.0 * opacity)));
    let extent_px = ceil(sigmas * sqrt(vec2<f32>(cov.x, cov.z)));
    let size = vec2<f32>(f32(camera.width_px), f32(camera.height_px));
    if any(mean_px + extent_px < vec2<f32>(0.0)) || any(mean_px - extent_px > size) {
        return;
    }
    var out: ProjectedSplat;
    out.mean_px = mean_px;
    out.depth = p.z;
    out.opacity = opacity;
    out.conic = vec4<f32>(cov.z, -cov.y, cov.x, 0.0) / det;
    out.colour = max(vec4<f32>(0.5 + SH_C0 * sh_base[splat_ix].xyz, 0.0), vec4<f32>(0.0));
    out.extent_px = extent_px;
    projected[splat_ix] = out;
}
