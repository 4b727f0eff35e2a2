use super::*;

use image::{ImageBuffer, ImageFormat, Luma};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

/// RVL as its paper describes it, for the tests alone.
fn rvl_of(values: &[u16]) -> Vec<u8> {
    let mut nibbles: Vec<u32> = Vec::new();
    let mut number = |mut value: u32| {
        loop {
            let group = value & 7;
            value >>= 3;
            nibbles.push(group | if value > 0 { 8 } else { 0 });
            if value == 0 {
                break;
            }
        }
    };
    let (mut at, mut last) = (0, 0_i32);
    while at < values.len() {
        let run = |from: usize, is_missing: bool| {
            let same = |value: &&u16| (**value == 0) == is_missing;
            values[from..].iter().take_while(same).count()
        };
        let n_missing = run(at, true);
        number(n_missing as u32);
        at += n_missing;
        let n_present = run(at, false);
        number(n_present as u32);
        for value in &values[at..at + n_present] {
            let step = i32::from(*value) - last;
            number(((step << 1) ^ (step >> 31)) as u32);
            last = i32::from(*value);
        }
        at += n_present;
    }
    nibbles.resize(nibbles.len().next_multiple_of(8), 0);
    let word = |group: &[u32]| group.iter().fold(0, |word, nibble| word << 4 | nibble);
    let words = nibbles.as_chunks::<8>().0.iter();
    words.flat_map(|group| word(group).to_le_bytes()).collect()
}

fn message(format: &str, (a, b): (f32, f32), body: &[u8]) -> CompressedImage {
    let mut data = vec![0, 0, 0, 0];
    data.extend(a.to_le_bytes());
    data.extend(b.to_le_bytes());
    data.extend(body);
    CompressedImage {
        format: format.to_owned(),
        data,
        ..CompressedImage::default()
    }
}

fn with_size(width: u32, height: u32, rvl: &[u8]) -> Vec<u8> {
    let mut body = width.to_le_bytes().to_vec();
    body.extend(height.to_le_bytes());
    body.extend(rvl);
    body
}

#[test]
fn png_of_millimetres_and_of_inverse_depth() {
    let values = [0_u16, 1500, 65535, 4000, 2, 1];
    let image: ImageBuffer<Luma<u16>, Vec<u16>> =
        ImageBuffer::from_raw(3, 2, values.to_vec()).unwrap();
    let mut png = std::io::Cursor::new(Vec::new());
    image.write_to(&mut png, ImageFormat::Png).unwrap();
    let png = png.into_inner();
    let millimetres = message("16UC1; compressedDepth png", (0.0, 0.0), &png);
    let found = compressed_depth(&millimetres).unwrap();
    assert_eq!((found.width_px, found.height_px), (3, 2));
    let expected = [0.0, 1.5, 0.0, 4.0, 0.002, 0.001];
    for (found, expected) in found.depth.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-6, "{found} {expected}");
    }
    // Older publishers leave the codec out of the name.
    let inverse = message("32FC1; compressedDepth", (3000.0, 1.0), &png);
    let found = compressed_depth(&inverse).unwrap();
    assert!((found.depth[1] - 3000.0 / 1499.0).abs() < 1e-6);
    assert_eq!(found.depth[0], 0.0);
    assert_eq!(found.depth[5], 0.0, "at infinity");
}

#[test]
fn what_is_no_depth_is_refused() {
    let found = |format: &str, body: &[u8]| {
        let message = message(format, (0.0, 0.0), body);
        compressed_depth(&message).unwrap_err().to_string()
    };
    assert!(found("bgr8; jpeg compressed bgr8", &[]).contains("bgr8"));
    assert!(found("16UC1; compressedDepth rvl", &[1, 2]).contains("width"));
    let huge = with_size(1 << 14, 1 << 14, &[0; 16]);
    assert!(found("16UC1; compressedDepth rvl", &huge).contains("16384x16384"));
    let short = with_size(4, 4, &[0x11; 4]);
    assert!(!found("16UC1; compressedDepth rvl", &short).is_empty());
    let mut no_header = message("16UC1; compressedDepth png", (0.0, 0.0), &[]);
    no_header.data = vec![0; 5];
    assert!(
        compressed_depth(&no_header)
            .unwrap_err()
            .to_string()
            .contains("12 bytes")
    );
}

#[test]
fn rvl_comes_back_as_it_went() {
    let mut rng = Pcg32::seed_from_u64(3);
    for _ in 0..200 {
        let rows = rng.random_range(1..12);
        let value = |rng: &mut Pcg32| match rng.random_range(0..3) {
            0 => 0,
            1 => rng.random_range(1..9000),
            _ => rng.random(),
        };
        let values: Vec<u16> = (0..rows * 7).map(|_| value(&mut rng)).collect();
        let body = with_size(7, rows as u32, &rvl_of(&values));
        assert_eq!(rvl(&body).unwrap(), (7, rows as u32, values));
    }
}

#[test]
fn any_bytes_are_taken_without_a_panic() {
    let mut rng = Pcg32::seed_from_u64(4);
    for _ in 0..5000 {
        let bytes: Vec<u8> = (0..rng.random_range(0..200))
            .map(|_| rng.random())
            .collect();
        rvl(&with_size(16, 8, &bytes)).ok();
        rvl(&bytes).ok();
        compressed_depth(&message("32FC1; compressedDepth rvl", (1.0, 2.0), &bytes)).ok();
        compressed_depth(&message("16UC1; compressedDepth png", (1.0, 2.0), &bytes)).ok();
    }
}
