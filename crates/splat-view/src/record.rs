//! A splat -> the words that browsers draw it from: the `PackedSplats` of Spark 2.2, 16 bytes and harmonics beside them.

use std::f32::consts::PI;

use half::f16;

use splat_types::splats::splats::{SH_C0, Splats};

/// Colours 0 to 255 stand for these, so that bright and dark splats are not cut.
const RGB: [f32; 2] = [-0.5, 1.5];
/// Logarithms of standard deviations, of 1 to 255.
const LOG_SCALES: [f32; 2] = [-12.0, 9.0];
/// A smaller one is none: a disc.
const LOG_NONE: f32 = -30.0;
/// Words of a splat's record, and of its harmonics of degrees 1 to 3.
pub const RECORD_WORDS: usize = 4;
const SH_WORDS: [usize; 3] = [2, 4, 4];

/// Words of harmonics of a splat up to a degree.
pub fn n_sh_words(degree: u8) -> usize {
    SH_WORDS[..usize::from(degree.min(3))].iter().sum()
}

/// Where the words of one degree (1 to 3) lie among those of a splat.
pub fn sh_words_of(degree: u8) -> std::ops::Range<usize> {
    n_sh_words(degree - 1)..n_sh_words(degree)
}

/// `origin`: of the chunk, in the splat frame.
pub fn record(splats: &Splats, ix: usize, origin: [f32; 3]) -> [u32; RECORD_WORDS] {
    let stride = splats.sh_stride();
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u32;
    let colour = |c: usize| {
        let value = 0.5 + SH_C0 * splats.sh[ix * stride + c];
        byte((value - RGB[0]) / (RGB[1] - RGB[0]) * 255.0)
    };
    let opacity = 1.0 / (1.0 + (-splats.opacity_logits[ix]).exp());
    let w0 = colour(0) | colour(1) << 8 | colour(2) << 16 | byte(255.0 * opacity) << 24;
    let at = |k: usize| u32::from(f16::from_f32(splats.means[ix][k] - origin[k]).to_bits());
    let (axis, angle) = rotation(splats.quats[ix]);
    let scale = |k: usize| {
        let log = splats.log_scales[ix][k];
        let share = (log - LOG_SCALES[0]) / (LOG_SCALES[1] - LOG_SCALES[0]);
        if log < LOG_NONE {
            0
        } else {
            ((share * 254.0).round() + 1.0).clamp(1.0, 255.0) as u32
        }
    };
    let w3 = scale(0) | scale(1) << 8 | scale(2) << 16 | angle << 24;
    [w0, at(0) | at(1) << 16, at(2) | axis << 16, w3]
}

/// Two bytes of the octahedral axis, and the byte of the angle.
fn rotation([w, x, y, z]: [f32; 4]) -> (u32, u32) {
    let quat = glam::Quat::from_xyzw(x, y, z, w);
    let length = quat.length();
    let quat = if length > 1e-12 {
        quat / length
    } else {
        glam::Quat::IDENTITY
    };
    let quat = if quat.w < 0.0 { -quat } else { quat };
    let angle = (2.0 * quat.w.clamp(0.0, 1.0).acos() * 255.0 / PI).round() as u32;
    let axis = quat.xyz().try_normalize().unwrap_or(glam::Vec3::X);
    let sum = axis.x.abs() + axis.y.abs() + axis.z.abs();
    let (u, v) = (axis.x / sum, axis.y / sum);
    let sign = |v: f32| if v >= 0.0 { 1.0 } else { -1.0 };
    let folded = axis.z < 0.0;
    let (u, v) = if folded {
        ((1.0 - v.abs()) * sign(u), (1.0 - u.abs()) * sign(v))
    } else {
        (u, v)
    };
    let byte = |v: f32| ((v * 0.5 + 0.5) * 255.0).round().clamp(0.0, 255.0) as u32;
    (byte(u) | byte(v) << 8, angle.min(255))
}

/// Appends the words of the harmonics of degrees 1 to `degree`, each number within -1 to 1.
pub fn push_harmonics(splats: &Splats, ix: usize, degree: u8, words: &mut Vec<u32>) {
    let stride = splats.sh_stride();
    let sh = &splats.sh[ix * stride..(ix + 1) * stride];
    if degree >= 1 {
        words.extend(bits::<2>(&sh[3..12], 7));
    }
    if degree >= 2 {
        words.extend(bits::<4>(&sh[12..27], 8));
    }
    if degree >= 3 {
        words.extend(bits::<4>(&sh[27..48], 6));
    }
}

/// Signed numbers of `width` bits each, one behind the other, the lowest bits first.
fn bits<const N: usize>(values: &[f32], width: u32) -> [u32; N] {
    let most = ((1_u32 << (width - 1)) - 1) as f32;
    let mut packed = 0_u128;
    for (at, value) in (0_u32..).zip(values) {
        let number = (value.clamp(-1.0, 1.0) * most).round() as i32;
        let number = u128::from(number as u32 & ((1 << width) - 1));
        packed |= number << (at * width);
    }
    std::array::from_fn(|k| (packed >> (32 * k)) as u32)
}
