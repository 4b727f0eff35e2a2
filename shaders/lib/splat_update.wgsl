// One update of one splat: Adam on all that it has, and noise on its mean. The importing shader binds `step`, `geometry`, `moments`,
// `sh_rest` and `sh_moments`. Equations: docs/GRADIENTS.md, Adam and MCMC.

#import step
#import quat
#import sh
#import adam
#import random

// Above it the noise is below 4e-9 of itself.
const MAX_SHAKEN_OPACITY: f32 = 0.2;
const PI: f32 = 3.14159265;

struct Gradient {
    mean: vec3<f32>,
    opacity_logit: f32,
    quat: vec4<f32>,
    log_scale: vec3<f32>,
    base: vec3<f32>,
    // 0 where it was clamped at black.
    color: vec3<f32>,
    rho: vec3<f32>,
    log_focal: f32,
    theta: vec3<f32>,
    // Norm by the projected mean, in normalised device coordinates; below 0: not seen.
    screen: f32,
}

fn updated(value: vec4<f32>, g: vec4<f32>, at: u32, rate: vec4<f32>, correction: vec2<f32>) -> vec4<f32> {
    let m = BETA_1 * moments[at] + (1.0 - BETA_1) * g;
    let v = BETA_2 * moments[at + 1u] + (1.0 - BETA_2) * g * g;
    moments[at] = m;
    moments[at + 1u] = v;
    return value - rate * (m * correction.x) / (sqrt(v) * correction.y + SPLAT_EPS);
}

// bf16, round to nearest even.
fn bf16_of(x: f32) -> u32 {
    let bits = bitcast<u32>(x);
    return (bits + 0x7fffu + ((bits >> 16u) & 1u)) >> 16u;
}

fn band_of(coefficient: u32) -> u32 {
    return 1u + select(0u, 1u, coefficient >= 3u) + select(0u, 1u, coefficient >= 8u);
}

fn sh_moment(half: u32, g: f32) -> f32 {
    return BETA_1 * bitcast<f32>(half << 16u) + (1.0 - BETA_1) * g;
}

// All bands share their colour gradient; a band has one second moment, the mean over its coefficients and channels.
// `since_cleared` counts the updates of the moments, `in_all` those of the splat and of what it was copied from.
fn update_sh(splat_ix: u32, direction: vec3<f32>, g_color: vec3<f32>, since_cleared: u32, in_all: u32) {
    let stored = n_sh_rest(step.sh_stored);
    let words = (stored + 1u) / 2u;
    let first_word = splat_ix * (words + step.sh_stored);
    // Of any band: the squares of its 2 band + 1 coefficients add up to (2 band + 1) / (4 pi) in every direction (Unsoeld 1927).
    let mean = dot(g_color, g_color) / (12.0 * PI);
    var factors = vec3<f32>(0.0);
    var n_active = 0u;
    for (var band = 1u; band <= step.sh_degree; band += 1u) {
        let first_update = max(band * step.sh_interval, 1u);
        if in_all < first_update {
            break;
        }
        let correction = corrections(min(in_all - first_update + 1u, since_cleared));
        let at = first_word + words + band - 1u;
        let v = BETA_2 * bitcast<f32>(sh_moments[at]) + (1.0 - BETA_2) * mean;
        sh_moments[at] = bitcast<u32>(v);
        factors[band - 1u] = step.lr_sh_rest * correction.x / (sqrt(v) * correction.y + SPLAT_EPS);
        n_active = 3u * ((band + 1u) * (band + 1u) - 1u);
    }
    let basis = sh_basis(direction);
    let first = splat_ix * stored;
    // Two numbers a word; written out, so that the basis stays in registers.
#repeat w 22
    if $[w+w]u < n_active {
        let packed = sh_moments[first_word + $wu];
        let m = sh_moment(packed & 0xffffu, basis[$[w+w]u / 3u] * g_color[$[w+w]u % 3u]);
        sh_rest[first + $[w+w]u] -= m * factors[band_of($[w+w]u / 3u) - 1u];
        var kept = packed & 0xffff0000u;
        if $[w+w]u + 1u < n_active {
            let odd = sh_moment(packed >> 16u, basis[($[w+w]u + 1u) / 3u] * g_color[($[w+w]u + 1u) % 3u]);
            sh_rest[first + $[w+w]u + 1u] -= odd * factors[band_of(($[w+w]u + 1u) / 3u) - 1u];
            kept = bf16_of(odd) << 16u;
        }
        sh_moments[first_word + $wu] = bf16_of(m) | kept;
    }
#end
    if n_active == 45u {
        let packed = sh_moments[first_word + 22u];
        let m = sh_moment(packed & 0xffffu, basis[14] * g_color.z);
        sh_rest[first + 44u] -= m * factors.z;
        sh_moments[first_word + 22u] = bf16_of(m) | (packed & 0xffff0000u);
    }
}

// SGLD (Kheradmand et al. 2024, eq. 9): only what is nearly transparent moves, along its own covariance.
fn shaken(splat_ix: u32, mean: vec3<f32>, opacity_logit: f32, quat: vec4<f32>, log_scale: vec3<f32>) -> vec3<f32> {
    let opacity = 1.0 / (1.0 + exp(-opacity_logit));
    let gate = 1.0 / (1.0 + exp(100.0 * (opacity - 0.005)));
    if opacity > MAX_SHAKEN_OPACITY {
        return mean;
    }
    let axes = rotation_of(normalize(quat));
    let scale = exp(log_scale);
    let along = (normal3(step.noise_seed, step.n_steps, splat_ix) * axes) * scale * scale;
    return mean + step.noise * gate * (axes * along);
}

fn update_splat(splat_ix: u32, direction: vec3<f32>, g: Gradient) {
    let at = 4u * splat_ix;
    let base = geometry[at + 3u];
    let scale = geometry[at + 2u];
    let age = u32(scale.w) + 1u;
    let correction = corrections(age);
    let m = 8u * splat_ix;
    let in_all = moments[m + 4u].w + 1.0;
    let lr_mean = step.lr_mean * max(1.0 / (1.0 + step.lr_mean_decay * in_all), MIN_RATE_SHARE);
    let position_rates = vec4<f32>(vec3<f32>(lr_mean), step.lr_opacity);
    var mean = updated(geometry[at], vec4<f32>(g.mean, g.opacity_logit), m, position_rates, correction);
    let quat = updated(geometry[at + 1u], g.quat, m + 2u, vec4<f32>(step.lr_quat), correction);
    let log_scale = updated(vec4<f32>(scale.xyz, 0.0), vec4<f32>(g.log_scale, 0.0), m + 4u, vec4<f32>(step.lr_scale), correction).xyz;
    let screen = vec2<f32>(moments[m + 6u].w, moments[m + 7u].w);
    let color = updated(vec4<f32>(base.xyz, 0.0), vec4<f32>(g.base, 0.0), m + 6u, vec4<f32>(step.lr_sh0), correction).xyz;
    moments[m + 4u].w = in_all;
    let is_counted = (step.flags & FLAG_SCREEN_GRADIENTS) != 0u && g.screen >= 0.0 && is_finite(g.screen);
    let more = select(vec2<f32>(0.0), vec2<f32>(g.screen, 1.0), is_counted);
    moments[m + 6u].w = screen.x + more.x;
    moments[m + 7u].w = screen.y + more.y;
    if step.noise > 0.0 {
        let moved = shaken(splat_ix, mean.xyz, mean.w, quat, log_scale);
        if is_finite3(moved) {
            mean = vec4<f32>(moved, mean.w);
        }
    }
    geometry[at] = mean;
    geometry[at + 1u] = quat;
    geometry[at + 2u] = vec4<f32>(log_scale, f32(age));
    geometry[at + 3u] = vec4<f32>(color, f32(step.n_steps));
    if step.sh_degree > 0u {
        update_sh(splat_ix, direction, g.color, age, u32(in_all));
    }
}
