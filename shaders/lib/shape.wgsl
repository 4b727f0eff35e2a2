// A splat in front of a camera: what `cull`, `project` and `project_backward` have to agree on.
// Four vec4 a splat: mean and opacity logit; quaternion; log-scale and age; base colour and the step that saw it last.

#import camera
#import quat

const NEAR: f32 = 0.01;
// Screen blur in px^2 that keeps every splat at least about half a pixel wide (Kerbl et al. 2023).
const EPS_2D: f32 = 0.3;
// Below this a splat moves no 8-bit pixel value.
const MIN_ALPHA: f32 = 1.0 / 255.0;
// At this many standard deviations even an opaque splat is below MIN_ALPHA.
const MAX_SIGMAS: f32 = 3.33;
// Squares of pixel coordinates beyond this lose their meaning in f32.
const MAX_CENTER_PX: f32 = 1e9;
const TILE_PX: u32 = 16u;
// Numbers this small are what is left of an underflow: no direction.
const MIN_QUAT: f32 = 1e-30;

struct Shape {
    is_seen: bool,
    in_cam: vec3<f32>,
    opacity: f32,
    scale: vec3<f32>,
    // Own axes in the map.
    rotation: mat3x3<f32>,
    quat: vec4<f32>,
    // 0 for a quaternion without direction.
    inverse_quat_length: f32,
    // R Rot diag(s): the covariance in the camera is this times its transpose.
    root: mat3x3<f32>,
    // Rows of the projection's Jacobian.
    j0: vec3<f32>,
    j1: vec3<f32>,
    slope: vec2<f32>,
    // 1 where the slope is free, 0 where it is held at its bound.
    free: vec2<f32>,
    // Upper triangle of the 2D covariance, blur included, and its determinant.
    cov: vec3<f32>,
    det: f32,
    center_px: vec2<f32>,
    // ln(opacity / MIN_ALPHA): exponents above it are invisible.
    cut: f32,
    // Half sides of the box outside which the splat is invisible.
    extent_px: vec2<f32>,
}

fn in_camera(camera: Camera, mean: vec3<f32>) -> vec3<f32> {
    return rotation_of_camera(camera) * mean + camera.translation.xyz;
}

fn shape_of(camera: Camera, mean: vec4<f32>, quat: vec4<f32>, log_scale: vec3<f32>, size_px: vec2<f32>) -> Shape {
    var s: Shape;
    s.is_seen = false;
    let to_cam = rotation_of_camera(camera);
    s.in_cam = in_camera(camera, mean.xyz);
    s.opacity = 1.0 / (1.0 + exp(-mean.w));
    s.scale = exp(log_scale);
    let z = s.in_cam.z;
    let is_usable = is_finite3(s.in_cam) && z > NEAR && is_finite(s.opacity) && s.opacity >= MIN_ALPHA
        && is_finite3(s.scale) && is_finite4(quat);
    if !is_usable {
        return s;
    }
    s.quat = vec4<f32>(1.0, 0.0, 0.0, 0.0);
    s.inverse_quat_length = 0.0;
    // By the largest part first: squares of small and large numbers leave the range of f32.
    let largest = max(max(abs(quat.x), abs(quat.y)), max(abs(quat.z), abs(quat.w)));
    if largest > MIN_QUAT {
        let scaled = quat / largest;
        s.quat = normalize(scaled);
        s.inverse_quat_length = 1.0 / (largest * length(scaled));
    }
    s.rotation = rotation_of(s.quat);
    let axes = to_cam * s.rotation;
    s.root = mat3x3<f32>(axes[0] * s.scale.x, axes[1] * s.scale.y, axes[2] * s.scale.z);
    let f = camera.pinhole.xy;
    let slope = s.in_cam.xy / z;
    s.slope = clamp(slope, camera.slope_bounds.xy, camera.slope_bounds.zw);
    s.free = select(vec2<f32>(0.0), vec2<f32>(1.0), s.slope == slope);
    s.j0 = vec3<f32>(f.x / z, 0.0, -f.x * s.slope.x / z);
    s.j1 = vec3<f32>(0.0, f.y / z, -f.y * s.slope.y / z);
    let u = s.j0 * s.root;
    let v = s.j1 * s.root;
    let plain = vec3<f32>(dot(u, u), dot(u, v), dot(v, v));
    s.cov = plain + vec3<f32>(EPS_2D, 0.0, EPS_2D);
    // |u x v|^2 is the product less the square without the cancellation.
    let across = cross(u, v);
    s.det = dot(across, across) + EPS_2D * (plain.x + plain.z + EPS_2D);
    s.center_px = f * slope + camera.pinhole.zw;
    s.cut = max(log(s.opacity / MIN_ALPHA), 0.0);
    s.extent_px = ceil(min(sqrt(2.0 * s.cut), MAX_SIGMAS) * sqrt(s.cov.xz));
    let low = s.center_px - s.extent_px;
    let high = s.center_px + s.extent_px;
    s.is_seen = is_finite(s.det) && is_finite(s.cov.x + s.cov.z)
        && all(abs(s.center_px) < vec2<f32>(MAX_CENTER_PX))
        && all(high > vec2<f32>(0.0)) && all(low < size_px);
    return s;
}

// Half-open rectangle of tiles that the box touches: x0, y0, x1, y1.
fn tiles_of(center_px: vec2<f32>, extent_px: vec2<f32>, size_px: vec2<f32>) -> vec4<u32> {
    let low = max(center_px - extent_px, vec2<f32>(0.0));
    let high = min(center_px + extent_px, size_px);
    let first = vec2<u32>(floor(low / f32(TILE_PX)));
    let last = vec2<u32>(ceil(high / f32(TILE_PX)));
    return vec4<u32>(first, last);
}
