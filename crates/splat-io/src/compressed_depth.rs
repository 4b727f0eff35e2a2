//! `compressedDepth` images (compressed_depth_image_transport) -> depth in metres.
//!
//! The data begin with 12 bytes: a number of the codec, which the format's name says, too, and two floats `a`, `b`. Then follows a
//! 16-bit grey PNG, or width and height (4 bytes each) and RVL (Wilson, "Fast Lossless Depth Image Compression", 2017). The 16-bit
//! values are millimetres (16UC1), or quantised inverse depth: `z = a / (value - b)` in metres (32FC1).

use splat_image::codec::{depth_map, depth_of_millimetres, grey16_png};
use splat_image::limits::{DecodeError, MAX_SIDE, excerpt};
use splat_msgs::ros::CompressedImage;
use splat_types::depth::DepthMap;

const HEADER_BYTES: usize = 12;
/// Runs of missing depth take a few bits whatever their length, so that the size must be bounded on its own.
const MAX_PIXELS: u64 = 1 << 23;

/// Depth in metres of a message whose format says `compressedDepth`.
pub(crate) fn compressed_depth(message: &CompressedImage) -> Result<DepthMap, DecodeError> {
    let data: &[u8] = &message.data;
    let fail = |reason: &str| DecodeError::Compressed {
        found_bytes: data.len(),
        reason: reason.to_owned(),
    };
    let format = message.format.as_str();
    let metres = quantised(format, data).ok_or_else(|| DecodeError::DepthEncoding {
        found: excerpt(format),
    })?;
    let body = data
        .get(HEADER_BYTES..)
        .ok_or_else(|| fail("compressedDepth without its header of 12 bytes"))?;
    let (width, height, values) = if format.contains("rvl") {
        rvl(body).map_err(|reason| fail(&reason))?
    } else {
        grey16_png(body)?
    };
    let depth = values.into_iter().map(metres).collect();
    Ok(depth_map(width, height, depth))
}

/// What a 16-bit value means in metres; `None` for a format that is none of depth.
fn quantised(format: &str, data: &[u8]) -> Option<impl Fn(u16) -> f32> {
    let float = |at: usize| {
        let bytes = data.get(at..at + 4).and_then(|b| b.try_into().ok());
        f32::from_le_bytes(bytes.unwrap_or_default())
    };
    let (a, b) = (float(4), float(8));
    let is_inverse = match format.split(';').next()?.trim() {
        "16UC1" | "mono16" => false,
        "32FC1" => true,
        _ => return None,
    };
    Some(move |value: u16| {
        if !is_inverse {
            return depth_of_millimetres(value);
        }
        let metres = a / (f32::from(value) - b);
        let is_valid = value != 0 && metres.is_finite() && metres > 0.0;
        if is_valid { metres } else { 0.0 }
    })
}

/// Width, height and values.
fn rvl(body: &[u8]) -> Result<(u32, u32, Vec<u16>), String> {
    let side = |at: usize| {
        let bytes = body.get(at..at + 4).and_then(|b| b.try_into().ok());
        bytes.map(u32::from_le_bytes)
    };
    let (Some(width), Some(height)) = (side(0), side(4)) else {
        return Err("RVL without width and height".to_owned());
    };
    let n_pixels = u64::from(width) * u64::from(height);
    if width == 0 || height == 0 || width.max(height) > MAX_SIDE || n_pixels > MAX_PIXELS {
        return Err(format!("RVL of {width}x{height} px"));
    }
    let n_pixels = n_pixels as usize;
    let mut nibbles = Nibbles {
        words: body[8..].as_chunks::<4>().0.iter(),
        word: 0,
        n_left: 0,
    };
    let mut values: Vec<u16> = Vec::with_capacity(n_pixels);
    let mut last = 0_u16;
    while values.len() < n_pixels {
        let room = n_pixels - values.len();
        let run = |n: Option<u32>| n.filter(|n| *n as usize <= room).ok_or("RVL ends early");
        let n_missing = run(nibbles.number())? as usize;
        values.resize(values.len() + n_missing, 0);
        let n_present = run(nibbles.number())? as usize;
        if n_present > n_pixels - values.len() || n_missing + n_present == 0 {
            return Err("RVL with a run that leads nowhere".to_owned());
        }
        for _ in 0..n_present {
            // Steps are zigzag numbers: 0, -1, 1, -2, ..
            let coded = nibbles.number().ok_or("RVL ends early")?;
            let step = (coded >> 1) as i32 ^ -((coded & 1) as i32);
            last = last.wrapping_add(step as u16);
            values.push(last);
        }
    }
    Ok((width, height, values))
}

/// Numbers of a variable length: groups of 3 bits, the least first, each in a nibble whose highest bit says that more follow.
/// Nibbles come from the top of little-endian words.
struct Nibbles<'a> {
    words: std::slice::Iter<'a, [u8; 4]>,
    word: u32,
    n_left: u32,
}

impl Nibbles<'_> {
    fn number(&mut self) -> Option<u32> {
        let mut number = 0;
        for shift in (0..30).step_by(3) {
            if self.n_left == 0 {
                self.word = u32::from_le_bytes(*self.words.next()?);
                self.n_left = 8;
            }
            let nibble = self.word >> 28;
            self.word <<= 4;
            self.n_left -= 1;
            number |= (nibble & 7) << shift;
            if nibble & 8 == 0 {
                return Some(number);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests;
