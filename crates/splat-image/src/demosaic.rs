//! One colour per pixel, as sensors have it -> RGB, by bilinear interpolation.

/// What the first two pixels of the first two rows see.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BayerPattern {
    Rggb,
    Gbrg,
    Grbg,
    Bggr,
}

impl BayerPattern {
    /// Parity of the row and of the column of the pixels that see red.
    fn red(self) -> (usize, usize) {
        match self {
            Self::Rggb => (0, 0),
            Self::Grbg => (0, 1),
            Self::Gbrg => (1, 0),
            Self::Bggr => (1, 1),
        }
    }
}

/// Fills `target`, 3 bytes for each byte of `mosaic`, which holds rows of `width` pixels.
///
/// Means of two or four neighbours, rounded; the outermost pixels take the colours of their neighbours inside, as OpenCV
/// does it.
pub(crate) fn demosaic(mosaic: &[u8], width: usize, pattern: BayerPattern, target: &mut [u8]) {
    if mosaic.is_empty() {
        return;
    }
    let height = mosaic.len() / width;
    for y in 0..height {
        // Of an image without inside, the pixels themselves go on outside.
        let inside = if height < 3 {
            y
        } else {
            y.clamp(1, height - 2)
        };
        let line = |y: usize| &mosaic[y * width..][..width];
        let rows = [
            line(inside.saturating_sub(1)),
            line(inside),
            line((inside + 1).min(height - 1)),
        ];
        let target = &mut target[3 * y * width..][..3 * width];
        demosaic_row(rows, inside, pattern, target);
    }
}

/// The row above, the row itself and the row below -> RGB.
fn demosaic_row(rows: [&[u8]; 3], y: usize, pattern: BayerPattern, target: &mut [u8]) {
    let (red_row, red_column) = pattern.red();
    // One kind of pixel at a time, so that the loops have no branches.
    let other_column = 1 - red_column;
    if y % 2 == red_row {
        every_second(rows, red_column, target, |p| {
            [p.here, p.beside(), p.corners()]
        });
        every_second(rows, other_column, target, |p| {
            [p.across(), p.here, p.upright()]
        });
    } else {
        every_second(rows, red_column, target, |p| {
            [p.upright(), p.here, p.across()]
        });
        every_second(rows, other_column, target, |p| {
            [p.corners(), p.beside(), p.here]
        });
    }
}

/// Fills the pixels that lie at columns `first`, `first + 2` and so on, and the outermost ones that are as those.
#[inline(always)]
fn every_second(
    [above, here, below]: [&[u8]; 3],
    first: usize,
    target: &mut [u8],
    colours: impl Fn(&Around) -> [u8; 3],
) {
    let width = here.len();
    let pixels = target.as_chunks_mut::<3>().0;
    if width < 3 {
        for x in (first..width).step_by(2) {
            let three = |row: &[u8]| {
                [
                    row[x.saturating_sub(1)],
                    row[x],
                    row[(x + 1).min(width - 1)],
                ]
            };
            pixels[x] = colours(&Around::new(three(above), three(here), three(below)));
        }
        return;
    }
    // Column 0 is outermost.
    let start = if first == 0 { 2 } else { 1 };
    let (above, below) = (&above[..width], &below[..width]);
    for x in (start..width - 1).step_by(2) {
        pixels[x] = colours(&Around::new(
            [above[x - 1], above[x], above[x + 1]],
            [here[x - 1], here[x], here[x + 1]],
            [below[x - 1], below[x], below[x + 1]],
        ));
    }
    if start == 1 {
        pixels[0] = pixels[1];
    }
    if (width - 2) % 2 == first {
        pixels[width - 1] = pixels[width - 2];
    }
}

/// A pixel and its neighbours.
struct Around {
    here: u8,
    /// Left and right.
    sides: [u8; 2],
    /// Above and below.
    ends: [u8; 2],
    diagonal: [u8; 4],
}

impl Around {
    #[inline(always)]
    fn new(above: [u8; 3], row: [u8; 3], below: [u8; 3]) -> Self {
        Self {
            here: row[1],
            sides: [row[0], row[2]],
            ends: [above[1], below[1]],
            diagonal: [above[0], above[2], below[0], below[2]],
        }
    }

    #[inline(always)]
    fn across(&self) -> u8 {
        mean2(self.sides)
    }

    #[inline(always)]
    fn upright(&self) -> u8 {
        mean2(self.ends)
    }

    #[inline(always)]
    fn beside(&self) -> u8 {
        mean4([self.sides[0], self.sides[1], self.ends[0], self.ends[1]])
    }

    #[inline(always)]
    fn corners(&self) -> u8 {
        mean4(self.diagonal)
    }
}

#[inline(always)]
fn mean2([a, b]: [u8; 2]) -> u8 {
    (u16::from(a) + u16::from(b)).div_ceil(2) as u8
}

#[inline(always)]
fn mean4(values: [u8; 4]) -> u8 {
    let sum: u16 = values.into_iter().map(u16::from).sum();
    ((sum + 2) / 4) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rgb(mosaic: &[u8], width: usize, pattern: BayerPattern) -> Vec<u8> {
        let mut target = vec![0; 3 * mosaic.len()];
        demosaic(mosaic, width, pattern, &mut target);
        target
    }

    const ALL: [BayerPattern; 4] = [
        BayerPattern::Rggb,
        BayerPattern::Gbrg,
        BayerPattern::Grbg,
        BayerPattern::Bggr,
    ];

    #[test]
    fn missing_colours_are_rounded_means_of_their_neighbours() {
        #[rustfmt::skip]
        let mosaic = [
            10, 21, 30, 41,
            50, 60, 71, 80,
            90, 100, 113, 120,
            130, 140, 150, 161,
        ];
        let out = rgb(&mosaic, 4, BayerPattern::Rggb);
        // At row 1: blue, and green beside blue. Green: 21 + 50 + 71 + 100, of 4; red: 10 + 30 + 90 + 113, of 4.
        assert_eq!(out[3 * 5..3 * 6], [61, 61, 60]);
        // Red above and below: 30 and 113; blue to the sides: 60 and 80.
        assert_eq!(out[3 * 6..3 * 7], [72, 71, 70]);
        assert_eq!(
            out[..3],
            out[3 * 5..3 * 6],
            "the corner is as the pixel inside"
        );
    }

    #[test]
    fn images_of_one_colour_stay_so_in_any_size() {
        for pattern in ALL {
            for (width, height) in [(1, 1), (2, 2), (1, 5), (5, 2), (3, 3), (6, 4)] {
                let grey = rgb(&vec![200; width * height], width, pattern);
                assert_eq!(
                    grey,
                    vec![200; 3 * width * height],
                    "{pattern:?} {width}x{height}"
                );
            }
            // Red light alone: no green, no blue, red everywhere inside.
            let (red_row, red_column) = pattern.red();
            let is_red = |p: usize| (p / 6) % 2 == red_row && (p % 6) % 2 == red_column;
            let mosaic: Vec<u8> = (0..36).map(|p| if is_red(p) { 90 } else { 0 }).collect();
            for pixel in rgb(&mosaic, 6, pattern).as_chunks::<3>().0 {
                assert_eq!(*pixel, [90, 0, 0], "{pattern:?}");
            }
        }
    }
}
