// move_share: splats that were drawn -> one of several at their place, with the opacity and scale that keep the picture.
// After move_draw. One thread per splat.

#import step
#import moves

// Copies at one place that the formula is used for, as in the authors' code.
const MAX_SHARES: u32 = 51u;
// Largest opacity whose logit is finite in f32.
const MAX_OPACITY: f32 = 0.9999999;
// Nodes of the integral over a Gaussian and their distance.
const N_NODES: u32 = 36u;
const NODE_STEP: f32 = 0.125;
const SQRT_PI: f32 = 1.7724539;

@group(0) @binding(0) var<uniform> moves: Moves;
@group(0) @binding(1) var<storage, read> shares: array<u32>;
@group(0) @binding(2) var<storage, read_write> geometry: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> moments: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> sh_moments: array<u32>;

#import cleared

// 1 - (1 - alpha)^n by squaring: sums of positive terms only, so small alphas keep their digits.
fn stacked(alpha: f32, count: u32) -> f32 {
    var all = 0.0;
    var power = alpha;
    for (var n = count; n > 0u; n >>= 1u) {
        if (n & 1u) == 1u {
            all += power * (1.0 - all);
        }
        power += power * (1.0 - power);
    }
    return all;
}

// 1 - (1 - opacity)^(1/n), in f32 without the cancellation of small opacities.
fn root_of(opacity: f32, n: u32) -> f32 {
    var log_rest = log(1.0 - opacity);
    if opacity < 0.03 {
        log_rest = -opacity * (1.0 + opacity * (0.5 + opacity * (1.0 / 3.0 + opacity * 0.25)));
    }
    let x = log_rest / f32(n);
    if x > -0.05 {
        return -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0))));
    }
    return 1.0 - exp(x);
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = flat(group, groups) * 256u + lane;
    if splat_ix >= moves.n_splats || shares[splat_ix] == 0u {
        return;
    }
    let n = min(shares[splat_ix] + 1u, MAX_SHARES);
    let at = 4u * splat_ix;
    let opacity = 1.0 / (1.0 + exp(-geometry[at].w));
    let shared_opacity = min(max(root_of(opacity, n), moves.min_opacity), MAX_OPACITY);
    var sum = 0.5 * stacked(shared_opacity, n);
    for (var node = 1u; node < N_NODES; node += 1u) {
        let t = NODE_STEP * f32(node);
        sum += stacked(shared_opacity * exp(-t * t), n);
    }
    let factor = opacity / (2.0 / SQRT_PI * NODE_STEP * sum);
    geometry[at].w = log(shared_opacity / (1.0 - shared_opacity));
    let scale = geometry[at + 2u];
    geometry[at + 2u] = vec4<f32>(scale.xyz + log(factor), 0.0);
    clear_moments(splat_ix);
}
