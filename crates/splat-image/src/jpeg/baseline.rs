//! Baseline JPEG, as cameras send it -> RGB, without an allocation once the first image has passed.
//!
//! Source: ITU-T T.81 and T.871. Strict: an image whose scan does not hold all of its blocks is an error.

use yuv::{YuvError, YuvPlanarImage, YuvRange, YuvStandardMatrix};

use crate::jpeg::header::{Component, Header, Sampling, Tables};
use crate::jpeg::huffman::{Bits, Damage};
use crate::jpeg::idct::{self, Coefficients};
use crate::jpeg::tables;
use splat_types::image::RgbImage;

/// Where a coefficient lies, by its place on the way through the block.
const PLACES: [u8; 64] = {
    let mut places = [0; 64];
    let mut ix = 0;
    while ix < 64 {
        let (across, down) = tables::frequency(ix);
        places[ix] = (8 * across + down) as u8;
        ix += 1;
    }
    places
};

/// One component, in whole units of the scan.
#[derive(Debug, Default)]
struct Plane {
    levels: Vec<u8>,
    /// From row to row.
    step: usize,
    component: Component,
    /// In one unit, across and down.
    n_blocks: (usize, usize),
    /// The first coefficient of the block before.
    first: i32,
}

/// Decodes one image after the other; its memory is used again.
#[derive(Debug, Default)]
pub(crate) struct Baseline {
    tables: Tables,
    planes: [Plane; 3],
}

impl Baseline {
    /// `None`: the image is of another kind.
    pub(crate) fn read_header(&mut self, bytes: &[u8]) -> Option<Header> {
        Header::read(bytes, &mut self.tables)
    }

    /// `out` has the image's size.
    pub(crate) fn decode(
        &mut self,
        header: &Header,
        bytes: &[u8],
        out: &mut RgbImage,
    ) -> Result<(), String> {
        self.scan(header, &bytes[header.data_at..])?;
        let [luma, blue, red] = &self.planes;
        if header.sampling == Sampling::Grey {
            let rows = out.pixels.chunks_exact_mut(3 * header.width_px as usize);
            for (row, levels) in rows.zip(luma.levels.chunks_exact(luma.step)) {
                for (pixel, &level) in row.as_chunks_mut::<3>().0.iter_mut().zip(levels) {
                    *pixel = [level; 3];
                }
            }
            return Ok(());
        }
        let planes = YuvPlanarImage {
            y_plane: &luma.levels,
            y_stride: luma.step as u32,
            u_plane: &blue.levels,
            u_stride: blue.step as u32,
            v_plane: &red.levels,
            v_stride: red.step as u32,
            width: header.width_px,
            height: header.height_px,
        };
        to_rgb(header.sampling, &planes, &mut out.pixels).map_err(|e| e.to_string())
    }

    fn scan(&mut self, header: &Header, data: &[u8]) -> Result<(), String> {
        let (across, down) = header.sampling.blocks();
        let units_across = (header.width_px as usize).div_ceil(8 * across);
        let units_down = (header.height_px as usize).div_ceil(8 * down);
        let n_planes = header.sampling.n_planes();
        let planes = &mut self.planes[..n_planes];
        for (ix, (plane, component)) in planes.iter_mut().zip(header.components).enumerate() {
            plane.component = component;
            plane.n_blocks = if ix == 0 { (across, down) } else { (1, 1) };
            plane.first = 0;
            plane.step = 8 * plane.n_blocks.0 * units_across;
            let n_rows = 8 * plane.n_blocks.1 * units_down;
            plane.levels.resize(plane.step * n_rows, 0);
        }
        let mut bits = Bits::new(data);
        let n_units = units_across * units_down;
        for unit in 0..n_units {
            let damaged =
                |damage| format!("{}, at {unit} of {n_units} units of blocks", said(damage));
            let interval = header.restart_interval;
            if interval > 0 && unit > 0 && unit % interval == 0 {
                bits.restart(unit / interval - 1).map_err(damaged)?;
                planes.iter_mut().for_each(|plane| plane.first = 0);
            }
            let place = (unit % units_across, unit / units_across);
            for plane in &mut *planes {
                plane
                    .read_unit(place, &self.tables, &mut bits)
                    .map_err(damaged)?;
            }
            bits.check().map_err(damaged)?;
        }
        Ok(())
    }
}

fn said(damage: Damage) -> &'static str {
    match damage {
        Damage::Code => "bits that are no code of its tables",
        Damage::Run => "coefficients beyond their block",
        Damage::End => "too few data",
        Damage::Restart => "no restart marker where one is due",
    }
}

impl Plane {
    /// `place`: of the unit, across and down.
    #[inline(always)]
    fn read_unit(
        &mut self,
        place: (usize, usize),
        tables: &Tables,
        bits: &mut Bits<'_>,
    ) -> Result<(), Damage> {
        for row in 0..self.n_blocks.1 {
            for column in 0..self.n_blocks.0 {
                let levels = self.read_block(tables, bits)?;
                let x = 8 * (place.0 * self.n_blocks.0 + column);
                let y = 8 * (place.1 * self.n_blocks.1 + row);
                let rows = self.levels[y * self.step + x..].chunks_mut(self.step);
                for (target, row) in rows.zip(levels) {
                    target[..8].copy_from_slice(&row);
                }
            }
        }
        Ok(())
    }

    #[inline(always)]
    fn read_block(&mut self, tables: &Tables, bits: &mut Bits<'_>) -> Result<idct::Levels, Damage> {
        let factors = &tables.quantisers[self.component.quantiser_ix].factors;
        let step = tables.dc[self.component.dc_ix].table.next(bits)?;
        if step.n_zeros != 0 {
            return Err(Damage::Code);
        }
        self.first = self.first.wrapping_add(step.number);
        let codes = &tables.ac[self.component.ac_ix].table;
        let mut coefficients: Coefficients = [[0.0; 8]; 8];
        let flat = coefficients.as_flattened_mut();
        flat[0] = self.first as f32 * factors[0];
        let mut ix = 1;
        while ix < 64 {
            let symbol = codes.next(bits)?;
            if symbol.n_bits == 0 {
                match symbol.n_zeros {
                    0 => break,
                    15 => {
                        ix += 16;
                        continue;
                    }
                    _ => return Err(Damage::Code),
                }
            }
            ix += symbol.n_zeros;
            let place = *PLACES.get(ix).ok_or(Damage::Run)?;
            flat[usize::from(place)] = symbol.number as f32 * factors[ix];
            ix += 1;
        }
        if ix == 1 {
            return Ok(idct::flat(coefficients[0][0]));
        }
        Ok(idct::levels(&coefficients))
    }
}

fn to_rgb(
    sampling: Sampling,
    planes: &YuvPlanarImage<'_, u8>,
    target: &mut [u8],
) -> Result<(), YuvError> {
    let step = 3 * planes.width;
    let (range, matrix) = (YuvRange::Full, YuvStandardMatrix::Bt601);
    match sampling {
        Sampling::Half => yuv::yuv420_to_rgb_bilinear(planes, target, step, range, matrix),
        Sampling::HalfAcross => yuv::yuv422_to_rgb_bilinear(planes, target, step, range, matrix),
        Sampling::Full | Sampling::Grey => yuv::yuv444_to_rgb(planes, target, step, range, matrix),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jpeg::decoder::{Jpeg, decode};
    use crate::limits::empty;
    use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
    use rand::{RngExt, SeedableRng};

    /// Colours that change slowly, with the noise of a sensor.
    fn test_image(width: u16, height: u16, noise: u8) -> Vec<u8> {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        let (width, height) = (i32::from(width), i32::from(height));
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x as f32, y as f32)));
        pixels
            .flat_map(|(x, y)| {
                let wave = |period: f32| ((x + 0.6 * y) / period).sin() * 100.0 + 120.0;
                [wave(31.0), wave(47.0), wave(70.0)]
            })
            .map(|level| level as u8 + rng.random_range(0..=noise))
            .collect()
    }

    fn encoded(
        (width, height): (u16, u16),
        noise: u8,
        quality: u8,
        change: impl FnOnce(&mut Encoder<&mut Vec<u8>>),
    ) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut encoder = Encoder::new(&mut bytes, quality);
        change(&mut encoder);
        encoder
            .encode(
                &test_image(width, height, noise),
                width,
                height,
                ColorType::Rgb,
            )
            .unwrap();
        bytes
    }

    fn decoded(bytes: &[u8]) -> Result<RgbImage, String> {
        let mut out = empty();
        Jpeg::default().to_rgb(bytes, &mut out).map(|()| out)
    }

    /// By zune-jpeg.
    fn decoded_by_other(bytes: &[u8]) -> RgbImage {
        assert!(Baseline::default().read_header(bytes).is_some());
        let mut out = empty();
        decode(bytes, &mut out).unwrap();
        out
    }

    /// Mean and largest difference.
    fn off(found: &[u8], known: &[u8]) -> (f64, u8) {
        assert_eq!(found.len(), known.len());
        let off = || found.iter().zip(known).map(|(&a, &b)| a.abs_diff(b));
        let sum: f64 = off().map(f64::from).sum();
        (sum / found.len() as f64, off().max().unwrap())
    }

    #[test]
    fn images_of_every_sampling_and_size_are_as_good_as_another_decoders() {
        use SamplingFactor::{R_4_2_0, R_4_2_2, R_4_4_4};
        for sampling in [R_4_4_4, R_4_2_2, R_4_2_0] {
            for size in [(64, 48), (61, 47), (16, 16), (1, 1), (7, 90), (130, 3)] {
                for (quality, noise) in [(30, 0), (85, 0), (100, 0), (85, 20)] {
                    let bytes = encoded(size, noise, quality, |e| e.set_sampling_factor(sampling));
                    let (found, other) = (decoded(&bytes).unwrap(), decoded_by_other(&bytes));
                    let taken = test_image(size.0, size.1, noise);
                    let found_off = off(&found.pixels, &taken).0;
                    let other_off = off(&other.pixels, &taken).0;
                    let said = format!("{sampling:?} {size:?} {quality} {noise}");
                    // Each rounds, and puts colours between their neighbours, in its own way.
                    assert!(
                        found_off < other_off + 0.3,
                        "{said}: {found_off}, {other_off}"
                    );
                }
            }
        }
    }

    #[test]
    fn grey_images_and_restarts_are_read() {
        let differs = |bytes: &[u8]| {
            let found = decoded(bytes).unwrap();
            off(&found.pixels, &decoded_by_other(bytes).pixels).1
        };
        let grey: Vec<u8> = test_image(50, 40, 9).into_iter().step_by(3).collect();
        let mut bytes = Vec::new();
        Encoder::new(&mut bytes, 90)
            .encode(&grey, 50, 40, ColorType::Luma)
            .unwrap();
        assert!(differs(&bytes) <= 2);
        let restarts = encoded((180, 140), 0, 85, |e| e.set_restart_interval(5));
        assert!(restarts.windows(2).any(|two| two == [0xff, 0xd7]));
        assert!(differs(&restarts) <= 10);
    }

    #[test]
    fn files_of_several_scans_are_left_to_the_other_decoder() {
        for bytes in [
            encoded((50, 40), 9, 90, |e| e.set_progressive(true)),
            encoded((50, 40), 9, 90, |e| e.set_optimized_huffman_tables(true)),
        ] {
            assert!(Baseline::default().read_header(&bytes).is_none());
            assert_eq!(decoded(&bytes).unwrap().width_px, 50);
        }
    }

    #[test]
    fn what_is_lost_on_the_way_is_noticed_and_nothing_panics() {
        let whole = encoded((160, 120), 20, 85, |e| e.set_restart_interval(10));
        let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
        let mut n_noticed = 0;
        for _ in 0..200 {
            // A packet of the bus is missing.
            let from = rng.random_range(700..whole.len() - 600);
            let lossy = [&whole[..from], &whole[from + 512..]].concat();
            n_noticed += usize::from(decoded(&lossy).is_err());
        }
        assert_eq!(n_noticed, 200);
        for _ in 0..2000 {
            let mut broken = whole.clone();
            for _ in 0..3 {
                let at = rng.random_range(2..broken.len());
                broken[at] = rng.random();
            }
            // An answer of either kind.
            drop(decoded(&broken));
        }
    }
}
