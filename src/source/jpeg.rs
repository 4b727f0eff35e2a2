//! JPEG files and the pictures of MJPEG cameras -> RGB.
//!
//! A picture that is cut off is an error, never a picture with grey where data is missing. Cameras may leave the
//! Huffman tables out, since their format fixes them, and may hand out more bytes than the picture has.

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use crate::frame::RgbImage;
use crate::source::decode::{MAX_SIDE, memory_for};
use crate::source::pixels::resize;

const START_OF_IMAGE: u8 = 0xd8;
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;
const HUFFMAN_TABLES: u8 = 0xc4;

/// Where the parts of a JPEG lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Parts {
    /// Of the marker of the first scan.
    first_scan: usize,
    has_huffman_tables: bool,
    /// Behind the end marker.
    end: usize,
}

/// Decodes one picture after the other; its memory is used again.
#[derive(Debug, Default)]
pub struct Jpeg {
    /// The picture with the Huffman tables that it came without.
    completed: Vec<u8>,
}

impl Jpeg {
    pub fn to_rgb(&mut self, bytes: &[u8], out: &mut RgbImage) -> Result<(), String> {
        let parts = parts_of(bytes).ok_or("JPEG is cut off")?;
        let whole = &bytes[..parts.end];
        if parts.has_huffman_tables {
            return decode(whole, out);
        }
        self.completed.clear();
        self.completed.extend_from_slice(&whole[..parts.first_scan]);
        push_standard_tables(&mut self.completed);
        self.completed.extend_from_slice(&whole[parts.first_scan..]);
        decode(&self.completed, out)
    }
}

/// The picture without what follows its end; `None` when it has no end or is no JPEG.
pub fn whole(bytes: &[u8]) -> Option<&[u8]> {
    parts_of(bytes).map(|parts| &bytes[..parts.end])
}

fn decode(bytes: &[u8], out: &mut RgbImage) -> Result<(), String> {
    // Without strict mode a picture cut in half decodes to one that is half grey.
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(MAX_SIDE as usize)
        .set_max_height(MAX_SIDE as usize)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|e| e.to_string())?;
    let (width, height) = decoder.dimensions().ok_or("no size in its header")?;
    // The decoder takes memory of its own by the size, so that must fit the bytes first.
    let needed = width as u64 * height as u64 * 3;
    if needed > memory_for(bytes.len()) {
        return Err(format!(
            "{width}x{height} px, more than its length can hold"
        ));
    }
    if needed == 0 {
        return Err("picture without pixels".to_owned());
    }
    resize(out, width as u32, height as u32);
    let n_bytes = out.pixels.len();
    match decoder.output_buffer_size() {
        Some(found) if found == n_bytes => {}
        found => return Err(format!("{found:?} bytes of output, expected {n_bytes}")),
    }
    decoder
        .decode_into(&mut out.pixels)
        .map_err(|e| e.to_string())
}

/// Walks from marker to marker; thumbnails inside segments are stepped over.
fn parts_of(bytes: &[u8]) -> Option<Parts> {
    if bytes.get(..2)? != [0xff, START_OF_IMAGE] {
        return None;
    }
    let mut at = 2;
    let mut first_scan = None;
    let mut has_huffman_tables = false;
    loop {
        at += next_marker(&bytes[at..])?;
        let marker = bytes[at + 1];
        match marker {
            END_OF_IMAGE => {
                return Some(Parts {
                    first_scan: first_scan?,
                    has_huffman_tables,
                    end: at + 2,
                });
            }
            // Start of image again, restarts and TEM stand alone.
            START_OF_IMAGE | 0xd0..=0xd7 | 0x01 => at += 2,
            _ => {
                has_huffman_tables |= marker == HUFFMAN_TABLES;
                if marker == START_OF_SCAN {
                    first_scan.get_or_insert(at);
                }
                let length = bytes.get(at + 2..at + 4)?;
                at += 2 + usize::from(u16::from_be_bytes([length[0], length[1]]));
            }
        }
        if at > bytes.len() {
            return None;
        }
    }
}

/// Distance to the next marker that is neither a stuffed byte nor a restart.
fn next_marker(bytes: &[u8]) -> Option<usize> {
    let mut at = 0;
    loop {
        at += bytes.get(at..)?.iter().position(|&byte| byte == 0xff)?;
        match *bytes.get(at + 1)? {
            0x00 | 0xd0..=0xd7 => at += 2,
            0xff => at += 1,
            _ => return Some(at),
        }
    }
}

/// Codes per length, then the values, of the tables K.3 to K.6 of ITU-T T.81, which the formats of MJPEG cameras imply.
const DC_LENGTHS: [[u8; 16]; 2] = [
    [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0],
    [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0],
];
const DC_VALUES: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];
const AC_LENGTHS: [[u8; 16]; 2] = [
    [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 0x7d],
    [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 0x77],
];
const AC_VALUES: [[u8; 162]; 2] = [
    [
        0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61,
        0x07, 0x22, 0x71, 0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52,
        0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72, 0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25,
        0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45,
        0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5a, 0x63, 0x64,
        0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
        0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99,
        0x9a, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6,
        0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3,
        0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8,
        0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
    ],
    [
        0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61,
        0x71, 0x13, 0x22, 0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33,
        0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1, 0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18,
        0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3a, 0x43, 0x44,
        0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5a, 0x63,
        0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a,
        0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97,
        0x98, 0x99, 0x9a, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4,
        0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca,
        0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7,
        0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
    ],
];

fn push_standard_tables(out: &mut Vec<u8>) {
    let lengths = DC_LENGTHS.iter().chain(&AC_LENGTHS);
    let values: [&[u8]; 4] = [&DC_VALUES, &DC_VALUES, &AC_VALUES[0], &AC_VALUES[1]];
    // Class 0 is DC, 1 is AC; table 0 is for luma, 1 for chroma.
    let ids = [0x00, 0x01, 0x10, 0x11];
    for ((lengths, values), id) in lengths.zip(values).zip(ids) {
        let n_bytes = (2 + 1 + lengths.len() + values.len()) as u16;
        out.extend_from_slice(&[0xff, HUFFMAN_TABLES]);
        out.extend_from_slice(&n_bytes.to_be_bytes());
        out.push(id);
        out.extend_from_slice(lengths);
        out.extend_from_slice(values);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;

    fn picture() -> RgbImage {
        let pixels = (0..48 * 32 * 3).map(|ix| (ix * 7 % 251) as u8).collect();
        RgbImage {
            width_px: 48,
            height_px: 32,
            pixels,
        }
    }

    fn encoded() -> Vec<u8> {
        let picture = picture();
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, 90)
            .encode(&picture.pixels, 48, 32, image::ExtendedColorType::Rgb8)
            .unwrap();
        bytes
    }

    fn decoded(bytes: &[u8]) -> Result<RgbImage, String> {
        let mut out = RgbImage {
            width_px: 0,
            height_px: 0,
            pixels: Vec::new(),
        };
        Jpeg::default().to_rgb(bytes, &mut out).map(|()| out)
    }

    /// The file without its Huffman tables, as many cameras send it.
    fn without_tables(bytes: &[u8]) -> Vec<u8> {
        let mut out = bytes[..2].to_vec();
        let mut at = 2;
        loop {
            let length = 2 + usize::from(u16::from_be_bytes([bytes[at + 2], bytes[at + 3]]));
            if bytes[at + 1] != HUFFMAN_TABLES {
                out.extend_from_slice(&bytes[at..at + length]);
            }
            at += length;
            if bytes[at - length + 1] == START_OF_SCAN {
                out.extend_from_slice(&bytes[at..]);
                return out;
            }
        }
    }

    #[test]
    fn a_picture_without_huffman_tables_decodes_to_the_same() {
        let whole = encoded();
        let bare = without_tables(&whole);
        assert!(bare.len() + 400 < whole.len());
        assert_eq!(decoded(&bare).unwrap(), decoded(&whole).unwrap());
    }

    #[test]
    fn a_cut_is_an_error_wherever_it_is_and_bytes_behind_the_end_are_none() {
        let whole = encoded();
        for cut in 0..whole.len() - 1 {
            assert!(decoded(&whole[..cut]).is_err(), "cut at {cut}");
        }
        // FIXME: a picture that lacks its middle but has an end passes, since the decoder does not count its blocks.
        let mut ended = whole[..whole.len() * 2 / 3].to_vec();
        ended.extend_from_slice(&[0xff, END_OF_IMAGE]);
        assert!(decoded(&ended).is_ok());
        let mut long = whole.clone();
        long.extend_from_slice(&[0; 5000]);
        assert_eq!(super::whole(&long), Some(whole.as_slice()));
        assert_eq!(decoded(&long).unwrap(), decoded(&whole).unwrap());
    }

    #[test]
    fn markers_that_run_off_the_end_are_no_picture() {
        assert_eq!(whole(&[0xff, 0xd8, 0xff]), None);
        assert_eq!(whole(&[0xff, 0xd8, 0xff, 0xe0, 0xff, 0xff]), None);
        assert_eq!(whole(&[0xff, 0xd8, 0xff, 0xd9]), None);
        assert_eq!(whole(b"\x89PNG"), None);
    }
}
