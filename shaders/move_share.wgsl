// move_share: splats that were drawn -> one of several at their place, with the opacity and scale that keep the image.
// After move_draw. One thread per splat.

#import step
#import moves

// Copies at one place that the formula is used for, as in the authors' code.
const MAX_SHARES: u32 = 51u;
// Largest opacity whose logit is finite in f32.
const MAX_OPACITY: f32 = 0.9999999;
// Halvings of the bracket around an opacity.
const N_HALVINGS: u32 = 24u;
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

fn held(opacity: f32) -> f32 {
    return min(max(opacity, moves.min_opacity), MAX_OPACITY);
}

// Sums over the image of the alpha of n copies together, and of its square.
fn sums_of_copies(opacity: f32, n: u32) -> vec2<f32> {
    var all_alpha = 0.0;
    var first = 0.0;
    var all = 0.0;
    for (var k = 1u; k <= 2u * n; k += 1u) {
        all_alpha += (1.0 - all_alpha) * opacity;
        all += all_alpha / f32(k);
        if k == n {
            first = all;
        }
    }
    return vec2<f32>(first, 2.0 * first - all);
}

// Opacity of each of n copies, and the factor on the scale.
fn shared_by_image(opacity: f32, n: u32) -> vec2<f32> {
    var low = 0.0;
    var high = root_of(opacity, n);
    for (var halving = 0u; halving < N_HALVINGS; halving += 1u) {
        let middle = 0.5 * (low + high);
        let sums = sums_of_copies(middle, n);
        if sums.y > 0.5 * opacity * sums.x {
            high = middle;
        } else {
            low = middle;
        }
    }
    let shared_opacity = held(0.5 * (low + high));
    return vec2<f32>(shared_opacity, sqrt(opacity / sums_of_copies(shared_opacity, n).x));
}

fn shared_by_line(opacity: f32, n: u32) -> vec2<f32> {
    let shared_opacity = held(root_of(opacity, n));
    var sum = 0.5 * stacked(shared_opacity, n);
    for (var node = 1u; node < N_NODES; node += 1u) {
        let t = NODE_STEP * f32(node);
        sum += stacked(shared_opacity * exp(-t * t), n);
    }
    return vec2<f32>(shared_opacity, opacity / (2.0 / SQRT_PI * NODE_STEP * sum));
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
    var copy = vec2<f32>(0.0);
    if moves.by_image == 1u {
        copy = shared_by_image(opacity, n);
    } else {
        copy = shared_by_line(opacity, n);
    }
    geometry[at].w = log(copy.x / (1.0 - copy.x));
    let scale = geometry[at + 2u];
    clear_moments(splat_ix);
    let age = select(0.0, moments[8u * splat_ix + 4u].w, moves.keeps_age == 1u);
    geometry[at + 2u] = vec4<f32>(scale.xyz + log(copy.y), age);
}
