//! Two sets of descriptors -> pairs that are mutually nearest and clearly better than the second best.
//!
//! Knows nothing of pictures or cameras. Integer arithmetic, so the result is the same on every machine.

use crate::geometry::features::{DESCRIPTOR_BYTES, Descriptor};

/// Highest ratio of the nearest to the second nearest distance (Lowe 2004, section 7.1).
const MAX_RATIO: f64 = 0.8;
/// Highest distance of a match; unrelated descriptors are about 360 apart (square root of the summed squares of 128 bytes).
const MAX_DISTANCE: f64 = 330.0;

/// A descriptor widened for multiply-and-add of 16-bit pairs, with its squared length.
#[derive(Debug, Clone)]
pub struct Wide {
    values: Vec<[i16; DESCRIPTOR_BYTES]>,
    squares: Vec<i32>,
}

impl Wide {
    pub fn new(descriptors: &[Descriptor]) -> Self {
        let values: Vec<[i16; DESCRIPTOR_BYTES]> =
            descriptors.iter().map(|d| d.map(i16::from)).collect();
        let squares = values.iter().map(|v| dot(v, v)).collect();
        Self { values, squares }
    }
}

#[derive(Clone, Copy)]
struct Nearest {
    ix: u32,
    square: i32,
    second: i32,
}

const NOTHING: Nearest = Nearest {
    ix: u32::MAX,
    square: i32::MAX,
    second: i32::MAX,
};

impl Nearest {
    #[inline]
    fn offer(&mut self, ix: usize, square: i32) {
        if square < self.square {
            *self = Self {
                ix: ix as u32,
                square,
                second: self.square,
            };
        } else if square < self.second {
            self.second = square;
        }
    }

    fn is_clear(&self) -> bool {
        let (best, second) = (f64::from(self.square.max(0)), f64::from(self.second.max(0)));
        best <= MAX_DISTANCE * MAX_DISTANCE && best < MAX_RATIO * MAX_RATIO * second
    }
}

/// Pairs (index in `a`, index in `b`), in order of `a`.
pub fn matches(a: &Wide, b: &Wide) -> Vec<(u32, u32)> {
    let (rows, columns) = nearest(a, b);
    let mutual = |(i, row): (usize, &Nearest)| {
        let clear = row.is_clear() && columns[row.ix as usize].ix == i as u32;
        clear.then_some((i as u32, row.ix))
    };
    rows.iter().enumerate().filter_map(mutual).collect()
}

#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn nearest(a: &Wide, b: &Wide) -> (Vec<Nearest>, Vec<Nearest>) {
    let mut rows = vec![NOTHING; a.values.len()];
    let mut columns = vec![NOTHING; b.values.len()];
    // Blocks of b stay in the first cache while rows of a pass, two at a time: that saves loads.
    const BLOCK: usize = 64;
    for (block_ix, block) in b.values.chunks(BLOCK).enumerate() {
        for first in (0..a.values.len()).step_by(2) {
            let second = (first + 1).min(a.values.len() - 1);
            let (u, v) = (&a.values[first], &a.values[second]);
            for (k, other) in block.iter().enumerate() {
                let j = block_ix * BLOCK + k;
                let products = [dot(u, other), dot(v, other)];
                for (i, product) in [first, second]
                    .into_iter()
                    .zip(products)
                    .take(second - first + 1)
                {
                    let square = a.squares[i] + b.squares[j] - 2 * product;
                    rows[i].offer(j, square);
                    columns[j].offer(i, square);
                }
            }
        }
    }
    (rows, columns)
}

/// This form, inlined, becomes one multiply-and-add instruction for 16 pairs; a plain loop over two rows does not.
#[inline(always)]
fn dot(a: &[i16; DESCRIPTOR_BYTES], b: &[i16; DESCRIPTOR_BYTES]) -> i32 {
    a.iter()
        .zip(b)
        .map(|(x, y)| i32::from(*x) * i32::from(*y))
        .sum()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::*;

    fn random_descriptors(n: usize, seed: u64) -> Vec<Descriptor> {
        let mut rng = rand_pcg::Pcg32::seed_from_u64(seed);
        (0..n)
            .map(|_| std::array::from_fn(|_| rng.random_range(0..90)))
            .collect()
    }

    #[test]
    fn noisy_copies_find_each_other_and_strangers_find_nobody() {
        let a = random_descriptors(300, 1);
        let mut rng = rand_pcg::Pcg32::seed_from_u64(2);
        let mut b: Vec<Descriptor> = a[..200]
            .iter()
            .map(|d| d.map(|v| v + rng.random_range(0..8)))
            .collect();
        b.reverse();
        b.extend(random_descriptors(100, 3));
        let found = matches(&Wide::new(&a), &Wide::new(&b));
        let expected: Vec<(u32, u32)> = (0..200).map(|i| (i, 199 - i)).collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn a_point_with_a_twin_matches_nothing() {
        let a = random_descriptors(5, 1);
        let twice = [a.clone(), a.clone()].concat();
        assert!(matches(&Wide::new(&a), &Wide::new(&twice)).is_empty());
        assert!(matches(&Wide::new(&a), &Wide::new(&[])).is_empty());
        // With one candidate there is no second best to compare with: mutual and near is enough.
        assert_eq!(
            matches(&Wide::new(&a[..1]), &Wide::new(&a[..1])),
            vec![(0, 0)]
        );
    }
}
