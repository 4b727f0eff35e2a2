// update_view: sums over splats and pixels -> the view's pose and exposure, the shared networks and the focal factor after
// one update, and the statistics of the step.
// Last stage of a step. One workgroup of 64 threads. Equations: docs/GRADIENTS.md, pose, pose network and Adam.

#import step
#import camera
#import quat
#import adam
#import pose_network
#import appearance
#import mlp_update

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read> pose_sums: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> loss_sums: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> ssim_sums: array<f32>;
@group(0) @binding(5) var<storage, read_write> views: array<f32>;
@group(0) @binding(6) var<storage, read_write> network: array<f32>;
// Sums of loss, L1 and SSIM over steps, and their number; then the gradients of the last step.
@group(0) @binding(7) var<storage, read_write> stats: array<f32>;

// Share of itself, times the rate, that each number of the exposure loses in an update: without it, all views and all
// splats could grow brighter together.
const EXPOSURE_PULL: f32 = 0.1;
// Embeddings of the appearance network move so many times as fast as the network; its weight decay.
const APPEARANCE_EMBEDDING_RATE: f32 = 10.0;
const APPEARANCE_DECAY: f32 = 1e-6;
const STATS_GRADIENTS: u32 = 8u;

var<workgroup> partial: array<vec4<f32>, 448>;
var<workgroup> totals: array<vec4<f32>, 7>;

fn add_up(lane: u32) {
    let n_pose = (camera.n_visible + 255u) / 256u;
    var sums: array<vec4<f32>, 7>;
    for (var group = lane; group < n_pose; group += 64u) {
        sums[0] += pose_sums[3u * group];
        sums[1] += pose_sums[3u * group + 1u];
        sums[2] += pose_sums[3u * group + 2u];
    }
    let columns = step.width_px * ((step.height_px + 3u) / 4u);
    let n_loss = (columns + 63u) / 64u;
    for (var group = lane; group < n_loss; group += 64u) {
        sums[3] += loss_sums[3u * group];
        sums[4] += loss_sums[3u * group + 1u];
        sums[5] += loss_sums[3u * group + 2u];
        sums[6].x += ssim_sums[group];
    }
    for (var k = 0u; k < 7u; k += 1u) {
        partial[k * 64u + lane] = sums[k];
    }
    workgroupBarrier();
    if lane < 7u {
        var total = vec4<f32>(0.0);
        for (var other = 0u; other < 64u; other += 1u) {
            total += partial[lane * 64u + other];
        }
        totals[lane] = total;
    }
    workgroupBarrier();
}

fn note_stats() {
    let mask = 3.0 * step.mask_sum;
    let ssim = select(1.0, step.ssim_share * totals[6].x / mask, mask > 0.0 && step.ssim_share > 0.0);
    let n = max(totals[2].z, 1.0);
    let regulariser = step.opacity_reg * totals[2].x / n + step.scale_reg * totals[2].y / (3.0 * n);
    let loss = (1.0 - step.ssim_weight) * totals[3].x + step.ssim_weight * (1.0 - ssim)
        + step.depth_weight * totals[3].y + totals[3].z + regulariser;
    stats[0] += 1.0;
    stats[1] += loss;
    stats[2] += totals[3].x;
    stats[3] += ssim;
    stats[4] = totals[3].y;
    stats[5] = loss;
    for (var i = 0u; i < 4u; i += 1u) {
        stats[STATS_GRADIENTS + i] = totals[0][i];
        stats[STATS_GRADIENTS + 4u + i] = totals[1][i];
        stats[STATS_GRADIENTS + 8u + i] = totals[4][i];
        stats[STATS_GRADIENTS + 12u + i] = totals[5][i];
    }
}

// exp([rho; theta]) cam_from_world, with Adam on (rho, theta).
fn move_directly(record: u32) {
    let age = u32(views[record + VIEW_POSE_AGE]) + 1u;
    views[record + VIEW_POSE_AGE] = f32(age);
    let correction = corrections(age);
    var delta: array<f32, 6>;
    for (var i = 0u; i < 6u; i += 1u) {
        let g = select(totals[1][i % 3u], totals[0][i % 3u], i < 3u);
        let m = BETA_1 * views[record + VIEW_POSE_M + i] + (1.0 - BETA_1) * g;
        let v = BETA_2 * views[record + VIEW_POSE_V + i] + (1.0 - BETA_2) * g * g;
        views[record + VIEW_POSE_M + i] = m;
        views[record + VIEW_POSE_V + i] = v;
        let rate = select(step.lr_rotation, step.lr_translation, i < 3u);
        delta[i] = -rate * adam_direction(m, v, correction, VIEW_EPS);
    }
    var rho = vec3<f32>(delta[0], delta[1], delta[2]);
    var theta = vec3<f32>(delta[3], delta[4], delta[5]);
    if (step.flags & FLAG_POSE_NETWORK) != 0u {
        // The record holds the pose before the network: the same increment seen from there.
        let motion = transpose(orthonormal(increment_rows()));
        let shift = step.camera_scale * vec3<f32>(output[0], output[1], output[2]);
        theta = motion * theta;
        rho = motion * rho + cross(shift, theta);
    }
    // Series of the exponential to the fourth power of an angle that is a small fraction of a radian.
    let squared = dot(theta, theta);
    let increment = normalize(vec4<f32>(1.0 - squared / 8.0 + squared * squared / 384.0, theta * (0.5 - squared / 48.0)));
    let turn = quat_product(
        increment,
        vec4<f32>(views[record], views[record + 1u], views[record + 2u], views[record + 3u]),
    );
    let once = cross(theta, rho);
    let shift = rho + (0.5 - squared / 24.0) * once + (1.0 / 6.0 - squared / 120.0) * cross(theta, once);
    let t = record + VIEW_TRANSLATION;
    let rotated = rotation_of(increment) * vec3<f32>(views[t], views[t + 1u], views[t + 2u]);
    let unit = normalize(turn);
    for (var i = 0u; i < 4u; i += 1u) {
        views[record + VIEW_QUAT + i] = unit[i];
    }
    for (var i = 0u; i < 3u; i += 1u) {
        views[t + i] = rotated[i] + shift[i];
    }
}

fn update_exposure(record: u32) {
    let age = u32(views[record + VIEW_EXPOSURE_AGE]) + 1u;
    views[record + VIEW_EXPOSURE_AGE] = f32(age);
    let correction = corrections(age);
    for (var i = 0u; i < 6u; i += 1u) {
        let value = views[record + VIEW_EXPOSURE + i];
        let g = select(totals[5][i % 3u], totals[4][i % 3u], i < 3u);
        let m = BETA_1 * views[record + VIEW_EXPOSURE_M + i] + (1.0 - BETA_1) * g;
        let v = BETA_2 * views[record + VIEW_EXPOSURE_V + i] + (1.0 - BETA_2) * g * g;
        views[record + VIEW_EXPOSURE_M + i] = m;
        views[record + VIEW_EXPOSURE_V + i] = v;
        let moved = value - step.lr_exposure * (adam_direction(m, v, correction, VIEW_EPS) + EXPOSURE_PULL * value);
        let bound = max_abs_exposure(i);
        views[record + VIEW_EXPOSURE + i] = clamp(moved, -bound, bound);
    }
}

fn update_focal() {
    let age = u32(network[LOG_FOCAL_AGE]) + 1u;
    network[LOG_FOCAL_AGE] = f32(age);
    let g = totals[0].w;
    let m = BETA_1 * network[LOG_FOCAL_M] + (1.0 - BETA_1) * g;
    let v = BETA_2 * network[LOG_FOCAL_V] + (1.0 - BETA_2) * g * g;
    network[LOG_FOCAL_M] = m;
    network[LOG_FOCAL_V] = v;
    network[LOG_FOCAL] -= step.lr_focal * adam_direction(m, v, corrections(age), VIEW_EPS);
}

// Gradient of the pose increment -> of the network's nine outputs.
fn differentiate_increment() {
    let a = increment_rows();
    let b = orthonormal(a);
    // Of the increment on the right of world_from_cam: the negative of the one on the left of cam_from_world.
    let e_r = -totals[0].xyz;
    let e_t = -totals[1].xyz;
    let rotation = transpose(b);
    let g_dx = step.camera_scale * (rotation * e_r);
    let skew = mat3x3<f32>(vec3<f32>(0.0, e_t.z, -e_t.y), vec3<f32>(-e_t.z, 0.0, e_t.x), vec3<f32>(e_t.y, -e_t.x, 0.0));
    let rows = transpose(0.5 * (rotation * skew));
    var h1 = rows[0] + cross(b[1], rows[2]);
    let h2 = rows[1] + cross(rows[2], b[0]);
    let n2 = length(a[1] - dot(b[0], a[1]) * b[0]);
    let u2 = (h2 - dot(h2, b[1]) * b[1]) / n2;
    let g_a2 = u2 - dot(u2, b[0]) * b[0];
    h1 -= dot(u2, b[0]) * a[1] + dot(b[0], a[1]) * u2;
    let g_a1 = (h1 - dot(h1, b[0]) * b[0]) / length(a[0]);
    for (var i = 0u; i < 3u; i += 1u) {
        g_output[i] = g_dx[i];
        g_output[3u + i] = g_a1[i];
        g_output[6u + i] = g_a2[i];
    }
}

fn update_network(record: u32, lane: u32) {
    if lane == 0u {
        differentiate_increment();
    }
    let age = u32(network[NET_AGE]) + 1u;
    let embedding_age = u32(views[record + VIEW_EMBEDDING_AGE]) + 1u;
    let rate = step.lr_pose_network;
    let g = mlp_update(0u, N_WIDTH, 9u, MlpRates(age, rate, 0.0), lane);
    let at = record + lane;
    update_embedding(
        at + VIEW_EMBEDDING, at + VIEW_EMBEDDING_M, at + VIEW_EMBEDDING_V, g, MlpRates(embedding_age, rate, 0.0),
    );
    if lane == 0u {
        network[NET_AGE] = f32(age);
        views[record + VIEW_EMBEDDING_AGE] = f32(embedding_age);
    }
}

fn update_appearance(record: u32, lane: u32) {
    appearance_forward(record, lane);
    if lane < 6u {
        let g = select(totals[5][lane % 3u], totals[4][lane % 3u], lane < 3u);
        g_output[lane] = select(g, 0.0, abs(output[lane]) > max_abs_exposure(lane));
    }
    let age = u32(network[APPEARANCE_NET_AGE]) + 1u;
    let embedding_age = u32(views[record + VIEW_APPEARANCE_AGE]) + 1u;
    let rate = step.lr_appearance;
    let g = mlp_update(APPEARANCE_NET, N_APPEARANCE, 6u, MlpRates(age, rate, APPEARANCE_DECAY), lane);
    if lane < N_APPEARANCE {
        let at = record + lane;
        let rates = MlpRates(embedding_age, APPEARANCE_EMBEDDING_RATE * rate, APPEARANCE_DECAY);
        update_embedding(at + VIEW_APPEARANCE, at + VIEW_APPEARANCE_M, at + VIEW_APPEARANCE_V, g, rates);
    }
    if lane == 0u {
        network[APPEARANCE_NET_AGE] = f32(age);
        views[record + VIEW_APPEARANCE_AGE] = f32(embedding_age);
    }
}

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    add_up(lane);
    if camera.is_full != 0u {
        return;
    }
    if lane == 0u {
        note_stats();
        totals[0] += vec4<f32>(step.epipolar_rho_x, step.epipolar_rho_y, step.epipolar_rho_z, 0.0);
        totals[1] += vec4<f32>(step.epipolar_theta_x, step.epipolar_theta_y, step.epipolar_theta_z, 0.0);
    }
    workgroupBarrier();
    let is_sound = is_finite4(totals[0]) && is_finite4(totals[1]);
    if camera.n_visible == 0u || !is_sound || (step.flags & FLAG_GRADIENTS) != 0u {
        return;
    }
    let record = step.view_ix * VIEW_STRIDE;
    network_forward(record, lane);
    if lane == 0u {
        if (step.flags & FLAG_POSE_DIRECT) != 0u {
            move_directly(record);
        }
        if step.lr_exposure > 0.0 && is_finite4(totals[4]) && is_finite4(totals[5]) {
            update_exposure(record);
        }
        if step.lr_focal > 0.0 {
            update_focal();
        }
    }
    if (step.flags & FLAG_POSE_SHARED) != 0u && (step.flags & FLAG_POSE_NETWORK) != 0u {
        update_network(record, lane);
    }
    if step.lr_appearance > 0.0 && is_finite4(totals[4]) && is_finite4(totals[5]) {
        update_appearance(record, lane);
    }
}
