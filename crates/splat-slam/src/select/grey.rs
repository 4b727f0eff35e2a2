//! One float per pixel: images -> derivatives, box sums, images of half the size.

/// Intensity 0..1, or anything derived from it; row by row, `width * height` values.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GreyImage {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
}

/// Binomial weights of order 4, a Gaussian of about one pixel (Burt and Adelson 1983).
const BINOMIAL: [f32; 5] = [0.0625, 0.25, 0.375, 0.25, 0.0625];

impl GreyImage {
    fn zeros(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            values: vec![0.0; width * height],
        }
    }

    pub(crate) fn empty() -> Self {
        Self::zeros(0, 0)
    }

    pub(crate) fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..][..self.width]
    }

    /// Correlates rows with `horizontal` and columns with `vertical`, both of odd length; zeros lie outside.
    pub(crate) fn filtered(&self, horizontal: &[f32], vertical: &[f32]) -> Self {
        let mut across = Self::zeros(self.width, self.height);
        for (row, target) in self.rows().zip(across.rows_mut()) {
            // Tap by tap over whole rows: each pixel sums its taps from left to right, many pixels at a time.
            for (tap, &weight) in horizontal.iter().enumerate() {
                let (from, to, n) = overlap(self.width, tap, horizontal.len() / 2);
                for (sum, value) in target[to..][..n].iter_mut().zip(&row[from..]) {
                    *sum += value * weight;
                }
            }
        }
        let mut both = Self::zeros(self.width, self.height);
        for (tap, &weight) in vertical.iter().enumerate() {
            let (from, to, n) = overlap(self.height, tap, vertical.len() / 2);
            let n_values = n * self.width;
            let values = &across.values[from * self.width..][..n_values];
            for (sum, value) in both.values[to * self.width..][..n_values]
                .iter_mut()
                .zip(values)
            {
                *sum += value * weight;
            }
        }
        both
    }

    /// Blurred with a 5x5 Gaussian and every second pixel of it, mirrored at the border.
    pub(crate) fn halved(&self) -> Self {
        let mut half = Self::zeros(self.width.div_ceil(2), self.height.div_ceil(2));
        let columns: Vec<[usize; 5]> = (0..half.width)
            .map(|x| std::array::from_fn(|tap| mirrored(2 * x + tap, self.width)))
            .collect();
        for (y, target) in half.rows_mut().enumerate() {
            let rows: [&[f32]; 5] =
                std::array::from_fn(|tap| self.row(mirrored(2 * y + tap, self.height)));
            for (columns, target) in columns.iter().zip(target) {
                let mut sum = 0.0;
                for (row, across) in rows.iter().zip(BINOMIAL) {
                    for (&column, along) in columns.iter().zip(BINOMIAL) {
                        sum += row[column] * (across * along);
                    }
                }
                *target = sum;
            }
        }
        half
    }

    /// Derivatives to the right and downwards per pixel (Scharr 2000); border pixels go on outside.
    pub(crate) fn gradients(&self) -> [Self; 2] {
        const SIDE: f32 = 3.0 / 32.0;
        const MIDDLE: f32 = 10.0 / 32.0;
        let mut right = Self::zeros(self.width, self.height);
        let mut down = right.clone();
        let columns: Vec<[usize; 3]> = (0..self.width)
            .map(|x| std::array::from_fn(|tap| neighbour(x, tap, self.width)))
            .collect();
        for (y, (right, down)) in right.rows_mut().zip(down.rows_mut()).enumerate() {
            let [above, here, below]: [&[f32]; 3] =
                std::array::from_fn(|tap| self.row(neighbour(y, tap, self.height)));
            for (&[l, m, r], (right, down)) in columns.iter().zip(right.iter_mut().zip(down)) {
                *right = -SIDE * above[l] + SIDE * above[r] - MIDDLE * here[l] + MIDDLE * here[r]
                    - SIDE * below[l]
                    + SIDE * below[r];
                *down = -SIDE * above[l] - MIDDLE * above[m] - SIDE * above[r]
                    + SIDE * below[l]
                    + MIDDLE * below[m]
                    + SIDE * below[r];
            }
        }
        [right, down]
    }

    fn rows(&self) -> impl Iterator<Item = &[f32]> {
        self.values.chunks_exact(self.width.max(1))
    }

    fn rows_mut(&mut self) -> impl Iterator<Item = &mut [f32]> {
        self.values.chunks_exact_mut(self.width.max(1))
    }
}

/// First input, first output and count of the outputs that tap number `tap` reaches inside of `n` values.
fn overlap(n: usize, tap: usize, middle: usize) -> (usize, usize, usize) {
    let (from, to) = (tap.saturating_sub(middle), middle.saturating_sub(tap));
    (from.min(n), to.min(n), n.saturating_sub(from + to))
}

/// Index `shifted - 2`, mirrored at the first and the last of `n` pixels without repeating them.
fn mirrored(shifted: usize, n: usize) -> usize {
    if n == 1 {
        return 0;
    }
    let period = 2 * (n - 1);
    let ix = (shifted as isize - 2).unsigned_abs() % period;
    if ix >= n { period - ix } else { ix }
}

/// Index `ix + tap - 1`, kept inside of `n` pixels.
fn neighbour(ix: usize, tap: usize, n: usize) -> usize {
    (ix + tap).saturating_sub(1).min(n - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: usize, height: usize, value: impl Fn(f32, f32) -> f32) -> GreyImage {
        let pixel = |p: usize| value((p % width) as f32, (p / width) as f32);
        let values = (0..width * height).map(pixel).collect();
        GreyImage {
            width,
            height,
            values,
        }
    }

    #[test]
    fn gradients_of_a_plane_are_its_slopes() {
        let plane = image(7, 5, |x, y| 0.25 * x - 0.125 * y);
        let [right, down] = plane.gradients();
        let middle = 2 * 7 + 3;
        assert_eq!((right.values[middle], down.values[middle]), (0.25, -0.125));
        // Half of the step is missing where the border pixel goes on.
        assert_eq!(right.values[2 * 7], 0.125);
    }

    #[test]
    fn half_of_a_plane_is_a_plane_of_twice_the_slope() {
        for size in [(9, 7), (8, 6)] {
            let half = image(size.0, size.1, |x, y| 0.5 * x + 0.25 * y).halved();
            assert_eq!(half.size(), (size.0.div_ceil(2), size.1.div_ceil(2)));
            for y in 1..half.height - 1 {
                for x in 1..half.width - 1 {
                    let expected = x as f32 + 0.5 * y as f32;
                    assert_eq!(half.values[y * half.width + x], expected, "{x} {y}");
                }
            }
        }
        let flat = image(6, 3, |_, _| 0.5).halved();
        assert!(flat.values.iter().all(|v| *v == 0.5));
    }

    #[test]
    fn filters_take_zeros_outside_the_image() {
        let ones = image(4, 3, |_, _| 1.0).filtered(&[1.0; 5], &[1.0; 3]);
        assert_eq!(ones.values[..4], [6.0, 8.0, 8.0, 6.0]);
        assert_eq!(ones.values[4..8], [9.0, 12.0, 12.0, 9.0]);
        // Narrower than the filter.
        let one = image(1, 1, |_, _| 2.0).filtered(&[1.0; 5], &[1.0; 5]);
        assert_eq!(one.values, [2.0]);
    }
}
