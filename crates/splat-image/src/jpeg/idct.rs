//! The 64 coefficients of a JPEG block -> its 8 x 8 levels.
//!
//! Source: Arai, Agui, Nakajima, "A fast DCT-SQ scheme for images", 1988. The scales of its outputs are left to the
//! quantisers. In f32 without fused operations, so that every machine gets the same levels.

use wide::{f32x8, i16x8, u8x16};

/// By horizontal, then vertical frequency: transposed, so that the levels are not.
pub(crate) type Coefficients = [[f32; 8]; 8];
pub(crate) type Levels = [[u8; 8]; 8];

/// Of a level around which the coefficients swing.
const MIDDLE: f32 = 128.0;
/// 2 cos(pi / 8), 2 (cos(pi / 8) - cos(3 pi / 8)), 2 (cos(pi / 8) + cos(3 pi / 8)).
const TURNS: [f32; 3] = [1.847_759_1, 1.082_392_2, 2.613_126];

/// What a coefficient at a frequency across and one down has to be multiplied with, beside its quantiser.
pub(crate) fn scale(across: usize, down: usize) -> f32 {
    let side = |frequency: usize| match frequency {
        0 => 1.0,
        _ => 2.0_f64.sqrt() * (frequency as f64 * std::f64::consts::PI / 16.0).cos(),
    };
    (side(across) * side(down) / 8.0) as f32
}

/// A block whose coefficients are 0 but the first.
pub(crate) fn flat(first: f32) -> Levels {
    [[(first + MIDDLE).round_ties_even() as u8; 8]; 8]
}

pub(crate) fn levels(coefficients: &Coefficients) -> Levels {
    let across = one_way(coefficients.map(f32x8::from));
    let down = one_way(f32x8::transpose(across));
    let mut levels = [[0; 8]; 8];
    let pairs = levels.as_chunks_mut::<2>().0;
    for (pair, rows) in pairs.iter_mut().zip(down.as_chunks::<2>().0) {
        let [upper, lower] = rows.map(|row| {
            let rounded = (row + f32x8::splat(MIDDLE)).fast_round_int();
            i16x8::from_i32x8_saturate(rounded)
        });
        let bytes = u8x16::narrow_i16x8(upper, lower).to_array();
        pair.as_flattened_mut().copy_from_slice(&bytes);
    }
    levels
}

/// Eight transforms side by side, each along the index.
#[inline(always)]
fn one_way(x: [f32x8; 8]) -> [f32x8; 8] {
    const SQRT_2: f32 = std::f32::consts::SQRT_2;
    let (sum, difference) = (x[0] + x[4], x[0] - x[4]);
    let middle = x[2] + x[6];
    let side = (x[2] - x[6]) * SQRT_2 - middle;
    let even = [
        sum + middle,
        difference + side,
        difference - side,
        sum - middle,
    ];
    let (inner, inner_less) = (x[5] + x[3], x[5] - x[3]);
    let (outer, outer_less) = (x[1] + x[7], x[1] - x[7]);
    let odd0 = outer + inner;
    let turned = (inner_less + outer_less) * TURNS[0];
    let odd1 = turned - inner_less * TURNS[2] - odd0;
    let odd2 = (outer - inner) * SQRT_2 - odd1;
    let odd3 = turned - outer_less * TURNS[1] - odd2;
    let odd = [odd0, odd1, odd2, odd3];
    std::array::from_fn(|ix| match ix {
        0..4 => even[ix] + odd[ix],
        _ => even[7 - ix] - odd[7 - ix],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    /// T.81, A.3.3, as it is written there.
    fn known(coefficients: &[[f64; 8]; 8], x: usize, y: usize) -> f64 {
        let side = |frequency: usize, at: usize| {
            let scale = if frequency == 0 { 0.5_f64.sqrt() } else { 1.0 };
            let turns = (2 * at + 1) as f64 * frequency as f64 / 16.0;
            scale * (turns * std::f64::consts::PI).cos() / 2.0
        };
        let all = (0..8).flat_map(|u| (0..8).map(move |v| (u, v)));
        all.map(|(u, v)| coefficients[u][v] * side(u, x) * side(v, y))
            .sum()
    }

    #[test]
    fn levels_are_those_of_the_standard() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
        for _ in 0..100 {
            let exact: [[f64; 8]; 8] = std::array::from_fn(|u| {
                std::array::from_fn(|v| {
                    rng.random_range(-400.0..400.0_f64).round() / ((u + v + 1) as f64)
                })
            });
            let scaled: Coefficients =
                std::array::from_fn(|u| std::array::from_fn(|v| exact[u][v] as f32 * scale(u, v)));
            let found = levels(&scaled);
            for (y, row) in found.iter().enumerate() {
                for (x, &found) in row.iter().enumerate() {
                    let known = (known(&exact, x, y) + 128.0).clamp(0.0, 255.0);
                    let off = (f64::from(found) - known).abs();
                    assert!(off < 0.51, "{found} at {x} {y}, known {known}");
                }
            }
        }
    }

    #[test]
    fn a_flat_block_is_what_the_transform_makes_of_it() {
        for first in [-2000.0, -37.4, 0.0, 12.6, 900.0] {
            let mut coefficients = [[0.0; 8]; 8];
            coefficients[0][0] = first;
            assert_eq!(levels(&coefficients), flat(first));
        }
    }
}
