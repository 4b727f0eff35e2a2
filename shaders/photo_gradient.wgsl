// photo_gradient: rendering, photo, depth and the maps of SSIM -> gradient at every pixel, and sums of the losses.
// After ssim_back. One thread per 4 pixels of a column. Equations: docs/GRADIENTS.md, loss.

#import step
#import camera
#import ssim
#import depth_map

// Relative error of inverse depth at which the depth loss turns from square to linear.
const HUBER_DELTA: f32 = 0.05;
const MIN_WEIGHT_SUM: f32 = 1e-6;

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> depth_sum: array<f32>;
// Photo as r, g, b, weight bytes; behind it depth and confidence as bits of f32, both 0 where there is none.
@group(0) @binding(4) var<storage, read> wanted: array<u32>;
@group(0) @binding(5) var<storage, read> maps: array<vec4<f32>>;
// By r, g, b and the depth sum.
@group(0) @binding(6) var<storage, read_write> v_image: array<vec4<f32>>;
// What lies behind the first splat, seen through the gradient, less the transmittance's part.
@group(0) @binding(7) var<storage, read_write> behind: array<f32>;
// Three per group: L1 and depth loss before their weights, further terms with theirs; gradient of log gain; gradient of offset.
@group(0) @binding(8) var<storage, read_write> loss_sums: array<vec4<f32>>;

var<workgroup> sums: array<vec4<f32>, 192>;

struct Depth {
    loss: f32,
    v_depth: f32,
}

fn depth_loss(x: u32, y: u32, alpha: f32, z: f32, weight: f32) -> Depth {
    let given = depth_and_confidence(x, y);
    let depth = given.x;
    let confidence = given.y * weight;
    if confidence <= 0.0 || alpha <= MIN_ALPHA_FOR_DEPTH {
        return Depth(0.0, 0.0);
    }
    let error = depth / z - 1.0;
    let is_square = abs(error) <= HUBER_DELTA;
    let huber = select(abs(error) - 0.5 * HUBER_DELTA, 0.5 * error * error / HUBER_DELTA, is_square);
    let slope = select(sign(error), error / HUBER_DELTA, is_square);
    let scale = confidence / max(step.confidence_sum, MIN_WEIGHT_SUM);
    return Depth(scale * huber, -step.depth_weight * scale * slope * depth / (z * z));
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let run = run_of_column(flat(group, groups) * 64u + lane);
    let x = run.x;
    let first = i32(run.y);
    let start = x;
    let stride = step.width_px;
    let n_along = i32(step.height_px);
    let plane = step.width_px * step.height_px;
    let has_depth = (step.flags & FLAG_DEPTH) != 0u;
    let per_weight = 1.0 / max(3.0 * step.mask_sum, MIN_WEIGHT_SUM);
    let ssim_weight = step.ssim_weight * step.ssim_share;
    var losses = vec4<f32>(0.0);
    var by_gain = vec3<f32>(0.0);
    var by_offset = vec3<f32>(0.0);
#import ssim_maps_load
#repeat j 4
    if first + $j < n_along {
#import ssim_maps_blur
        let y = u32(first + $j);
        let at = y * step.width_px + x;
        let light = image[at];
        let photo = unpack4x8unorm(wanted[at]);
        let seen = camera.gain.xyz * light.xyz;
        let compared = seen + camera.offset.xyz;
        let difference = compared - photo.xyz;
        let by_ssim = p + 2.0 * compared * q + photo.xyz * r;
        let v = per_weight * ((1.0 - step.ssim_weight) * photo.w * sign(difference) - ssim_weight * by_ssim);
        losses.x += photo.w * dot(abs(difference), vec3<f32>(1.0)) * per_weight;
        by_gain += v * seen;
        by_offset += v;
        let v_rgb = v * camera.gain.xyz;
        var v_z = 0.0;
        var v_alpha = 0.0;
        let alpha = 1.0 - light.w;
        let z_sum = depth_sum[at];
        if has_depth && alpha > 0.0 {
            let z = z_sum / alpha;
            let depth = depth_loss(x, y, alpha, z, photo.w);
            losses.y += depth.loss;
            v_z = depth.v_depth / alpha;
            v_alpha = -v_z * z;
        }
        v_image[at] = vec4<f32>(v_rgb, v_z);
        behind[at] = dot(light.xyz, v_rgb) + z_sum * v_z - light.w * v_alpha;
    }
#end
    sums[lane] = losses;
    sums[64u + lane] = vec4<f32>(by_gain, 0.0);
    sums[128u + lane] = vec4<f32>(by_offset, 0.0);
    workgroupBarrier();
    if lane < 3u {
        var total = vec4<f32>(0.0);
        for (var other = 0u; other < 64u; other += 1u) {
            total += sums[64u * lane + other];
        }
        loss_sums[3u * flat(group, groups) + lane] = total;
    }
}
