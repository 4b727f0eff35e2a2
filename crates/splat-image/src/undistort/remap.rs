//! Bilinear sampling by a table of where each pixel comes from.
//!
//! In whole numbers of 16 bits, the same on every processor: within 0.7 of a grey level of the exact value.

use bytemuck::{Pod, Zeroable};
use multiversion::multiversion;

use crate::pixel_format::resize;
use splat_types::image::RgbImage;

/// Pixels of a block.
const BLOCK: usize = 8;
/// A weight of one; weights end one below it, so that they fit 15 bits.
const WHOLE: f64 = 32768.0;
/// Grey levels are mixed as multiples of 2^-7.
const LEVEL_BITS: u32 = 7;
/// Bytes behind the last pixel that may be read, since two pixels are read as eight bytes.
const PAD_BYTES: usize = 8;

/// Where eight pixels come from.
#[derive(Debug, Clone, Copy, Default, Pod, Zeroable)]
#[repr(C)]
struct Block {
    /// Bytes from the image's start to the left upper one of four pixels.
    offsets: [u32; BLOCK],
    /// Of the right and of the lower pixels: of four pixels each, since vector registers have halves.
    weights: [Weights; 2],
}

#[derive(Debug, Clone, Copy, Default, Pod, Zeroable)]
#[repr(C)]
struct Weights {
    right: [u16; 4],
    below: [u16; 4],
}

/// The table of a whole image, row by row.
pub(crate) struct Table {
    width_px: u32,
    height_px: u32,
    blocks: Vec<Block>,
}

impl Table {
    /// `places` are where each pixel comes from, in pixels with centres at whole numbers; what lies outside the
    /// image is taken from its rim. `None` where one has no place.
    pub(crate) fn new(
        (width_px, height_px): (u32, u32),
        mut place: impl FnMut(u32, u32) -> Option<(f64, f64)>,
    ) -> Option<Self> {
        let n_pixels = width_px as usize * height_px as usize;
        let mut blocks = vec![Block::default(); n_pixels.div_ceil(BLOCK)];
        let all = (0..height_px).flat_map(|y| (0..width_px).map(move |x| (x, y)));
        for (ix, (x, y)) in all.enumerate() {
            let (x, y) = place(x, y)?;
            let (column, right) = weighed(x, width_px);
            let (row, below) = weighed(y, height_px);
            let (block, ix) = (&mut blocks[ix / BLOCK], ix % BLOCK);
            block.offsets[ix] = 3 * (row * width_px + column);
            let weights = &mut block.weights[ix / 4];
            (weights.right[ix % 4], weights.below[ix % 4]) = (right, below);
        }
        Some(Self {
            width_px,
            height_px,
            blocks,
        })
    }

    /// Where a pixel comes from.
    pub(crate) fn place(&self, x: u32, y: u32) -> (f64, f64) {
        let ix = (y * self.width_px + x) as usize;
        let (block, ix) = (&self.blocks[ix / BLOCK], ix % BLOCK);
        let share = |weight: u16| f64::from(weight) / WHOLE;
        let (offset, weights) = (block.offsets[ix], &block.weights[ix / 4]);
        let (row, column) = (offset / 3 / self.width_px, offset / 3 % self.width_px);
        (
            f64::from(column) + share(weights.right[ix % 4]),
            f64::from(row) + share(weights.below[ix % 4]),
        )
    }

    /// `image` comes out as it went in; it is a `&mut` for the room behind its pixels.
    pub(crate) fn remap(&self, image: &mut RgbImage, out: &mut RgbImage) {
        assert_eq!(
            (image.width_px, image.height_px),
            (self.width_px, self.height_px),
            "table for another size"
        );
        resize(out, self.width_px, self.height_px);
        let n_bytes = image.pixels.len();
        image.pixels.resize(n_bytes + PAD_BYTES, 0);
        let row_bytes = match self.height_px {
            1 => 0,
            _ => 3 * self.width_px as usize,
        };
        mix_all(&image.pixels, row_bytes, &self.blocks, &mut out.pixels);
        image.pixels.truncate(n_bytes);
    }
}

/// The pixel before a place along one side, and the weight of the one behind it.
fn weighed(at: f64, n_px: u32) -> (u32, u16) {
    let at = at.clamp(0.0, f64::from(n_px - 1));
    let first = (at as u32).min(n_px.saturating_sub(2));
    let weight = ((at - f64::from(first)) * WHOLE).round();
    (first, weight.min(WHOLE - 1.0) as u16)
}

/// Red, green and blue of eight pixels.
type Mixed = [u8; 3 * BLOCK];

#[multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn mix_all(source: &[u8], row_bytes: usize, blocks: &[Block], target: &mut [u8]) {
    let mix = |block: &Block| -> Mixed {
        multiversion::target::match_target! {
            "x86_64+avx2" => mix_avx2(source, row_bytes, block),
            _ => mix(source, row_bytes, block),
        }
    };
    let (targets, rest) = target.as_chunks_mut::<{ 3 * BLOCK }>();
    let (whole, last) = blocks.split_at(targets.len());
    for (block, target) in whole.iter().zip(targets) {
        *target = mix(block);
    }
    if let [block] = last {
        rest.copy_from_slice(&mix(block)[..rest.len()]);
    }
}

/// Two neighbours: six bytes of eight.
#[inline(always)]
fn two(source: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(
        *source[at..]
            .first_chunk()
            .expect("room behind the last pixel"),
    )
}

/// From `from` towards `to` by a weight, rounded.
#[inline(always)]
fn between(from: i16, to: i16, weight: u16) -> i16 {
    let step = (i32::from(to) - i32::from(from)) * i32::from(weight);
    from + ((step + (1 << 14)) >> 15) as i16
}

#[inline(always)]
fn mix(source: &[u8], row_bytes: usize, block: &Block) -> Mixed {
    let mut out = [0; 3 * BLOCK];
    for (ix, out) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        let at = block.offsets[ix] as usize;
        let weights = &block.weights[ix / 4];
        let (right, below) = (weights.right[ix % 4], weights.below[ix % 4]);
        let rows = [at, at + row_bytes].map(|at| two(source, at).to_le_bytes());
        for (channel, out) in out.iter_mut().enumerate() {
            let [upper, lower] = rows.map(|bytes| {
                let level = |ix: usize| i16::from(bytes[ix]) << LEVEL_BITS;
                between(level(channel), level(channel + 3), right)
            });
            let rounded = between(upper, lower, below) + (1 << (LEVEL_BITS - 1));
            *out = (rounded >> LEVEL_BITS) as u8;
        }
    }
    out
}

/// The same in registers of two halves, the first with pixels 0 to 3, the second with 4 to 7.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn mix_avx2(source: &[u8], row_bytes: usize, block: &Block) -> Mixed {
    use std::arch::x86_64::{
        __m256i, _mm_setr_epi8, _mm256_add_epi16, _mm256_broadcastsi128_si256, _mm256_mulhrs_epi16,
        _mm256_packus_epi16, _mm256_permutevar8x32_epi32, _mm256_set_epi64x, _mm256_set1_epi16,
        _mm256_setr_epi32, _mm256_setzero_si256, _mm256_shuffle_epi8, _mm256_slli_epi16,
        _mm256_sub_epi16, _mm256_unpackhi_epi64, _mm256_unpacklo_epi64,
    };
    let both = |bytes: [i8; 16]| {
        let [a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p] = bytes;
        let half = _mm_setr_epi8(a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p);
        _mm256_broadcastsi128_si256(half)
    };
    // Left and right pixel of the upper row, then of the lower one, as four numbers of 16 bits each; -1 gives zero.
    let left = both([0, -1, 1, -1, 2, -1, -1, -1, 8, -1, 9, -1, 10, -1, -1, -1]);
    let right = both([3, -1, 4, -1, 5, -1, -1, -1, 11, -1, 12, -1, 13, -1, -1, -1]);
    let weights: __m256i = bytemuck::cast(block.weights);
    let between = |from: __m256i, step: __m256i, weight: __m256i| {
        _mm256_add_epi16(from, _mm256_mulhrs_epi16(step, weight))
    };
    // Loops, since a closure that is called twice would be a function whose registers go through memory.
    // Of one pixel in each half: its upper row, then its lower one.
    let mut rows = [_mm256_setzero_si256(); 4];
    for (ix, mixed) in rows.iter_mut().enumerate() {
        let places = [(ix, 0), (ix, row_bytes), (4 + ix, 0), (4 + ix, row_bytes)];
        let [a, b, c, d] =
            places.map(|(ix, further)| two(source, block.offsets[ix] as usize + further) as i64);
        let pixels = _mm256_set_epi64x(d, c, b, a);
        let from = _mm256_shuffle_epi8(pixels, left);
        let to = _mm256_shuffle_epi8(pixels, right);
        let step = _mm256_slli_epi16::<{ LEVEL_BITS as i32 }>(_mm256_sub_epi16(to, from));
        let from = _mm256_slli_epi16::<{ LEVEL_BITS as i32 }>(from);
        let weight = _mm256_set1_epi16(0x0100 + 0x0202 * ix as i16);
        *mixed = between(from, step, _mm256_shuffle_epi8(weights, weight));
    }
    // Of two pixels in each half.
    let mut pairs = [_mm256_setzero_si256(); 2];
    for (ix, mixed) in pairs.iter_mut().enumerate() {
        let upper = _mm256_unpacklo_epi64(rows[2 * ix], rows[2 * ix + 1]);
        let lower = _mm256_unpackhi_epi64(rows[2 * ix], rows[2 * ix + 1]);
        let step = _mm256_sub_epi16(lower, upper);
        let four_times = |bytes: i64| bytes * 0x0001_0001_0001_0001;
        let first = 0x0908 + 0x0404 * ix as i64;
        let (first, second) = (four_times(first), four_times(first + 0x0202));
        let weight = _mm256_set_epi64x(second, first, second, first);
        let exact = between(upper, step, _mm256_shuffle_epi8(weights, weight));
        // Half of it added, then seven bits shifted out.
        *mixed = _mm256_mulhrs_epi16(exact, _mm256_set1_epi16(1 << (15 - LEVEL_BITS)));
    }
    let four = _mm256_packus_epi16(pairs[0], pairs[1]);
    let three = both([0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -1, -1, -1, -1]);
    let joined = _mm256_setr_epi32(0, 1, 2, 4, 5, 6, 3, 7);
    let packed = _mm256_permutevar8x32_epi32(_mm256_shuffle_epi8(four, three), joined);
    let bytes: [u8; 32] = bytemuck::cast(packed);
    *bytes.first_chunk().expect("32 bytes")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise is the hardest image: neighbours differ by up to 255.
    fn noise(n_bytes: usize) -> Vec<u8> {
        let mut state = 1_u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        (0..n_bytes).map(|_| next()).collect()
    }

    #[test]
    fn vectors_and_single_numbers_give_equal_pixels() {
        let (width_px, height_px) = (53, 29);
        let table = Table::new((width_px, height_px), |x, y| {
            let (x, y) = (f64::from(x), f64::from(y));
            Some((0.93 * x + 0.11 * y, 0.9 * y + 0.07 * x))
        })
        .unwrap();
        let bytes = noise(3 * 53 * 29 + PAD_BYTES);
        let mut found = vec![0; 3 * 53 * 29];
        mix_all(&bytes, 3 * 53, &table.blocks, &mut found);
        let expected = table
            .blocks
            .iter()
            .flat_map(|block| mix(&bytes, 3 * 53, block));
        assert!(found.iter().copied().eq(expected.take(found.len())));
    }

    #[test]
    fn whole_steps_copy_pixels_and_the_rim_holds() {
        let table = Table::new((5, 3), |x, y| Some((f64::from(x) + 1.0, f64::from(y)))).unwrap();
        let pixels = noise(3 * 5 * 3);
        let mut image = RgbImage {
            width_px: 5,
            height_px: 3,
            pixels: pixels.clone(),
        };
        let mut out = crate::limits::empty();
        table.remap(&mut image, &mut out);
        assert_eq!(image.pixels, pixels);
        for (row, from) in out.pixels.chunks_exact(15).zip(pixels.chunks_exact(15)) {
            assert_eq!(row[..12], from[3..]);
            assert_eq!(row[12..], from[12..]);
        }
    }
}
