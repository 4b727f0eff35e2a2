//! Dot products of descriptors of bytes: two submaps a lane, as AVX2 multiplies bytes.

use crate::features::descriptor::MAX_SUBMAP;
use crate::matching::lanes::{HALVES, LANES, Lanes, ROWS, WIDE};

/// Submaps of one SIFT descriptor.
const LENGTH: usize = 128;
/// Two submaps of `WIDE` descriptors, those of one descriptor side by side.
type Half = [u8; 2 * WIDE];

/// Descriptors whose products with each other stay within 16 bits, so that sums may wrap on the way.
#[derive(Debug, Clone)]
pub struct Bytes {
    pub(crate) len: usize,
    /// `LENGTH / 2` in a row belong to one group of rows; the last group is filled up with zeros.
    rows: Vec<[[u8; 2]; ROWS]>,
    /// `LENGTH / 2` in a row belong to one block of columns.
    columns: Vec<[Half; HALVES]>,
}

impl Bytes {
    pub(crate) fn new(all: &[[u8; LENGTH]]) -> Self {
        let fits = |d: &[u8; LENGTH]| {
            let square: u32 = d.iter().map(|v| u32::from(*v).pow(2)).sum();
            square <= u32::from(u16::MAX) && d.iter().all(|v| *v <= MAX_SUBMAP)
        };
        assert!(
            all.iter().all(fits),
            "products of SIFT descriptors pass 16 bits"
        );
        let n_pairs = LENGTH / 2;
        let mut rows = vec![[[0; 2]; ROWS]; n_pairs * all.len().div_ceil(ROWS)];
        let mut columns = vec![[[0; 2 * WIDE]; HALVES]; n_pairs * all.len().div_ceil(LANES)];
        for (i, bytes) in all.iter().enumerate() {
            let group = &mut rows[i / ROWS * n_pairs..][..n_pairs];
            let block = &mut columns[i / LANES * n_pairs..][..n_pairs];
            let pairs = bytes.as_chunks::<2>().0;
            for ((pair, row), column) in pairs.iter().zip(group).zip(block) {
                row[i % ROWS] = *pair;
                let lane = i % LANES;
                column[lane / WIDE].as_chunks_mut::<2>().0[lane % WIDE] = *pair;
            }
        }
        Self {
            len: all.len(),
            rows,
            columns,
        }
    }

    fn group(&self, group: usize) -> &[[[u8; 2]; ROWS]] {
        &self.rows[group * LENGTH / 2..][..LENGTH / 2]
    }

    fn block(&self, block: usize) -> &[[Half; HALVES]] {
        &self.columns[block * LENGTH / 2..][..LENGTH / 2]
    }
}

/// Dot products of `ROWS` rows with a block of columns.
#[inline(always)]
pub(crate) fn products((a, group): (&Bytes, usize), (b, block): (&Bytes, usize)) -> [Lanes; ROWS] {
    let mut sums = [[[0_u16; WIDE]; HALVES]; ROWS];
    for (row, column) in a.group(group).iter().zip(b.block(block)) {
        for (sums, pair) in sums.iter_mut().zip(row) {
            for (sums, half) in sums.iter_mut().zip(column) {
                for (sum, other) in sums.iter_mut().zip(half.as_chunks::<2>().0) {
                    for (own, other) in pair.iter().zip(other) {
                        *sum = sum.wrapping_add(u16::from(*own) * u16::from(*other));
                    }
                }
            }
        }
    }
    sums
}

/// The same by the instruction that multiplies 32 bytes and adds neighbours, twice as fast as 16-bit products.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
pub(crate) fn products_avx2(
    (a, group): (&Bytes, usize),
    (b, block): (&Bytes, usize),
) -> [Lanes; ROWS] {
    use std::arch::x86_64::{
        __m256i, _mm256_add_epi16, _mm256_maddubs_epi16, _mm256_set1_epi16, _mm256_setzero_si256,
    };
    let mut sums = [[_mm256_setzero_si256(); HALVES]; ROWS];
    for (row, column) in a.group(group).iter().zip(b.block(block)) {
        let halves: [__m256i; HALVES] = bytemuck::cast(*column);
        for (sums, pair) in sums.iter_mut().zip(row) {
            let pair = _mm256_set1_epi16(i16::from_le_bytes(*pair));
            for (sum, half) in sums.iter_mut().zip(halves) {
                *sum = _mm256_add_epi16(*sum, _mm256_maddubs_epi16(half, pair));
            }
        }
    }
    bytemuck::cast(sums)
}
