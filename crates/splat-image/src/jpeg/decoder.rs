//! JPEG files and the images of MJPEG cameras -> RGB.
//!
//! What cameras send is decoded here, since no library does so without allocating for every image, nor notices that
//! data are missing before the end marker; all other kinds, such as progressive files, are zune-jpeg's.
//!
//! An image that is cut off is an error, never an image with grey where data is missing. Cameras may leave the
//! Huffman tables out, since their format fixes them, and may hand out more bytes than the image has.

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use crate::jpeg::baseline::Baseline;
use crate::jpeg::tables;
use crate::limits::{MAX_SIDE, memory_for};
use crate::pixel_format::resize;
use splat_types::image::RgbImage;

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

/// Decodes one image after the other; its memory is used again.
#[derive(Debug, Default)]
pub struct Jpeg {
    /// The image with the Huffman tables that it came without.
    completed: Vec<u8>,
    baseline: Baseline,
}

impl Jpeg {
    pub fn to_rgb(&mut self, bytes: &[u8], out: &mut RgbImage) -> Result<(), String> {
        let parts = parts_of(bytes).ok_or("JPEG is cut off")?;
        let whole = &bytes[..parts.end];
        if parts.has_huffman_tables {
            return self.baseline_or_other(whole, out);
        }
        let mut completed = std::mem::take(&mut self.completed);
        completed.clear();
        completed.extend_from_slice(&whole[..parts.first_scan]);
        tables::push_standard_tables(&mut completed);
        completed.extend_from_slice(&whole[parts.first_scan..]);
        let decoded = self.baseline_or_other(&completed, out);
        self.completed = completed;
        decoded
    }

    fn baseline_or_other(&mut self, bytes: &[u8], out: &mut RgbImage) -> Result<(), String> {
        let Some(header) = self.baseline.read_header(bytes) else {
            return decode(bytes, out);
        };
        make_room(out, header.width_px, header.height_px, bytes.len())?;
        self.baseline.decode(&header, bytes, out)
    }
}

/// The image without what follows its end; `None` when it has no end or is no JPEG.
pub fn whole(bytes: &[u8]) -> Option<&[u8]> {
    parts_of(bytes).map(|parts| &bytes[..parts.end])
}

/// By zune-jpeg, which reads all kinds.
pub(crate) fn decode(bytes: &[u8], out: &mut RgbImage) -> Result<(), String> {
    // Without strict mode an image cut in half decodes to one that is half grey.
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(MAX_SIDE as usize)
        .set_max_height(MAX_SIDE as usize)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|e| e.to_string())?;
    let (width, height) = decoder.dimensions().ok_or("no size in its header")?;
    make_room(out, width as u32, height as u32, bytes.len())?;
    let n_bytes = out.pixels.len();
    match decoder.output_buffer_size() {
        Some(found) if found == n_bytes => {}
        found => return Err(format!("{found:?} bytes of output, expected {n_bytes}")),
    }
    decoder
        .decode_into(&mut out.pixels)
        .map_err(|e| e.to_string())
}

/// `out` gets a size that so many bytes can hold. Decoders take memory of their own by the size.
fn make_room(
    out: &mut RgbImage,
    width_px: u32,
    height_px: u32,
    n_bytes: usize,
) -> Result<(), String> {
    let needed = u64::from(width_px) * u64::from(height_px) * 3;
    if needed > memory_for(n_bytes) || width_px.max(height_px) > MAX_SIDE {
        return Err(format!(
            "{width_px}x{height_px} px, more than its length can hold"
        ));
    }
    if needed == 0 {
        return Err("image without pixels".to_owned());
    }
    resize(out, width_px, height_px);
    Ok(())
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

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;

    fn test_image() -> RgbImage {
        let pixels = (0..48 * 32 * 3).map(|ix| (ix * 7 % 251) as u8).collect();
        RgbImage {
            width_px: 48,
            height_px: 32,
            pixels,
        }
    }

    fn encoded() -> Vec<u8> {
        let image = test_image();
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, 90)
            .encode(&image.pixels, 48, 32, image::ExtendedColorType::Rgb8)
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
    fn a_image_without_huffman_tables_decodes_to_the_same() {
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
        let mut ended = whole[..whole.len() * 2 / 3].to_vec();
        ended.extend_from_slice(&[0xff, END_OF_IMAGE]);
        let error = decoded(&ended).unwrap_err();
        assert!(error.contains("too few data, at "), "{error}");
        let mut long = whole.clone();
        long.extend_from_slice(&[0; 5000]);
        assert_eq!(super::whole(&long), Some(whole.as_slice()));
        assert_eq!(decoded(&long).unwrap(), decoded(&whole).unwrap());
    }

    #[test]
    fn markers_that_run_off_the_end_are_no_image() {
        assert_eq!(whole(&[0xff, 0xd8, 0xff]), None);
        assert_eq!(whole(&[0xff, 0xd8, 0xff, 0xe0, 0xff, 0xff]), None);
        assert_eq!(whole(&[0xff, 0xd8, 0xff, 0xd9]), None);
        assert_eq!(whole(b"\x89PNG"), None);
    }
}
