//! SPZ (Niantic): 19 bytes a splat and one for each higher harmonic, compressed. Version 3 is one gzip stream, which web viewers read; version 4 has a
//! zstd stream for each kind of number.
//!
//! Means in 24-bit steps of 2^-12 (coarser where the map is wider), opacity, colour and log-scale in bytes, the quaternion in 32 bits, harmonics
//! in 5 bits (degree 1) or 4. Axes: x right, y up, z back. Facts from the reference program's description of its format.

use std::io::{self, Read, Write};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

use crate::formats::axes::{self, Axes};
use splat_types::splats::splats::Splats;

const MAGIC: u32 = 0x5053_474e;
const HEADER_3: usize = 16;
const HEADER_4: usize = 32;
const AXES: Axes = Axes::RightUpBack;
/// Binary digits of a mean behind the point, where the map allows it.
const FRACTION_BITS: u8 = 12;
const MAX_24: f32 = 8_388_607.0;
/// Of the reference program's colours: bytes reach 1 / (2 * 0.15) on either side of grey.
const COLOUR_SCALE: f32 = 0.15;
/// Levels of zstd and gzip: both are near their best there, and a map is written once.
const ZSTD_LEVEL: i32 = 12;
/// Splats that a file may have, and bytes in memory for each one that its own size must vouch for: 1,024 to 1 is more than deflate reaches.
const MAX_SPLATS: u32 = 50_000_000;
const MAX_RATIO: u64 = 1024;
/// Bytes behind the splats that are read on the way to the checksum.
const MAX_EXTENSION: u64 = 1 << 20;
const MAX_DEGREE: u8 = 3;

/// Which SPZ is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpzVersion {
    V3,
    V4,
}

/// Bytes of each kind of number: means, opacities, colours, log-scales, quaternions, harmonics.
type Parts = [Vec<u8>; 6];

/// Writes the whole file to `out`; splats that are not finite are left out.
pub fn write(splats: &Splats, version: SpzVersion, out: &mut dyn Write) -> io::Result<()> {
    let order = axes::finite(splats);
    let bits = fraction_bits(splats, &order);
    let parts = parts_of(splats, &order, bits);
    let n = u32::try_from(order.len()).map_err(io::Error::other)?;
    let degree = splats.sh_degree;
    let mut header = Vec::new();
    header.extend(MAGIC.to_le_bytes());
    match version {
        SpzVersion::V3 => {
            header.extend(3_u32.to_le_bytes());
            header.extend(n.to_le_bytes());
            header.extend([degree, bits, 0, 0]);
            let mut gzip = GzEncoder::new(out, Compression::best());
            gzip.write_all(&header)?;
            for part in &parts {
                gzip.write_all(part)?;
            }
            gzip.finish()?;
        }
        SpzVersion::V4 => {
            let streams: Vec<(usize, Vec<u8>)> = parts
                .iter()
                .filter(|part| !part.is_empty())
                .map(|part| Ok((part.len(), zstd::bulk::compress(part, ZSTD_LEVEL)?)))
                .collect::<io::Result<_>>()?;
            header.extend(4_u32.to_le_bytes());
            header.extend(n.to_le_bytes());
            header.extend([degree, bits, 0, streams.len() as u8]);
            header.extend((HEADER_4 as u32).to_le_bytes());
            header.resize(HEADER_4, 0);
            for (size, packed) in &streams {
                header.extend((packed.len() as u64).to_le_bytes());
                header.extend((*size as u64).to_le_bytes());
            }
            out.write_all(&header)?;
            for (_, packed) in &streams {
                out.write_all(packed)?;
            }
        }
    }
    Ok(())
}

/// As many as the farthest mean leaves room for.
fn fraction_bits(splats: &Splats, order: &[usize]) -> u8 {
    let means = order.iter().flat_map(|ix| splats.means[*ix]);
    let farthest = means.fold(0.0_f32, |far, v| far.max(v.abs()));
    let fits = |bits: &u8| farthest * (f32::from(*bits)).exp2() < MAX_24;
    (0..=FRACTION_BITS).rev().find(fits).unwrap_or(0)
}

fn parts_of(splats: &Splats, order: &[usize], bits: u8) -> Parts {
    let mut parts = Parts::default();
    let steps = f32::from(bits).exp2();
    let byte = |value: f32| value.round().clamp(0.0, 255.0) as u8;
    for ix in order.iter().copied() {
        for value in AXES.mean(splats.means[ix]) {
            let fixed = (value * steps).round().clamp(-MAX_24, MAX_24) as i32;
            parts[0].extend(&fixed.to_le_bytes()[..3]);
        }
        parts[1].push(byte(255.0 * axes::opacity(splats.opacity_logits[ix])));
        let sh = &splats.sh[ix * splats.sh_stride()..][..splats.sh_stride()];
        parts[2].extend(
            sh[..3]
                .iter()
                .map(|v| byte(v * COLOUR_SCALE * 255.0 + 127.5)),
        );
        parts[3].extend(splats.log_scales[ix].map(|v| byte((v + 10.0) * 16.0)));
        parts[4].extend(packed_quat(AXES.quat(axes::unit_quat(splats.quats[ix]))).to_le_bytes());
        parts[5].extend(sh[3..].iter().enumerate().map(|(at, value)| {
            let k = 1 + at / 3;
            packed_harmonic(AXES.sh_sign(k) * value, k)
        }));
    }
    parts
}

/// Which of x y z w is largest in the upper two bits; of each other one a sign and nine bits of its size over 1 / sqrt 2.
fn packed_quat([w, x, y, z]: [f32; 4]) -> u32 {
    let quat = [x, y, z, w];
    let largest = (1..4).fold(0, |best, k| {
        if quat[k].abs() > quat[best].abs() {
            k
        } else {
            best
        }
    });
    let is_turned = quat[largest] < 0.0;
    let others = (0..4).filter(|k| *k != largest);
    others.fold(largest as u32, |word, k| {
        let size = (511.0 * quat[k].abs() * std::f32::consts::SQRT_2 + 0.5) as u32;
        let sign = u32::from((quat[k] < 0.0) != is_turned);
        word << 10 | sign << 9 | size.min(511)
    })
}

fn unpacked_quat(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut quat = [0.0; 4];
    let mut squares = 0.0;
    let others = (0..4).rev().filter(|k| *k != largest);
    for (place, k) in others.enumerate() {
        let part = word >> (10 * place);
        let size = (part & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
        quat[k] = if part & 512 != 0 { -size } else { size };
        squares += size * size;
    }
    quat[largest] = (1.0_f32 - squares).max(0.0).sqrt();
    let [x, y, z, w] = quat;
    [w, x, y, z]
}

/// Harmonic `k` in steps of 8 (degree 1) or 16 of 256, around 128.
fn packed_harmonic(value: f32, k: usize) -> u8 {
    let step = if k < 4 { 8 } else { 16 };
    let whole = (value * 128.0).round().clamp(-128.0, 127.0) as i32 + 128;
    ((whole + step / 2) / step * step).clamp(0, 255) as u8
}

/// Whether the first bytes of a file are those of an SPZ of version 4, or of a gzip stream, which versions before it are.
pub fn is_spz(first: &[u8]) -> bool {
    first.starts_with(&MAGIC.to_le_bytes()) || first.starts_with(&[0x1f, 0x8b])
}

/// What a header says.
struct Header {
    n: usize,
    degree: u8,
    bits: u8,
    version: u32,
}

impl Header {
    fn n_bytes(&self) -> [usize; 6] {
        let n_rest = 3 * (usize::from(self.degree) + 1).pow(2) - 3;
        let of_quat = if self.version < 3 { 3 } else { 4 };
        [9, 1, 3, 3, of_quat, n_rest].map(|each| each * self.n)
    }
}

/// Reads versions 2 to 4. Asks for no more memory than the file's size can stand for.
pub fn read(file: &[u8]) -> Result<Splats, String> {
    if file.starts_with(&MAGIC.to_le_bytes()) {
        return read_4(file);
    }
    let mut gzip = GzDecoder::new(file);
    let mut first = [0; HEADER_3];
    gzip.read_exact(&mut first)
        .map_err(|e| format!("it is no gzip stream with a header: {e}"))?;
    let header = header_of(&first, file.len(), 2..=3)?;
    let mut parts = Parts::default();
    for (part, n) in parts.iter_mut().zip(header.n_bytes()) {
        // Memory grows with what is there, whatever the header says.
        let found = gzip.by_ref().take(n as u64).read_to_end(part);
        let found = found.map_err(|e| format!("it is damaged: {e}"))?;
        if found != n {
            return Err(format!("it ends before its {} splats do", header.n));
        }
    }
    // The checksum lies behind everything, extensions as well.
    io::copy(&mut gzip.take(MAX_EXTENSION), &mut io::sink())
        .map_err(|e| format!("it is damaged: {e}"))?;
    Ok(splats_of(&header, &parts))
}

fn read_4(file: &[u8]) -> Result<Splats, String> {
    let first = file.get(..HEADER_4).ok_or("it ends within its header")?;
    let header = header_of(first, file.len(), 4..=4)?;
    let n_streams = usize::from(first[15]);
    let word =
        |at: usize| u32::from_le_bytes([first[at], first[at + 1], first[at + 2], first[at + 3]]);
    let mut at = word(16) as usize;
    let sizes = header.n_bytes();
    let wanted = sizes.iter().filter(|n| **n > 0).count();
    if n_streams != wanted {
        return Err(format!("it has {n_streams} streams, expected {wanted}"));
    }
    let table = at
        .checked_add(16 * n_streams)
        .and_then(|end| file.get(at..end));
    let table = table.ok_or("it ends within its table of streams")?;
    at += table.len();
    let mut parts = Parts::default();
    let mut entries = table.chunks_exact(16);
    for (part, n) in parts.iter_mut().zip(sizes).filter(|(_, n)| *n > 0) {
        let entry = entries.next().ok_or("its table is short")?;
        let size = |half: &[u8]| half.iter().rev().fold(0_u64, |v, b| v << 8 | u64::from(*b));
        let (packed, unpacked) = (size(&entry[..8]), size(&entry[8..]));
        if unpacked != n as u64 {
            return Err(format!("a stream of {unpacked} bytes, expected {n}"));
        }
        let end = usize::try_from(packed).ok().and_then(|n| at.checked_add(n));
        let stream = end.and_then(|end| file.get(at..end));
        let stream = stream.ok_or("a stream reaches behind its end")?;
        *part =
            zstd::bulk::decompress(stream, n).map_err(|e| format!("a stream is damaged: {e}"))?;
        if part.len() != n {
            return Err(format!("a stream holds {} bytes, expected {n}", part.len()));
        }
        at += stream.len();
    }
    Ok(splats_of(&header, &parts))
}

fn header_of(
    first: &[u8],
    file_bytes: usize,
    versions: std::ops::RangeInclusive<u32>,
) -> Result<Header, String> {
    let word =
        |at: usize| u32::from_le_bytes([first[at], first[at + 1], first[at + 2], first[at + 3]]);
    if word(0) != MAGIC {
        return Err("its header does not begin with NGSP".to_owned());
    }
    let (version, n, degree, bits) = (word(4), word(8), first[12], first[13]);
    if !versions.contains(&version) {
        return Err(format!("version {version}, this program reads 2, 3 and 4"));
    }
    // Nine bytes of mean alone.
    let most = (file_bytes as u64).saturating_mul(MAX_RATIO) / 9;
    if n > MAX_SPLATS || u64::from(n) > most {
        return Err(format!("{n} splats in {file_bytes} bytes"));
    }
    if degree > MAX_DEGREE {
        return Err(format!(
            "harmonics of degree {degree}, expected 0 to {MAX_DEGREE}"
        ));
    }
    if bits > 23 {
        return Err(format!("{bits} binary digits behind the point of a mean"));
    }
    Ok(Header {
        n: n as usize,
        degree,
        bits,
        version,
    })
}

fn splats_of(
    header: &Header,
    [means, opacities, colours, scales, quats, harmonics]: &Parts,
) -> Splats {
    let steps = f32::from(header.bits).exp2();
    let fixed = |b: &[u8]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 / steps;
    let three = |bytes: &[u8]| -> [f32; 3] { std::array::from_fn(|k| f32::from(bytes[k])) };
    let quat = |bytes: &[u8]| match bytes {
        [a, b, c, d] => unpacked_quat(u32::from_le_bytes([*a, *b, *c, *d])),
        short => {
            let [x, y, z] = three(short).map(|v| v / 127.5 - 1.0);
            [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
        }
    };
    let mut splats = Splats {
        sh_degree: header.degree,
        means: means
            .chunks_exact(9)
            .map(|b| AXES.mean([fixed(b), fixed(&b[3..]), fixed(&b[6..])]))
            .collect(),
        opacity_logits: opacities
            .iter()
            .map(|b| axes::logit(f32::from(*b) / 255.0, 255.0))
            .collect(),
        log_scales: scales
            .chunks_exact(3)
            .map(|b| three(b).map(|v| v / 16.0 - 10.0))
            .collect(),
        anchors: vec![0; header.n],
        ..Splats::default()
    };
    let of_quat = if header.version < 3 { 3 } else { 4 };
    splats.quats = quats
        .chunks_exact(of_quat)
        .map(|b| AXES.quat_back(quat(b)))
        .collect();
    let n_rest = splats.sh_stride() - 3;
    for (ix, colour) in colours.chunks_exact(3).enumerate() {
        splats
            .sh
            .extend(three(colour).map(|v| (v - 127.5) / (255.0 * COLOUR_SCALE)));
        let rest = &harmonics[ix * n_rest..][..n_rest];
        splats.sh.extend(
            rest.iter()
                .enumerate()
                .map(|(at, b)| AXES.sh_sign(1 + at / 3) * (f32::from(*b) - 128.0) / 128.0),
        );
    }
    splats
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some(n: usize, sh_degree: u8) -> Splats {
        let mut splats = Splats {
            sh_degree,
            ..Splats::default()
        };
        let wave = |ix: usize, k: usize| ((ix * 37 + k * 101) as f32 * 0.618).sin();
        for ix in 0..n {
            splats.means.push([0, 1, 2].map(|k| 20.0 * wave(ix, k)));
            splats
                .log_scales
                .push([3, 4, 5].map(|k| -4.0 + 2.0 * wave(ix, k)));
            splats.quats.push([6, 7, 8, 9].map(|k| wave(ix, k)));
            splats.opacity_logits.push(3.0 * wave(ix, 10));
            let stride = 3 * (usize::from(sh_degree) + 1).pow(2);
            splats
                .sh
                .extend((0..stride).map(|k| 0.6 * wave(ix, 11 + k)));
            splats.anchors.push(0);
        }
        splats
    }

    fn written(splats: &Splats, version: SpzVersion) -> Vec<u8> {
        let mut bytes = Vec::new();
        write(splats, version, &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn splats_come_back_within_the_steps_of_the_format() {
        for (version, degree) in [
            (SpzVersion::V3, 0),
            (SpzVersion::V3, 3),
            (SpzVersion::V4, 0),
            (SpzVersion::V4, 2),
        ] {
            let splats = some(200, degree);
            let found = read(&written(&splats, version)).unwrap();
            assert_eq!((found.len(), found.sh_degree), (200, degree));
            for ix in 0..200 {
                for k in 0..3 {
                    assert!((found.means[ix][k] - splats.means[ix][k]).abs() < 1.3e-4);
                    assert!((found.log_scales[ix][k] - splats.log_scales[ix][k]).abs() < 0.0313);
                }
                let (p, q) = (
                    axes::opacity(found.opacity_logits[ix]),
                    axes::opacity(splats.opacity_logits[ix]),
                );
                assert!((p - q).abs() < 2.1e-3, "{p} {q}");
                let unit = [found.quats[ix], splats.quats[ix]].map(axes::unit_quat);
                let dot: f32 = unit[0].iter().zip(&unit[1]).map(|(a, b)| a * b).sum();
                assert!(dot.abs() > 0.99999, "{dot}");
                let stride = splats.sh_stride();
                for at in 0..stride {
                    let (a, b) = (found.sh[ix * stride + at], splats.sh[ix * stride + at]);
                    let most = [0.0132, 0.036, 0.068][(at / 3).min(4).div_ceil(3).min(2)];
                    assert!((a - b).abs() < most, "number {at}: {a} {b}");
                }
            }
        }
    }

    #[test]
    fn a_wide_map_gets_coarser_steps_and_none_is_cut() {
        let mut splats = some(10, 0);
        splats.means[3] = [9_000.0, -30_000.0, 12.0];
        let found = read(&written(&splats, SpzVersion::V3)).unwrap();
        assert!(
            (found.means[3][1] + 30_000.0).abs() < 0.01,
            "{:?}",
            found.means[3]
        );
    }

    #[test]
    fn splats_that_are_not_finite_are_left_out() {
        let mut splats = some(10, 1);
        splats.means[4][0] = f32::NAN;
        assert_eq!(read(&written(&splats, SpzVersion::V4)).unwrap().len(), 9);
    }

    #[test]
    fn damaged_files_are_refused() {
        for version in [SpzVersion::V3, SpzVersion::V4] {
            let bytes = written(&some(50, 1), version);
            for cut in 0..bytes.len() {
                assert!(
                    read(&bytes[..cut]).is_err(),
                    "{cut} of {} bytes",
                    bytes.len()
                );
            }
            for at in 0..bytes.len() {
                let mut bytes = bytes.clone();
                bytes[at] ^= 0x55;
                // What the checksum does not see is a whole map of the same size.
                if let Ok(splats) = read(&bytes) {
                    assert!(splats.len() <= 50 * 256, "byte {at}: {}", splats.len());
                }
            }
        }
        let mut gzip = GzEncoder::new(Vec::new(), Compression::best());
        let mut header = MAGIC.to_le_bytes().to_vec();
        header.extend(3_u32.to_le_bytes());
        header.extend(40_000_000_u32.to_le_bytes());
        header.extend([3, 12, 0, 0]);
        gzip.write_all(&header).unwrap();
        let error = read(&gzip.finish().unwrap()).unwrap_err();
        assert!(error.contains("40000000 splats"), "{error}");
    }
}
