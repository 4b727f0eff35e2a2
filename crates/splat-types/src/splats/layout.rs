//! Splats <-> little-endian bytes: the one layout that messages, checkpoints and the map's hash share.
//!
//! A run of n splats is seven arrays, one behind the other, each for all n splats: means 3 f32, log-scales 3 f32,
//! quaternions w x y z 4 f32, opacity logits 1 f32, SH `3 * (degree + 1)^2` f32, anchors 1 u32. docs/FORMATS.md.

use std::fmt::Write as _;
use std::ops::Range;

use byteorder::{ByteOrder, LittleEndian};
use sha2::{Digest, Sha256};

use crate::splats::splats::Splats;

pub const MAX_SH_DEGREE: u8 = 3;

/// Numbers of 4 bytes per splat besides SH: means, log-scales, quaternion, opacity logit, anchor.
const N_PLAIN: usize = 3 + 3 + 4 + 1 + 1;

/// Numbers that the hash takes in at once; a multiple of no array's width, so nothing may depend on it.
const HASHED_AT_ONCE: usize = 1 << 14;

pub fn bytes_per_splat(sh_degree: u8) -> usize {
    4 * (N_PLAIN + 3 * (usize::from(sh_degree) + 1).pow(2))
}

/// Appends the splats of a range.
pub fn encode(splats: &Splats, range: Range<usize>, out: &mut Vec<u8>) {
    out.reserve(range.len() * bytes_per_splat(splats.sh_degree));
    for numbers in float_arrays(splats, &range) {
        push_floats(numbers, out);
    }
    push_words(&splats.anchors[range], out);
}

/// Appends the splats in `bytes` to those in `splats`, which states the SH degree. `None` when the bytes are no
/// whole number of splats; nothing is appended then.
pub fn decode(bytes: &[u8], splats: &mut Splats) -> Option<usize> {
    let n = bytes.len() / bytes_per_splat(splats.sh_degree);
    if n * bytes_per_splat(splats.sh_degree) != bytes.len() {
        return None;
    }
    let mut rest = bytes;
    append_rows(&mut splats.means, take(&mut rest, n * 3));
    append_rows(&mut splats.log_scales, take(&mut rest, n * 3));
    append_rows(&mut splats.quats, take(&mut rest, n * 4));
    append_floats(&mut splats.opacity_logits, take(&mut rest, n));
    let sh_stride = splats.sh_stride();
    append_floats(&mut splats.sh, take(&mut rest, n * sh_stride));
    let first = splats.anchors.len();
    splats.anchors.resize(first + n, 0);
    LittleEndian::read_u32_into(rest, &mut splats.anchors[first..]);
    Some(n)
}

/// SHA-256 over the number of splats (u64), the SH degree (u32) and the seven arrays of all splats.
pub fn digest(splats: &Splats) -> [u8; 32] {
    let mut hash = Sha256::new();
    hash.update((splats.len() as u64).to_le_bytes());
    hash.update(u32::from(splats.sh_degree).to_le_bytes());
    let mut bytes = Vec::with_capacity(4 * HASHED_AT_ONCE);
    for numbers in float_arrays(splats, &(0..splats.len())) {
        for some in numbers.chunks(HASHED_AT_ONCE) {
            bytes.clear();
            push_floats(some, &mut bytes);
            hash.update(&bytes);
        }
    }
    for some in splats.anchors.chunks(HASHED_AT_ONCE) {
        bytes.clear();
        push_words(some, &mut bytes);
        hash.update(&bytes);
    }
    hash.finalize().into()
}

/// `digest` as 64 hexadecimal digits, for `report.json`: equal exactly when the maps are equal, bit for bit.
pub fn map_sha256(splats: &Splats) -> String {
    digest(splats)
        .iter()
        .fold(String::with_capacity(64), |mut hex, byte| {
            write!(hex, "{byte:02x}").expect("writing to a string cannot fail");
            hex
        })
}

/// What is wrong with splats that came from outside: array lengths that disagree, numbers that are not finite.
pub fn fault(splats: &Splats) -> Option<String> {
    if splats.sh_degree > MAX_SH_DEGREE {
        return Some(format!(
            "SH degree {}, expected 0 to {MAX_SH_DEGREE}",
            splats.sh_degree
        ));
    }
    let n = splats.len();
    let lengths = [
        ("log_scales", splats.log_scales.len(), n),
        ("quats", splats.quats.len(), n),
        ("opacity_logits", splats.opacity_logits.len(), n),
        ("sh", splats.sh.len(), n * splats.sh_stride()),
        ("anchors", splats.anchors.len(), n),
    ];
    if let Some((name, found, expected)) = lengths
        .iter()
        .find(|(_, found, expected)| found != expected)
    {
        return Some(format!(
            "{name} holds {found} entries for {n} splats, expected {expected}"
        ));
    }
    let names = ["means", "log_scales", "quats", "opacity_logits", "sh"];
    for (name, numbers) in names.iter().zip(float_arrays(splats, &(0..n))) {
        if let Some(ix) = numbers.iter().position(|v| !v.is_finite()) {
            let splat_ix = ix / (numbers.len() / n);
            return Some(format!("{name} of splat {splat_ix} is {}", numbers[ix]));
        }
    }
    let lost = splats
        .quats
        .iter()
        .position(|q| q.iter().all(|v| *v == 0.0));
    lost.map(|splat_ix| format!("quaternion of splat {splat_ix} has no length"))
}

fn float_arrays<'a>(splats: &'a Splats, range: &Range<usize>) -> [&'a [f32]; 5] {
    let sh_stride = splats.sh_stride();
    [
        splats.means[range.clone()].as_flattened(),
        splats.log_scales[range.clone()].as_flattened(),
        splats.quats[range.clone()].as_flattened(),
        &splats.opacity_logits[range.clone()],
        &splats.sh[range.start * sh_stride..range.end * sh_stride],
    ]
}

fn push_floats(numbers: &[f32], out: &mut Vec<u8>) {
    let first = out.len();
    out.resize(first + 4 * numbers.len(), 0);
    LittleEndian::write_f32_into(numbers, &mut out[first..]);
}

fn push_words(numbers: &[u32], out: &mut Vec<u8>) {
    let first = out.len();
    out.resize(first + 4 * numbers.len(), 0);
    LittleEndian::write_u32_into(numbers, &mut out[first..]);
}

fn take<'a>(bytes: &mut &'a [u8], n_numbers: usize) -> &'a [u8] {
    let (head, tail) = bytes.split_at(4 * n_numbers);
    *bytes = tail;
    head
}

fn append_floats(numbers: &mut Vec<f32>, bytes: &[u8]) {
    let first = numbers.len();
    numbers.resize(first + bytes.len() / 4, 0.0);
    LittleEndian::read_f32_into(bytes, &mut numbers[first..]);
}

fn append_rows<const WIDTH: usize>(rows: &mut Vec<[f32; WIDTH]>, bytes: &[u8]) {
    let first = rows.len();
    rows.resize(first + bytes.len() / (4 * WIDTH), [0.0; WIDTH]);
    LittleEndian::read_f32_into(bytes, rows[first..].as_flattened_mut());
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_splats() -> Splats {
        Splats {
            means: vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
            log_scales: vec![[-1.0; 3], [-2.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.5, 0.5]],
            opacity_logits: vec![0.25, -0.25],
            sh: vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
            sh_degree: 0,
            anchors: vec![7, 9],
        }
    }

    #[test]
    fn bytes_stand_in_the_stated_order() {
        let mut bytes = Vec::new();
        encode(&two_splats(), 1..2, &mut bytes);
        let words: Vec<f32> = bytes[..56].chunks(4).map(LittleEndian::read_f32).collect();
        assert_eq!(
            words,
            [
                4.0, 5.0, 6.0, -2.0, -2.0, -2.0, 0.5, 0.5, 0.5, 0.5, -0.25, 0.4, 0.5, 0.6
            ]
        );
        assert_eq!(bytes[56..], [9, 0, 0, 0]);
    }

    #[test]
    fn pieces_read_back_in_order_give_the_whole() {
        let splats = two_splats();
        let mut back = Splats::default();
        for ix in 0..2 {
            let mut bytes = Vec::new();
            encode(&splats, ix..ix + 1, &mut bytes);
            assert_eq!(decode(&bytes, &mut back), Some(1));
            assert_eq!(decode(&bytes[1..], &mut back), None);
        }
        assert_eq!(back, splats);
    }

    #[test]
    fn one_flipped_bit_anywhere_changes_the_hash() {
        let splats = two_splats();
        let mut hashes = vec![map_sha256(&splats)];
        let changes: [fn(&mut Splats); 6] = [
            |s| s.means[1][2] = -6.0,
            |s| s.log_scales[0][0] = -1.000_000_1,
            |s| s.quats[0][0] = -1.0,
            |s| s.opacity_logits[1] = 0.25,
            |s| s.sh[5] = 0.7,
            |s| s.anchors[0] = 8,
        ];
        for change in changes {
            let mut other = splats.clone();
            change(&mut other);
            hashes.push(map_sha256(&other));
        }
        hashes.sort();
        hashes.dedup();
        assert_eq!(hashes.len(), 7);
    }

    /// Computed apart from this code, with Python: `hashlib.sha256(struct.pack('<QI28fII', ...))`.
    #[test]
    fn the_hash_is_the_documented_one() {
        assert_eq!(
            map_sha256(&two_splats()),
            "3a696fd9f924736ed34a86a844bb6a9c251bcc9ab35a180389f36b22ec38ca6c"
        );
    }

    #[test]
    fn faults_name_the_array_and_the_splat() {
        assert_eq!(fault(&two_splats()), None);
        let mut splats = two_splats();
        splats.quats[1][3] = f32::NAN;
        assert_eq!(fault(&splats).unwrap(), "quats of splat 1 is NaN");
        splats.anchors.pop();
        assert_eq!(
            fault(&splats).unwrap(),
            "anchors holds 1 entries for 2 splats, expected 2"
        );
    }
}
