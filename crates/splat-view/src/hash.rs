//! Sums that say whether a client holds the splats that the server has sent. They find mistakes, not attackers.

/// Of both sums.
const SEEDS: [u32; 2] = [0x811c_9dc5, 0x9e37_79b9];

/// Of a splat, or of the sum of many: addition modulo 2^32, so that their order does not count.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Hash(pub [u32; 2]);

impl Hash {
    /// Of the words of one splat, its id first.
    pub fn of(words: &(impl Iterator<Item = u32> + Clone)) -> Self {
        Self(SEEDS.map(|seed| mixed(words.clone().fold(seed, step))))
    }
}

impl std::ops::Add for Hash {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self([0, 1].map(|k| self.0[k].wrapping_add(other.0[k])))
    }
}

impl std::iter::Sum for Hash {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |sum, one| sum + one)
    }
}

fn step(x: u32, word: u32) -> u32 {
    let x = (x ^ word).wrapping_mul(0x0100_0193);
    x ^ (x >> 15)
}

/// The last mixing of MurmurHash3.
fn mixed(x: u32) -> u32 {
    let x = (x ^ (x >> 16)).wrapping_mul(0x85eb_ca6b);
    let x = (x ^ (x >> 13)).wrapping_mul(0xc2b2_ae35);
    x ^ (x >> 16)
}
