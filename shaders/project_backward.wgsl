// project_backward: gradients of 2D Gaussians -> the visible splats' parameters after one update, and sums for the pose.
// After gather. One thread per visible splat. Regularisers and noise act here too, so that a splat is read and written
// once. Equations: docs/GRADIENTS.md, project_backward, pose and Adam.

#import step
#import shape
#import projected
#import splat_update

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read> projected: array<Projected>;
@group(0) @binding(3) var<storage, read> splat_sums: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> geometry: array<vec4<f32>>;
// First and second moments of each vec4 of `geometry`; in w of the log-scale's first, all updates of the splat, of the base
// colour's, sum and number of its screen gradients.
@group(0) @binding(5) var<storage, read_write> moments: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> sh_rest: array<f32>;
// Per splat: first moments as bf16 pairs, then one second moment per band.
@group(0) @binding(7) var<storage, read_write> sh_moments: array<u32>;
// Three per group: rho and log focal; theta and visible splats; opacity and scale for the regularisers.
@group(0) @binding(8) var<storage, read_write> pose_sums: array<vec4<f32>>;

var<workgroup> sums: array<vec4<f32>, 768>;

fn outer(a: vec3<f32>, b: vec3<f32>) -> mat3x3<f32> {
    return mat3x3<f32>(a * b.x, a * b.y, a * b.z);
}

fn quat_gradient(shape: Shape, g: mat3x3<f32>) -> vec4<f32> {
    let w = shape.quat.x;
    let x = shape.quat.y;
    let y = shape.quat.z;
    let z = shape.quat.w;
    // g[column][row].
    let curl = vec3<f32>(g[1].z - g[2].y, g[2].x - g[0].z, g[0].y - g[1].x);
    let xy = g[0].y + g[1].x;
    let xz = g[2].x + g[0].z;
    let yz = g[1].z + g[2].y;
    let unit = 2.0 * vec4<f32>(
        dot(vec3<f32>(x, y, z), curl),
        -2.0 * x * (g[1].y + g[2].z) + y * xy + z * xz + w * curl.x,
        x * xy - 2.0 * y * (g[0].x + g[2].z) + z * yz + w * curl.y,
        x * xz + y * yz - 2.0 * z * (g[0].x + g[1].y) + w * curl.z,
    );
    return (unit - dot(unit, shape.quat) * shape.quat) * shape.inverse_quat_length;
}

// Of the mean through the viewing direction.
fn direction_gradient(splat_ix: u32, direction: vec3<f32>, distance: f32, v_color: vec3<f32>) -> vec3<f32> {
    if step.sh_degree == 0u {
        return vec3<f32>(0.0);
    }
    let first = splat_ix * n_sh_rest(step.sh_stored);
    let n = n_sh_rest(step.sh_degree) / 3u;
    var by_direction = vec3<f32>(0.0);
#repeat b 15
    if $bu < n {
        let at = first + 3u * $bu;
        let worth = dot(vec3<f32>(sh_rest[at], sh_rest[at + 1u], sh_rest[at + 2u]), v_color);
        by_direction += worth * sh_basis_gradient(direction, $bu);
    }
#end
    return (by_direction - direction * dot(by_direction, direction)) / distance;
}

fn gradient_of(visible_ix: u32, splat: Projected, shape: Shape, mean: vec3<f32>) -> Gradient {
    let sum0 = splat_sums[3u * visible_ix];
    let sum1 = splat_sums[3u * visible_ix + 1u];
    let sum2 = splat_sums[3u * visible_ix + 2u];
    let conic = vec3<f32>(splat.conic_a, splat.conic_b, splat.conic_c);
    var g: Gradient;
    g.color = sum2.xyz * select(vec3<f32>(0.0), vec3<f32>(1.0), vec3<f32>(splat.red, splat.green, splat.blue) > vec3<f32>(0.0));
    g.base = SH_C0 * g.color;
    let to_splat = mean - camera.center.xyz;
    let distance = length(to_splat);
    let by_direction = direction_gradient(splat.splat_ix, to_splat / distance, distance, g.color);

    let g_center = vec2<f32>(conic.x * sum0.y + conic.y * sum0.z, conic.y * sum0.y + conic.z * sum0.z);
    g.screen = length(0.5 * vec2<f32>(f32(step.width_px), f32(step.height_px)) * g_center);
    // By the conic as a symmetric matrix, then by the covariance: -Q GQ Q.
    let gq = vec3<f32>(0.5 * sum1.x, 0.5 * sum1.y, 0.5 * sum1.z);
    let r0 = vec2<f32>(gq.x * conic.x + gq.y * conic.y, gq.x * conic.y + gq.y * conic.z);
    let r1 = vec2<f32>(gq.y * conic.x + gq.z * conic.y, gq.y * conic.y + gq.z * conic.z);
    let g00 = -(conic.x * r0.x + conic.y * r1.x);
    let g01 = -(conic.x * r0.y + conic.y * r1.y);
    let g11 = -(conic.y * r0.y + conic.z * r1.y);

    let a0 = shape.j0 * g00 + shape.j1 * g01;
    let a1 = shape.j0 * g01 + shape.j1 * g11;
    let g_cov = outer(shape.j0, a0) + outer(shape.j1, a1);
    let cov = shape.root * transpose(shape.root);
    let g_j0 = 2.0 * (cov * a0);
    let g_j1 = 2.0 * (cov * a1);

    let f = camera.pinhole.xy;
    let z = shape.in_cam.z;
    let g_diagonal = vec2<f32>(g_j0.x, g_j1.y);
    let g_slope = vec2<f32>(g_j0.z, g_j1.z);
    let g_xy = f / z * g_center - shape.free * f / (z * z) * g_slope;
    let g_z = -f * shape.in_cam.xy / (z * z) * g_center - f / (z * z) * g_diagonal
        + (1.0 + shape.free) * f * shape.slope / (z * z) * g_slope;
    let g_in_cam = vec3<f32>(g_xy, g_z.x + g_z.y + sum0.w);

    let to_cam = rotation_of_camera(camera);
    let back = transpose(to_cam);
    let scaled = mat3x3<f32>(shape.rotation[0] * shape.scale.x, shape.rotation[1] * shape.scale.y, shape.rotation[2] * shape.scale.z);
    let g_root = 2.0 * (back * g_cov * to_cam * scaled);
    let g_scale = vec3<f32>(
        dot(shape.rotation[0], g_root[0]),
        dot(shape.rotation[1], g_root[1]),
        dot(shape.rotation[2], g_root[2]),
    );
    let is_over_all = (step.flags & FLAG_ALL_SPLATS) != 0u;
    let per_splat = 1.0 / f32(select(camera.n_visible, step.n_splats, is_over_all));
    let g_opacity = -sum0.x / shape.opacity + step.opacity_reg * per_splat;
    g.mean = back * g_in_cam + by_direction;
    g.opacity_logit = g_opacity * shape.opacity * (1.0 - shape.opacity);
    g.quat = quat_gradient(shape, mat3x3<f32>(g_root[0] * shape.scale.x, g_root[1] * shape.scale.y, g_root[2] * shape.scale.z));
    g.log_scale = shape.scale * (g_scale + step.scale_reg * per_splat / 3.0);
    g.rho = g_in_cam + to_cam * by_direction;
    let twist = cov * g_cov - g_cov * cov;
    g.theta = cross(shape.in_cam, g_in_cam) + 2.0 * vec3<f32>(twist[2].y, twist[0].z, twist[1].x);
    // A held slope is a bound that moves with 1/f; the part of the principal point stays in it.
    let g_held = -(1.0 - shape.free) * f / z * g_slope;
    let by_focal = f * shape.in_cam.xy / z * g_center + f / z * g_diagonal - f / z * shape.slope * g_slope - g_held * shape.slope;
    g.log_focal = by_focal.x + by_focal.y;
    return g;
}

fn write_gradient(splat_ix: u32, direction: vec3<f32>, g: Gradient) {
    let at = 4u * splat_ix;
    geometry[at] = vec4<f32>(g.mean, g.opacity_logit);
    geometry[at + 1u] = g.quat;
    geometry[at + 2u] = vec4<f32>(g.log_scale, 0.0);
    geometry[at + 3u] = vec4<f32>(g.base, 0.0);
    var basis = sh_basis(direction);
    let stored = n_sh_rest(step.sh_stored);
    let n_trained = n_sh_rest(step.sh_degree);
    for (var k = 0u; k < stored; k += 1u) {
        sh_rest[splat_ix * stored + k] = select(0.0, basis[k / 3u] * g.color[k % 3u], k < n_trained);
    }
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = flat(group, groups);
    let visible_ix = block * 256u + lane;
    var sum0 = vec4<f32>(0.0);
    var sum1 = vec4<f32>(0.0);
    var sum2 = vec4<f32>(0.0);
    if visible_ix < camera.n_visible && projected[visible_ix].opacity > 0.0 {
        let splat = projected[visible_ix];
        let at = 4u * splat.splat_ix;
        let mean = geometry[at];
        let size_px = vec2<f32>(f32(step.width_px), f32(step.height_px));
        let shape = shape_of(camera, mean, geometry[at + 1u], geometry[at + 2u].xyz, size_px);
        let direction = normalize(mean.xyz - camera.center.xyz);
        let g = gradient_of(visible_ix, splat, shape, mean.xyz);
        sum2 = vec4<f32>(shape.opacity, shape.scale.x + shape.scale.y + shape.scale.z, 1.0, 0.0);
        let is_sound = is_finite4(vec4<f32>(g.mean, g.opacity_logit)) && is_finite4(g.quat)
            && is_finite3(g.log_scale) && is_finite3(g.color);
        if is_sound {
            sum0 = vec4<f32>(g.rho, g.log_focal);
            sum1 = vec4<f32>(g.theta, 0.0);
            if (step.flags & FLAG_GRADIENTS) != 0u {
                write_gradient(splat.splat_ix, direction, g);
            } else if (step.flags & FLAG_TRAIN_SPLATS) != 0u {
                update_splat(splat.splat_ix, direction, g);
            }
        }
    }
    sums[lane] = sum0;
    sums[256u + lane] = sum1;
    sums[512u + lane] = sum2;
    workgroupBarrier();
    // Sixteen at a time, then the sixteens.
    var part_sum = vec4<f32>(0.0);
    if lane < 48u {
        for (var other = 16u * lane; other < 16u * (lane + 1u); other += 1u) {
            part_sum += sums[other];
        }
    }
    workgroupBarrier();
    if lane < 48u {
        sums[lane] = part_sum;
    }
    workgroupBarrier();
    if lane < 3u && block * 256u < camera.n_visible {
        var total = vec4<f32>(0.0);
        for (var part = 16u * lane; part < 16u * (lane + 1u); part += 1u) {
            total += sums[part];
        }
        pose_sums[3u * block + lane] = total;
    }
}
