// Adam (Kingma & Ba 2015), for splats and for what moves cameras.

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const SPLAT_EPS: f32 = 1e-15;
// Larger than for splats: a view that sees next to nothing shall not run away on noise.
const VIEW_EPS: f32 = 1e-8;
// What a decay leaves of a rate at least.
const MIN_RATE_SHARE: f32 = 0.01;
const LN_BETA_1: f32 = -0.105360515;
const LN_BETA_2: f32 = -0.0010005003;

// 1 - exp(x) for x <= 0, without the cancellation near 0.
fn one_less_exp(x: f32) -> f32 {
    if x > -0.05 {
        return -x * (1.0 + x * (0.5 + x * (0.16666667 + x * 0.041666667)));
    }
    return 1.0 - exp(x);
}

// What bias correction makes of the moments after so many updates.
fn corrections(age: u32) -> vec2<f32> {
    let t = f32(age);
    return vec2<f32>(1.0 / one_less_exp(t * LN_BETA_1), inverseSqrt(one_less_exp(t * LN_BETA_2)));
}

fn adam_direction(m: f32, v: f32, correction: vec2<f32>, eps: f32) -> f32 {
    return m * correction.x / (sqrt(v) * correction.y + eps);
}
