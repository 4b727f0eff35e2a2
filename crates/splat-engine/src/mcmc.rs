//! MCMC moves in numbers: what a splat becomes when copies share its place, who is drawn, how far one is shaken.
//!
//! Pure functions that every backend computes alike, on one splat each: no state, integers where a result decides.
//! Kheradmand et al. 2024; docs/GRADIENTS.md, MCMC.

use std::f32::consts::{PI, TAU};

/// Copies at one place that the formula is used for, as in the authors' code.
pub const MAX_SHARES: u32 = 51;
/// Largest opacity whose logit is finite in f32.
pub const MAX_OPACITY: f32 = 1.0 - f32::EPSILON;
/// Third word of the hash: a draw that a dead splat moves by.
pub const RELOCATION: u32 = 0;
/// Third word of the hash: a draw that adds a splat.
pub const GROWTH: u32 = 1;
/// Halvings of the bracket around an opacity: as many as f32 has bits.
const N_HALVINGS: u32 = 24;
/// Nodes of the integral over a Gaussian and their distance: what is left out and what falls between is below 1e-7.
const N_NODES: u16 = 36;
const NODE_STEP: f32 = 0.125;
/// Opacity at which noise falls to a half, and how steeply: only what is all but invisible is shaken.
const SHAKEN_OPACITY: f32 = 0.005;
const SHAKEN_STEEPNESS: f32 = 100.0;
/// Above it the noise is below 4e-9 of itself.
pub const MAX_SHAKEN_OPACITY: f32 = 0.2;
/// More bits than this would promise what f32 opacities do not have.
const MAX_WEIGHT_BITS: u32 = 24;
/// Sets the second hash of a splat's noise apart from the first.
const SECOND_HASH: u32 = 0x9e37_79b9;

/// Three well mixed words of three (pcg3d: Jarzynski, Olano 2020). Draws hash (seed, number of the draw, kind), noise hashes
/// (seed, step, splat).
pub fn hash(words: [u32; 3]) -> [u32; 3] {
    let [mut x, mut y, mut z] =
        words.map(|w| w.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    x = x.wrapping_add(y.wrapping_mul(z));
    y = y.wrapping_add(z.wrapping_mul(x));
    z = z.wrapping_add(x.wrapping_mul(y));
    (x, y, z) = (x ^ (x >> 16), y ^ (y >> 16), z ^ (z >> 16));
    x = x.wrapping_add(y.wrapping_mul(z));
    y = y.wrapping_add(z.wrapping_mul(x));
    z = z.wrapping_add(x.wrapping_mul(y));
    [x, y, z]
}

/// 0 <= x < 1, from the upper 24 bits.
pub fn uniform(word: u32) -> f32 {
    (word >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Three independent numbers of mean 0 and variance 1 (Box, Muller 1958).
pub fn normal3(words: [u32; 3]) -> [f32; 3] {
    let [a, b, c] = hash(words);
    let [d, ..] = hash([words[0] ^ SECOND_HASH, words[1], words[2]]);
    // 1 - u is never 0.
    let radius = |word| (-2.0 * (1.0 - uniform(word)).ln()).sqrt();
    let (first, second) = (radius(a), radius(c));
    let (sin, cos) = (TAU * uniform(b)).sin_cos();
    [first * cos, first * sin, second * (TAU * uniform(d)).cos()]
}

/// What splats at one place keep of the one that they replace. `docs/GRADIENTS.md`, section 10.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Relocation {
    /// The sum of its alpha over the image, and that of alpha squared: of an opaque splat less than half of the paper's change.
    Image,
    /// The peak, and what a line through its middle gathers, as the paper has it.
    Line,
}

impl Relocation {
    /// Opacity of each of `n` splats at one place that replace one of `opacity`, and the factor on its scale. Where
    /// `min_opacity` holds the opacity, the factor is that of the opacity held.
    pub fn shared(self, opacity: f32, n: u32, min_opacity: f32) -> (f32, f32) {
        let n = n.clamp(1, MAX_SHARES);
        match self {
            Self::Image => shared_by_image(opacity, n, min_opacity),
            Self::Line => shared_by_line(opacity, n, min_opacity),
        }
    }
}

/// With `u = o' exp(-r^2/2)`, all alphas of `n` copies together, `1 - (1 - u)^n`, sum up to `H(n)` over the image and
/// their squares to `2 H(n) - H(2n)`, in units of `2 pi` and the scale squared, where `H(n)` is the sum over k from 1 to
/// n of `(1 - (1 - o')^k) / k`. One splat of opacity o has `o` and `o^2 / 2`.
fn shared_by_image(opacity: f32, n: u32, min_opacity: f32) -> (f32, f32) {
    // With the paper's opacity the squares are too large.
    let (mut low, mut high) = (0.0, root(opacity, n));
    for _ in 0..N_HALVINGS {
        let middle = 0.5 * (low + high);
        let (sum, squares) = sums_of_copies(middle, n);
        if squares > 0.5 * opacity * sum {
            high = middle;
        } else {
            low = middle;
        }
    }
    let shared = held(0.5 * (low + high), min_opacity);
    (shared, (opacity / sums_of_copies(shared, n).0).sqrt())
}

/// `H(n)` and `2 H(n) - H(2n)`.
fn sums_of_copies(opacity: f32, n: u32) -> (f32, f32) {
    let (mut stacked, mut first, mut all) = (0.0, 0.0, 0.0);
    for k in 1..=2 * n {
        stacked += (1.0 - stacked) * opacity;
        all += stacked / k as f32;
        if k == n {
            first = all;
        }
    }
    (first, 2.0 * first - all)
}

/// Opacity of which `n` together have `opacity`.
fn root(opacity: f32, n: u32) -> f32 {
    -((-opacity).ln_1p() / n as f32).exp_m1()
}

fn held(opacity: f32, min_opacity: f32) -> f32 {
    // Not clamp(): it asserts on a NaN limit.
    opacity.max(min_opacity).min(MAX_OPACITY)
}

/// The factor keeps the alpha that a line through the middle gathers: `o / (2/sqrt(pi) integral of
/// 1 - (1 - o' exp(-t^2))^n over t > 0)`, equal to the double sum of the paper and without its cancellation.
fn shared_by_line(opacity: f32, n: u32, min_opacity: f32) -> (f32, f32) {
    let shared = held(root(opacity, n), min_opacity);
    let mut sum = 0.5 * stacked(shared, n);
    for node in 1..N_NODES {
        let t = NODE_STEP * f32::from(node);
        sum += stacked(shared * (-t * t).exp(), n);
    }
    (shared, opacity / (2.0 / PI.sqrt() * NODE_STEP * sum))
}

/// `1 - (1 - alpha)^n` by squaring; sums of positive terms only, so small alphas keep their digits.
fn stacked(alpha: f32, mut n: u32) -> f32 {
    let (mut all, mut power) = (0.0, alpha);
    while n > 0 {
        if n & 1 == 1 {
            all += power * (1.0 - all);
        }
        power += power * (1.0 - power);
        n >>= 1;
    }
    all
}

/// Bits of a weight such that `n` weights add up to less than 2^32.
pub fn weight_bits(n: usize) -> u32 {
    (u64::from(u32::MAX) / (n.max(1) as u64))
        .max(1)
        .ilog2()
        .min(MAX_WEIGHT_BITS)
}

/// Chance of a live splat to be drawn, of all weights' sum: `floor(opacity * 2^bits)`, `bits` by [`weight_bits`].
pub fn weight(opacity: f32, bits: u32) -> u32 {
    (opacity * (1_u32 << bits) as f32) as u32
}

/// The splat that `word` draws: the last one that starts at or below `word * total / 2^32`. `starts` are the sums of
/// the weights before each splat; one of weight 0 is never drawn.
pub fn draw(starts: &[u32], total: u32, word: u32) -> usize {
    let target = ((u64::from(word) * u64::from(total)) >> 32) as u32;
    starts.partition_point(|&start| start <= target) - 1
}

/// Count after growth, at most `max`; never less than `n`.
pub fn grown(n: usize, growth: f32, max: usize) -> usize {
    // 1.05 in f32 lies below 1.05 by up to half an epsilon; a cast of NaN gives 0.
    let growth = f64::from(growth) * (1.0 + 0.5 * f64::from(f32::EPSILON));
    ((growth * n as f64) as usize).min(max).max(n)
}

/// Offset of a mean by SGLD noise of rate 1, in world units: the covariance times `eta`, gated so that only faint splats move.
/// `quat` is w, x, y, z of unit length, `opacity` is activated, `eta` has mean 0 and variance 1 ([`normal3`]).
pub fn add_noise(log_scale: [f32; 3], quat: [f32; 4], opacity: f32, eta: [f32; 3]) -> [f32; 3] {
    let [w, x, y, z] = quat;
    let axes = [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y + w * z),
            2.0 * (x * z - w * y),
        ],
        [
            2.0 * (x * y - w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z + w * x),
        ],
        [
            2.0 * (x * z + w * y),
            2.0 * (y * z - w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ];
    let gate = 1.0 / (1.0 + (SHAKEN_STEEPNESS * (opacity - SHAKEN_OPACITY)).exp());
    let mut offset = [0.0; 3];
    for (axis, log_scale) in axes.iter().zip(log_scale) {
        let along: f32 = axis.iter().zip(eta).map(|(a, e)| a * e).sum();
        let variance = (2.0 * log_scale).exp();
        for (offset, a) in offset.iter_mut().zip(axis) {
            *offset += gate * variance * along * a;
        }
    }
    offset
}
