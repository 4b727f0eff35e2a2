//! Compressed PLY (PlayCanvas, SuperSplat, Spark): 16 bytes a splat, and a byte for each higher harmonic.
//!
//! 256 splats that lie near each other share the ranges of their means, log-scales and colours; a splat is four words within them: mean 11-10-11
//! bits, quaternion 2-10-10-10 (which of w x y z is largest, the other three), log-scale 11-10-11, r g b opacity 8 each. Axes are the map's.

use std::fmt::Write as _;
use std::io::{self, Write};

use crate::formats::axes;
use splat_types::splats::splats::Splats;

/// Splats that share ranges.
const CHUNK: usize = 256;
/// Log-scales beyond it are cut, as the format's other writers do.
const MAX_LOG_SCALE: f32 = 20.0;
/// Bits of a coordinate in the order along which neighbours are found.
const MORTON_BITS: u32 = 10;

/// Writes the whole file to `out`; splats that are not finite are left out.
pub fn write(splats: &Splats, out: &mut dyn Write) -> io::Result<()> {
    let order = near_each_other(splats);
    let n_rest = splats.sh_stride() - 3;
    out.write_all(header(order.len(), n_rest).as_bytes())?;
    let chunks: Vec<Chunk> = order
        .chunks(CHUNK)
        .map(|those| Chunk::of(splats, those))
        .collect();
    for chunk in &chunks {
        for number in chunk.numbers() {
            out.write_all(&number.to_le_bytes())?;
        }
    }
    for (chunk, those) in chunks.iter().zip(order.chunks(CHUNK)) {
        for ix in those {
            for word in chunk.words(splats, *ix) {
                out.write_all(&word.to_le_bytes())?;
            }
        }
    }
    for ix in order.iter().filter(|_| n_rest > 0) {
        let sh = &splats.sh[ix * splats.sh_stride()..][3..3 + n_rest];
        // Channel after channel, as in plain PLY.
        let bytes: Vec<u8> = (0..3)
            .flat_map(|channel| sh.iter().skip(channel).step_by(3))
            .map(|value| ((value / 8.0 + 0.5) * 256.0).clamp(0.0, 255.0) as u8)
            .collect();
        out.write_all(&bytes)?;
    }
    Ok(())
}

fn header(n: usize, n_rest: usize) -> String {
    let mut text = format!(
        "ply\nformat binary_little_endian 1.0\nelement chunk {}\n",
        n.div_ceil(CHUNK)
    );
    let ranges = [
        "x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b",
    ];
    for three in ranges.chunks(3) {
        for end in ["min", "max"] {
            for name in three {
                writeln!(text, "property float {end}_{name}").expect("a String takes everything");
            }
        }
    }
    writeln!(text, "element vertex {n}").expect("a String takes everything");
    for name in ["position", "rotation", "scale", "color"] {
        writeln!(text, "property uint packed_{name}").expect("a String takes everything");
    }
    if n_rest > 0 {
        writeln!(text, "element sh {n}").expect("a String takes everything");
        for k in 0..n_rest {
            writeln!(text, "property uchar f_rest_{k}").expect("a String takes everything");
        }
    }
    text.push_str("end_header\n");
    text
}

/// Finite splats in Morton order of their means.
fn near_each_other(splats: &Splats) -> Vec<usize> {
    let mut order = axes::finite(splats);
    let (low, high) = range(order.iter().map(|ix| splats.means[*ix]));
    let cell = |ix: usize, k: usize| {
        let share = share_of(splats.means[ix][k], low[k], high[k]);
        (share * ((1 << MORTON_BITS) - 1) as f32) as u32
    };
    let code = |ix: usize| {
        let cells: [u32; 3] = std::array::from_fn(|k| cell(ix, k));
        (0..MORTON_BITS).fold(0_u32, |code, bit| {
            let bits = (0..3).fold(0, |bits, k| bits | ((cells[k] >> bit) & 1) << k);
            code | bits << (3 * bit)
        })
    };
    order.sort_by_cached_key(|ix| code(*ix));
    order
}

/// Least and greatest of each of three numbers.
fn range(values: impl Iterator<Item = [f32; 3]>) -> ([f32; 3], [f32; 3]) {
    let empty = ([f32::MAX; 3], [f32::MIN; 3]);
    let (low, high) = values.fold(empty, |(low, high), value| {
        (
            std::array::from_fn(|k| low[k].min(value[k])),
            std::array::from_fn(|k| high[k].max(value[k])),
        )
    });
    if low[0] > high[0] {
        ([0.0; 3], [0.0; 3])
    } else {
        (low, high)
    }
}

fn share_of(value: f32, low: f32, high: f32) -> f32 {
    let width = high - low;
    if width > 0.0 {
        ((value - low) / width).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

fn packed(share: f32, bits: u32) -> u32 {
    let most = (1_u32 << bits) - 1;
    ((share * most as f32 + 0.5) as u32).min(most)
}

fn scales(splats: &Splats, ix: usize) -> [f32; 3] {
    splats.log_scales[ix].map(|v| v.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE))
}

/// Ranges that some splats share: means, log-scales, colours.
struct Chunk {
    low: [[f32; 3]; 3],
    high: [[f32; 3]; 3],
}

impl Chunk {
    fn of(splats: &Splats, those: &[usize]) -> Self {
        let all = || those.iter().copied();
        let ranges = [
            range(all().map(|ix| splats.means[ix])),
            range(all().map(|ix| scales(splats, ix))),
            range(all().map(|ix| axes::base_colour(splats, ix))),
        ];
        Self {
            low: ranges.map(|(low, _)| low),
            high: ranges.map(|(_, high)| high),
        }
    }

    fn numbers(&self) -> impl Iterator<Item = f32> {
        let pairs = self.low.into_iter().zip(self.high);
        pairs.flat_map(|(low, high)| low.into_iter().chain(high))
    }

    fn words(&self, splats: &Splats, ix: usize) -> [u32; 4] {
        let shares = |kind: usize, value: [f32; 3]| -> [f32; 3] {
            std::array::from_fn(|k| share_of(value[k], self.low[kind][k], self.high[kind][k]))
        };
        let word_of =
            |[a, b, c]: [f32; 3]| packed(a, 11) << 21 | packed(b, 10) << 11 | packed(c, 11);
        let colour = shares(2, axes::base_colour(splats, ix));
        let opacity = axes::opacity(splats.opacity_logits[ix]);
        let colour = colour.iter().fold(0, |word, v| word << 8 | packed(*v, 8));
        [
            word_of(shares(0, splats.means[ix])),
            rotation(axes::unit_quat(splats.quats[ix])),
            word_of(shares(1, scales(splats, ix))),
            colour << 8 | packed(opacity, 8),
        ]
    }
}

/// The largest of w x y z is known from the others: the length is 1, and its sign is made positive.
fn rotation(quat: [f32; 4]) -> u32 {
    let largest = (1..4).fold(0, |best, k| {
        if quat[k].abs() > quat[best].abs() {
            k
        } else {
            best
        }
    });
    let sign = if quat[largest] < 0.0 { -1.0 } else { 1.0 };
    let others = (0..4).filter(|k| *k != largest);
    others.fold(largest as u32, |word, k| {
        let share = sign * quat[k] * std::f32::consts::FRAC_1_SQRT_2 + 0.5;
        word << 10 | packed(share.clamp(0.0, 1.0), 10)
    })
}
