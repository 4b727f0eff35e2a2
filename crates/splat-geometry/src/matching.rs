//! Two sets of descriptors -> pairs that are mutually nearest and, where the kind allows, clearly better than the second.
//!
//! Knows nothing of images or cameras. Integer arithmetic, so the result is the same on every machine.

mod lanes;

mod bytes;

use std::hint::black_box;

use crate::features::descriptor::{Descriptors, SIFT_LENGTH, XFEAT_LENGTH};
use crate::matching::bytes::Bytes;
use crate::matching::lanes::{HALVES, LANES, Lanes, NO_LANES, ROWS, WIDE};

/// SIFT: highest ratio of the nearest to the second nearest distance (Lowe 2004, section 7.1).
const MAX_RATIO: f64 = 0.8;
/// SIFT: highest distance of a match as a share of a descriptor's length; unrelated ones are about 0.7 apart.
const MAX_DISTANCE: f64 = 0.645;
/// ORB: highest ratio of differing bits, in percent, and the highest number of them; unrelated ones differ in 128.
const MAX_BITS_RATIO_PERCENT: u32 = 80;
const MAX_BITS: u32 = 64;
/// XFeat: lowest cosine of a match (Potje 2024 use it for their sparse matches); the network is not made for a ratio.
const MIN_COSINE: f64 = 0.82;

const BITS: u16 = 256;

/// Descriptors laid out for comparing all with all. Those of different kinds never match.
#[derive(Debug, Clone)]
pub enum PreparedDescriptors {
    Sift(Bytes),
    Orb(Bits),
    Xfeat(Words<64>),
}

/// Vectors of `N` words whose products with each other stay within 16 bits, so that sums may wrap on the way.
#[derive(Debug, Clone)]
pub struct Words<const N: usize> {
    len: usize,
    /// `N` in a row belong to one group of rows; the last group is filled up with zeros.
    rows: Vec<[u16; ROWS]>,
    /// `N` in a row belong to one block of columns.
    columns: Vec<Lanes>,
}

#[derive(Debug, Clone)]
pub struct Bits {
    rows: Vec<[u8; 32]>,
    columns: Vec<[[u8; LANES]; 32]>,
}

impl PreparedDescriptors {
    pub fn new(descriptors: &Descriptors) -> Self {
        match descriptors {
            Descriptors::Sift(all) => Self::Sift(Bytes::new(all)),
            Descriptors::Orb(all) => Self::Orb(Bits::new(all)),
            Descriptors::Xfeat(all) => {
                let square = |row: &[i16; 64]| row.iter().map(|v| i32::from(*v).pow(2)).sum();
                let longest: i32 = all.iter().map(square).max().unwrap_or(0);
                assert!(
                    longest <= i32::from(i16::MAX),
                    "products of XFeat descriptors pass 16 bits"
                );
                let rows: Vec<[u16; 64]> = all.iter().map(|d| d.map(i16::cast_unsigned)).collect();
                Self::Xfeat(Words::new(&rows))
            }
        }
    }
}

impl<const N: usize> Words<N> {
    fn new(all: &[[u16; N]]) -> Self {
        let mut rows = vec![[0; ROWS]; N * all.len().div_ceil(ROWS)];
        let mut columns = vec![NO_LANES; N * all.len().div_ceil(LANES)];
        for (i, words) in all.iter().enumerate() {
            let group = &mut rows[i / ROWS * N..][..N];
            let block = &mut columns[i / LANES * N..][..N];
            for ((&word, row), column) in words.iter().zip(group).zip(block) {
                row[i % ROWS] = word;
                column.as_flattened_mut()[i % LANES] = word;
            }
        }
        Self {
            len: all.len(),
            rows,
            columns,
        }
    }
}

impl Bits {
    fn new(all: &[[u64; 4]]) -> Self {
        let bytes = |words: &[u64; 4]| {
            let mut out = [0; 32];
            let all = words.iter().flat_map(|word| word.to_le_bytes());
            out.iter_mut().zip(all).for_each(|(o, byte)| *o = byte);
            out
        };
        let rows: Vec<[u8; 32]> = all.iter().map(bytes).collect();
        let mut columns = vec![[[0; LANES]; 32]; rows.len().div_ceil(LANES)];
        for (j, row) in rows.iter().enumerate() {
            for (lanes, &byte) in columns[j / LANES].iter_mut().zip(row) {
                lanes[j % LANES] = byte;
            }
        }
        Self { rows, columns }
    }
}

/// What a descriptor is most like; `likeness` 0 is nothing at all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Nearest {
    ix: u32,
    likeness: u16,
    second: u16,
}

impl Nearest {
    fn is_clear_sift(&self) -> bool {
        let square = |likeness: u16| {
            let twice = 2.0 * (f64::from(SIFT_LENGTH).powi(2) - f64::from(likeness));
            twice.max(0.0)
        };
        let (best, second) = (square(self.likeness), square(self.second));
        let highest = (MAX_DISTANCE * f64::from(SIFT_LENGTH)).powi(2);
        best <= highest && best < MAX_RATIO * MAX_RATIO * second
    }

    fn is_clear_orb(&self) -> bool {
        let bits = |likeness: u16| u32::from(BITS - likeness);
        let (best, second) = (bits(self.likeness), bits(self.second));
        best <= MAX_BITS && 100 * best < MAX_BITS_RATIO_PERCENT * second
    }

    fn is_clear_xfeat(&self) -> bool {
        let dot = f64::from(self.likeness) - f64::from(SIGNED_ZERO);
        dot > MIN_COSINE * f64::from(XFEAT_LENGTH).powi(2)
    }
}

/// Likeness of two XFeat descriptors at a right angle.
const SIGNED_ZERO: u16 = 1 << 15;

/// Pairs (index in `a`, index in `b`), in order of `a`.
pub fn matches(a: &PreparedDescriptors, b: &PreparedDescriptors) -> Vec<(u32, u32)> {
    type IsClear = fn(&Nearest) -> bool;
    let ((rows, columns), is_clear): (_, IsClear) = match (a, b) {
        (PreparedDescriptors::Sift(a), PreparedDescriptors::Sift(b)) => {
            (nearest_sift(a, b), Nearest::is_clear_sift)
        }
        (PreparedDescriptors::Orb(a), PreparedDescriptors::Orb(b)) => {
            (nearest_orb(a, b), Nearest::is_clear_orb)
        }
        (PreparedDescriptors::Xfeat(a), PreparedDescriptors::Xfeat(b)) => {
            (nearest_xfeat(a, b), Nearest::is_clear_xfeat)
        }
        _ => return Vec::new(),
    };
    let mutual = |(i, row): (usize, &Nearest)| {
        let back = columns.get(row.ix as usize)?;
        (back.ix == i as u32 && is_clear(row)).then_some((i as u32, row.ix))
    };
    rows.iter().enumerate().filter_map(mutual).collect()
}

type BothWays = (Vec<Nearest>, Vec<Nearest>);

#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn nearest_sift(a: &Bytes, b: &Bytes) -> BothWays {
    nearest((a.len, b.len), |group, block| {
        multiversion::target::match_target! {
            "x86_64+avx2" => bytes::products_avx2((a, group), (b, block)),
            _ => bytes::products((a, group), (b, block)),
        }
    })
}

#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn nearest_xfeat(a: &Words<64>, b: &Words<64>) -> BothWays {
    nearest((a.len, b.len), |group, block| {
        products((a, group), (b, block), SIGNED_ZERO)
    })
}

#[multiversion::multiversion(targets("x86_64+avx2+popcnt", "aarch64+neon"))]
fn nearest_orb(a: &Bits, b: &Bits) -> BothWays {
    nearest((a.rows.len(), b.rows.len()), |group, block| {
        std::array::from_fn(|r| match a.rows.get(group * ROWS + r) {
            Some(row) => equal_bits(row, &b.columns[block]),
            None => NO_LANES,
        })
    })
}

/// How many of 256 bits agree; a descriptor and its opposite are taken for one bit less.
#[inline(always)]
fn equal_bits(row: &[u8; 32], columns: &[[u8; LANES]; 32]) -> Lanes {
    let mut differing = [0_u8; LANES];
    let (row, columns) = (black_box(&row[..]), black_box(&columns[..]));
    let mut k = 0;
    while let (Some(byte), Some(others)) = (row.get(k), columns.get(k)) {
        for (sum, other) in differing.iter_mut().zip(others) {
            *sum = sum.saturating_add((byte ^ other).count_ones() as u8);
        }
        k += 1;
    }
    let inliers = |lane: usize| BITS - u16::from(differing[lane]);
    std::array::from_fn(|half| std::array::from_fn(|lane| inliers(half * WIDE + lane)))
}

/// Dot products of `ROWS` rows with a block of columns, counted from `zero`. Only the low 16 bits are kept on the way: what the length of the
/// descriptors bounds at the end may pass any bound before, and a 16-bit multiply needs no sum across lanes.
#[inline(always)]
fn products<const N: usize>(
    (a, group): (&Words<N>, usize),
    (b, block): (&Words<N>, usize),
    zero: u16,
) -> [Lanes; ROWS] {
    let mut sums = [[[zero; WIDE]; HALVES]; ROWS];
    // Where the compiler knows how often the loop runs, it gives the lanes to the loop instead of the columns, and with
    // iterators over rows and halves it gives them to nobody: 6 and 12 times slower.
    let rows = black_box(&a.rows[group * N..][..N]);
    let columns = black_box(&b.columns[block * N..][..N]);
    let mut k = 0;
    while let (Some(row), Some(column)) = (rows.get(k), columns.get(k)) {
        for r in 0..ROWS {
            for half in 0..HALVES {
                add_scaled(&mut sums[r][half], row[r], &column[half]);
            }
        }
        k += 1;
    }
    sums
}

#[inline(always)]
fn add_scaled(sum: &mut [u16; WIDE], word: u16, others: &[u16; WIDE]) {
    for (s, other) in sum.iter_mut().zip(others) {
        *s = s.wrapping_add(word.wrapping_mul(*other));
    }
}

/// The best of many offers and the runner-up, `LANES` times side by side.
#[derive(Clone, Copy)]
struct Race {
    ix: Lanes,
    best: Lanes,
    second: Lanes,
}

const NO_RACE: Race = Race {
    ix: NO_LANES,
    best: NO_LANES,
    second: NO_LANES,
};

impl Race {
    /// Written without branches on copies: only so it stays in registers.
    #[inline(always)]
    fn offer(&mut self, ix: u16, offers: &Lanes) {
        for (half, offers) in offers.iter().enumerate() {
            let (best, second, named) = (self.best[half], self.second[half], self.ix[half]);
            let mut next = (best, second, named);
            for lane in 0..WIDE {
                let (offer, best) = (offers[lane], best[lane]);
                next.0[lane] = best.max(offer);
                next.1[lane] = second[lane].max(offer.min(best));
                let wins = u16::from(offer > best).wrapping_neg();
                next.2[lane] = (named[lane] & !wins) | (ix & wins);
            }
            (self.best[half], self.second[half], self.ix[half]) = next;
        }
    }
}

/// For every row its nearest column and the other way round; equals are won by the lower index.
#[inline(always)]
fn nearest(
    (n_rows, n_columns): (usize, usize),
    likeness: impl Fn(usize, usize) -> [Lanes; ROWS],
) -> BothWays {
    assert!(
        n_rows.max(n_columns) <= usize::from(u16::MAX),
        "indices pass 16 bits"
    );
    let mut races = vec![NO_RACE; n_rows.next_multiple_of(ROWS)];
    let mut columns = Vec::with_capacity(n_columns);
    // A block of columns stays in the first cache while all rows pass.
    for block in 0..n_columns.div_ceil(LANES) {
        let n_lanes = LANES.min(n_columns - block * LANES);
        let mut down = NO_RACE;
        for (group, races) in races.chunks_exact_mut(ROWS).enumerate() {
            let mut alike = likeness(group, block);
            if n_lanes < LANES {
                alike
                    .iter_mut()
                    .for_each(|offers| offers.as_flattened_mut()[n_lanes..].fill(0));
            }
            let first = group * ROWS;
            if first + ROWS > n_rows {
                alike[n_rows - first..].fill(NO_LANES);
            }
            for (r, (race, offers)) in races.iter_mut().zip(&alike).enumerate() {
                race.offer(block as u16, offers);
                down.offer((first + r) as u16, offers);
            }
        }
        columns.extend((0..n_lanes).map(|lane| down.winner(lane, 1, 0)));
    }
    let across = |race: &Race| {
        (0..LANES)
            .map(|lane| race.winner(lane, LANES as u32, lane as u32))
            .reduce(Nearest::or)
            .unwrap_or(NOBODY)
    };
    (races[..n_rows].iter().map(across).collect(), columns)
}

const NOBODY: Nearest = Nearest {
    ix: u32::MAX,
    likeness: 0,
    second: 0,
};

impl Race {
    /// Who leads in a lane, where an index of the race stands for `step` times itself and `offset`.
    fn winner(&self, lane: usize, step: u32, offset: u32) -> Nearest {
        let at = |lanes: &Lanes| lanes.as_flattened()[lane];
        match at(&self.best) {
            0 => NOBODY,
            likeness => Nearest {
                ix: u32::from(at(&self.ix)) * step + offset,
                likeness,
                second: at(&self.second),
            },
        }
    }
}

impl Nearest {
    fn or(self, other: Self) -> Self {
        let is_first = (self.likeness, other.ix) > (other.likeness, self.ix);
        let (winner, loser) = if is_first {
            (self, other)
        } else {
            (other, self)
        };
        Self {
            second: winner.second.max(loser.likeness),
            ..winner
        }
    }
}

#[cfg(test)]
mod tests;
