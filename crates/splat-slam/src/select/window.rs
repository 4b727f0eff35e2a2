//! The 21x21 pixels around a point: their structure, and how another image differs from them.
//!
//! Sums go through eight lanes, so that vector units make them, in an order of their own; equal images give equal sums.

use multiversion::multiversion;

use crate::select::grey::GreyImage;

/// Side of the window, and the columns of it that go through lanes; the others follow one by one.
const WINDOW: usize = 21;
const HALF: usize = WINDOW / 2;
const LANES: usize = 8;
const LANE_COLUMNS: usize = WINDOW - WINDOW % LANES;
const N_PIXELS: usize = WINDOW * WINDOW;
const PATCH: usize = WINDOW + 1;
/// A structure tensor of a smaller determinant is not inverted.
const MIN_DETERMINANT: f32 = 1e-7;

/// What an image has around a point.
pub(crate) struct Window {
    image: [f32; N_PIXELS],
    gradients: [[f32; N_PIXELS]; 2],
    /// Sums of gx gx, gx gy, gy gy.
    tensor: [f32; 3],
}

/// Of a structure tensor.
pub(crate) struct Inverse {
    tensor: [f32; 3],
    inverse_determinant: f32,
}

impl Inverse {
    pub(crate) fn times(&self, [d, e]: [f32; 2]) -> [f32; 2] {
        let [a, b, c] = self.tensor;
        [
            self.inverse_determinant * (c * d - b * e),
            self.inverse_determinant * (-b * d + a * e),
        ]
    }
}

impl Window {
    pub(crate) fn cut(image: &GreyImage, gradients: &[GreyImage; 2], centre: [f32; 2]) -> Self {
        let mut window = Self {
            image: [0.0; N_PIXELS],
            gradients: [[0.0; N_PIXELS]; 2],
            tensor: [0.0; 3],
        };
        if let Some(samples) = Samples::of(image.size(), centre) {
            let gradients = gradients.each_ref().map(Pixels::of);
            cut_inside(&mut window, Pixels::of(image), gradients, samples);
        } else {
            let (patch, samples) = patch_at_border(image, centre);
            let patches = gradients.each_ref().map(|g| patch_at_border(g, centre).0);
            let gradients = patches.each_ref().map(Pixels::of_patch);
            cut_inside(&mut window, Pixels::of_patch(&patch), gradients, samples);
        }
        window
    }

    /// `None` where the window has too little structure to be followed: the smaller eigenvalue of its tensor, per pixel, is
    /// below `min_eigenvalue`.
    pub(crate) fn inverse_tensor(&self, min_eigenvalue: f32) -> Option<Inverse> {
        let [a, b, c] = self.tensor;
        let determinant = a * c - b * b;
        if determinant.abs() < MIN_DETERMINANT {
            return None;
        }
        let spread = a - c;
        let smaller = (a + c - (spread * spread + 4.0 * b * b).sqrt()) * 0.5;
        if smaller / (N_PIXELS as f32) < min_eigenvalue {
            return None;
        }
        Some(Inverse {
            tensor: self.tensor,
            inverse_determinant: 1.0 / determinant,
        })
    }

    /// Gradient times difference of the images, summed: the right side of the normal equations.
    pub(crate) fn descent(&self, image: &GreyImage, at: [f32; 2]) -> [f32; 2] {
        if let Some(samples) = Samples::of(image.size(), at) {
            return descent_inside(self, Pixels::of(image), samples);
        }
        let (patch, samples) = patch_at_border(image, at);
        descent_inside(self, Pixels::of_patch(&patch), samples)
    }

    /// Mean absolute difference.
    pub(crate) fn difference(&self, image: &GreyImage, at: [f32; 2]) -> f32 {
        let sum = if let Some(samples) = Samples::of(image.size(), at) {
            difference_inside(self, Pixels::of(image), samples)
        } else {
            let (patch, samples) = patch_at_border(image, at);
            difference_inside(self, Pixels::of_patch(&patch), samples)
        };
        sum / N_PIXELS as f32
    }
}

/// What a window reads: an image, or a copy of what is around a point.
#[derive(Clone, Copy)]
struct Pixels<'a> {
    values: &'a [f32],
    width: usize,
}

/// The pixels of a window, and one more to the right and below.
type Patch = [f32; PATCH * PATCH];

impl<'a> Pixels<'a> {
    fn of(image: &'a GreyImage) -> Self {
        Self {
            values: &image.values,
            width: image.width,
        }
    }

    fn of_patch(patch: &'a Patch) -> Self {
        Self {
            values: patch,
            width: PATCH,
        }
    }
}

/// What is around a point near the border or outside, where the border pixels go on; and how a window reads it.
fn patch_at_border(image: &GreyImage, [x, y]: [f32; 2]) -> (Patch, Samples) {
    let indices = |at: f32, side: usize| -> [usize; PATCH] {
        let first = (at.floor() as i64).saturating_sub(HALF as i64);
        std::array::from_fn(|i| first.saturating_add(i as i64).clamp(0, side as i64 - 1) as usize)
    };
    let (columns, rows) = (indices(x, image.width), indices(y, image.height));
    let mut patch = [0.0; PATCH * PATCH];
    for (row, target) in rows.iter().zip(patch.chunks_exact_mut(PATCH)) {
        let source = &image.values[row * image.width..][..image.width];
        for (column, target) in columns.iter().zip(target) {
            *target = source[*column];
        }
    }
    let samples = Samples {
        first_column: 0,
        first_row: 0,
        weights: weights(x - x.floor(), y - y.floor()),
    };
    (patch, samples)
}

/// Of the pixel, its right neighbour, the one below, and the one right of that.
fn weights(x: f32, y: f32) -> [f32; 4] {
    let (left, above) = (1.0 - x, 1.0 - y);
    [left * above, x * above, left * y, x * y]
}

/// How a window that lies inside an image, with one pixel more to the right and below, is read.
#[derive(Clone, Copy)]
struct Samples {
    /// Of the window's first pixel.
    first_column: usize,
    first_row: usize,
    weights: [f32; 4],
}

impl Samples {
    fn of((width, height): (usize, usize), [x, y]: [f32; 2]) -> Option<Self> {
        let half = HALF as f32;
        let is_inside = x >= half
            && y >= half
            && x < width as f32 - (half + 1.0)
            && y < height as f32 - (half + 1.0);
        is_inside.then(|| Self {
            first_column: x.trunc() as usize - HALF,
            first_row: y.trunc() as usize - HALF,
            weights: weights(x.fract(), y.fract()),
        })
    }

    /// The pixels that one row of the window is made of: in its upper and in its lower row.
    #[inline(always)]
    fn rows<'a>(&self, image: Pixels<'a>, row: usize) -> [&'a [f32; WINDOW + 1]; 2] {
        let of = |row: usize| {
            let start = (self.first_row + row) * image.width + self.first_column;
            image.values[start..]
                .first_chunk()
                .expect("the window is inside")
        };
        [of(row), of(row + 1)]
    }
}

/// `a * b + c`, rounded once where the processor can; then twice the speed, and other last digits.
#[inline(always)]
fn fused<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Eight neighbours from column `k` of a row of the window.
#[inline(always)]
fn eight<const FMA: bool>(
    [above, below]: [&[f32; WINDOW + 1]; 2],
    weights: [f32; 4],
    k: usize,
) -> [f32; LANES] {
    std::array::from_fn(|lane| {
        let mut value = above[k + lane] * weights[0];
        value = fused::<FMA>(above[k + lane + 1], weights[1], value);
        value = fused::<FMA>(below[k + lane], weights[2], value);
        fused::<FMA>(below[k + lane + 1], weights[3], value)
    })
}

#[inline(always)]
fn one([above, below]: [&[f32; WINDOW + 1]; 2], weights: [f32; 4], k: usize) -> f32 {
    above[k] * weights[0]
        + above[k + 1] * weights[1]
        + below[k] * weights[2]
        + below[k + 1] * weights[3]
}

/// Sum over the lanes in pairs that are far apart first, as vector units do it.
#[inline(always)]
fn sum(lanes: [f32; LANES]) -> f32 {
    let four: [f32; 4] = std::array::from_fn(|i| lanes[i] + lanes[i + 4]);
    (four[0] + four[1]) + (four[2] + four[3])
}

/// The wide and the narrow body of a function over windows.
macro_rules! with_or_without_fma {
    ($name:ident($($argument:ident: $kind:ty),*) -> $result:ty = $body:ident) => {
        #[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
        fn $name($($argument: $kind),*) -> $result {
            multiversion::target::match_target! {
                "x86_64+avx2+fma" => $body::<true>($($argument),*),
                "aarch64+neon" => $body::<true>($($argument),*),
                _ => $body::<false>($($argument),*),
            }
        }
    };
}

with_or_without_fma!(cut_inside(window: &mut Window, image: Pixels<'_>, gradients: [Pixels<'_>; 2], samples: Samples) -> () = cut);
with_or_without_fma!(descent_inside(window: &Window, image: Pixels<'_>, samples: Samples) -> [f32; 2] = descent);
with_or_without_fma!(difference_inside(window: &Window, image: Pixels<'_>, samples: Samples) -> f32 = difference);

#[inline(always)]
fn cut<const FMA: bool>(
    window: &mut Window,
    image: Pixels<'_>,
    gradients: [Pixels<'_>; 2],
    samples: Samples,
) {
    let weights = samples.weights;
    let mut lanes = [[0.0_f32; LANES]; 3];
    let mut rest = [0.0_f32; 3];
    for row in 0..WINDOW {
        let pixels = samples.rows(image, row);
        let [gx, gy] = gradients.map(|g| samples.rows(g, row));
        let start = row * WINDOW;
        for k in (0..LANE_COLUMNS).step_by(LANES) {
            let (x, y) = (eight::<FMA>(gx, weights, k), eight::<FMA>(gy, weights, k));
            let to = start + k..start + k + LANES;
            window.image[to.clone()].copy_from_slice(&eight::<FMA>(pixels, weights, k));
            window.gradients[0][to.clone()].copy_from_slice(&x);
            window.gradients[1][to].copy_from_slice(&y);
            for lane in 0..LANES {
                lanes[0][lane] = fused::<FMA>(x[lane], x[lane], lanes[0][lane]);
                lanes[1][lane] = fused::<FMA>(x[lane], y[lane], lanes[1][lane]);
                lanes[2][lane] = fused::<FMA>(y[lane], y[lane], lanes[2][lane]);
            }
        }
        for k in LANE_COLUMNS..WINDOW {
            let (x, y) = (one(gx, weights, k), one(gy, weights, k));
            window.image[start + k] = one(pixels, weights, k);
            window.gradients[0][start + k] = x;
            window.gradients[1][start + k] = y;
            rest = [rest[0] + x * x, rest[1] + x * y, rest[2] + y * y];
        }
    }
    window.tensor = std::array::from_fn(|i| sum(lanes[i]) + rest[i]);
}

#[inline(always)]
fn descent<const FMA: bool>(window: &Window, image: Pixels<'_>, samples: Samples) -> [f32; 2] {
    let weights = samples.weights;
    let mut lanes = [[0.0_f32; LANES]; 2];
    let mut rest = [0.0_f32; 2];
    for row in 0..WINDOW {
        let pixels = samples.rows(image, row);
        let start = row * WINDOW;
        let ours = row_of(&window.image, start);
        let [gx, gy] = window.gradients.each_ref().map(|g| row_of(g, start));
        for k in (0..LANE_COLUMNS).step_by(LANES) {
            let theirs = eight::<FMA>(pixels, weights, k);
            for lane in 0..LANES {
                let difference = theirs[lane] - ours[k + lane];
                lanes[0][lane] = fused::<FMA>(-gx[k + lane], difference, lanes[0][lane]);
                lanes[1][lane] = fused::<FMA>(-gy[k + lane], difference, lanes[1][lane]);
            }
        }
        for k in LANE_COLUMNS..WINDOW {
            let difference = one(pixels, weights, k) - ours[k];
            rest[0] -= gx[k] * difference;
            rest[1] -= gy[k] * difference;
        }
    }
    [sum(lanes[0]) + rest[0], sum(lanes[1]) + rest[1]]
}

#[inline(always)]
fn difference<const FMA: bool>(window: &Window, image: Pixels<'_>, samples: Samples) -> f32 {
    let weights = samples.weights;
    let (mut lanes, mut rest) = ([0.0_f32; LANES], 0.0_f32);
    for row in 0..WINDOW {
        let pixels = samples.rows(image, row);
        let ours = row_of(&window.image, row * WINDOW);
        for k in (0..LANE_COLUMNS).step_by(LANES) {
            let theirs = eight::<FMA>(pixels, weights, k);
            for lane in 0..LANES {
                lanes[lane] += (theirs[lane] - ours[k + lane]).abs();
            }
        }
        for (k, ours) in ours.iter().enumerate().skip(LANE_COLUMNS) {
            rest += (one(pixels, weights, k) - ours).abs();
        }
    }
    sum(lanes) + rest
}

#[inline(always)]
fn row_of(window: &[f32; N_PIXELS], start: usize) -> &[f32; WINDOW] {
    window[start..].first_chunk().expect("rows of the window")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fused_and_plain_sums_agree_to_their_rounding() {
        let wave = |shift: f32| {
            let value = |p: usize| {
                let (x, y) = ((p % 80) as f32 - shift, (p / 80) as f32);
                0.5 + 0.2 * (0.31 * x).sin() * (0.23 * y).cos()
            };
            GreyImage {
                width: 80,
                height: 60,
                values: (0..80 * 60).map(value).collect(),
            }
        };
        let (image, other) = (wave(0.0), wave(0.5));
        let (gradients, at) = (image.gradients(), [40.3, 30.7]);
        let samples = Samples::of(image.size(), at).unwrap();
        let [mut with, mut without] = [0, 1].map(|_| Window::cut(&image, &gradients, at));
        let slopes = gradients.each_ref().map(Pixels::of);
        cut::<true>(&mut with, Pixels::of(&image), slopes, samples);
        cut::<false>(&mut without, Pixels::of(&image), slopes, samples);
        let is_near = |a: f32, b: f32| (a - b).abs() <= 1e-5 * with.tensor[0].abs();
        for i in 0..3 {
            assert!(
                is_near(with.tensor[i], without.tensor[i]),
                "{:?}",
                with.tensor
            );
        }
        let plain = descent::<false>(&with, Pixels::of(&other), samples);
        for (a, b) in descent::<true>(&with, Pixels::of(&other), samples)
            .into_iter()
            .zip(plain)
        {
            assert!(is_near(a, b), "{a} {b}");
        }
        // Pixel by pixel, inside and where the border goes on.
        for at in [at, [2.25, 55.5]] {
            let window = Window::cut(&image, &gradients, at);
            let (patch, samples) = patch_at_border(&other, at);
            let (mut sum, mut slope) = (0.0, [0.0; 2]);
            for p in 0..N_PIXELS {
                let rows = samples.rows(Pixels::of_patch(&patch), p / WINDOW);
                let difference = one(rows, samples.weights, p % WINDOW) - window.image[p];
                sum += difference.abs();
                slope[0] -= window.gradients[0][p] * difference;
                slope[1] -= window.gradients[1][p] * difference;
            }
            let difference = window.difference(&other, at) * N_PIXELS as f32;
            assert!(difference > 1.0, "{difference}");
            assert!((difference - sum).abs() < 1e-4 * sum, "{difference} {sum}");
            for (a, b) in window.descent(&other, at).into_iter().zip(slope) {
                assert!(is_near(a, b), "{a} {b}");
            }
        }
    }

    #[test]
    fn a_copy_of_what_is_around_a_point_reads_as_the_image_and_its_border_goes_on() {
        let image = GreyImage {
            width: 40,
            height: 30,
            values: (0..40 * 30)
                .map(|p| ((p * 7919) % 101) as f32 / 101.0)
                .collect(),
        };
        let read = |pixels: Pixels<'_>, samples: Samples| -> Vec<f32> {
            let rows = (0..WINDOW).map(|row| samples.rows(pixels, row));
            let row = |rows| (0..WINDOW).map(move |k| one(rows, samples.weights, k));
            rows.flat_map(row).collect()
        };
        let at = [19.3, 14.8];
        let (patch, samples) = patch_at_border(&image, at);
        let inside = Samples::of(image.size(), at).unwrap();
        assert_eq!(
            read(Pixels::of_patch(&patch), samples),
            read(Pixels::of(&image), inside)
        );
        for at in [[2.25, 28.5], [-30.0, 3.0], [1e9, -1e9]] {
            let (patch, samples) = patch_at_border(&image, at);
            let found = read(Pixels::of_patch(&patch), samples);
            for (p, found) in found.iter().enumerate() {
                let offset = |ix: usize| ix as f32 - HALF as f32;
                let x = (at[0] + offset(p % WINDOW)).clamp(0.0, 39.0);
                let y = (at[1] + offset(p / WINDOW)).clamp(0.0, 29.0);
                let value = |column: f32, row: f32| {
                    let (column, row) = (column.min(39.0) as usize, row.min(29.0) as usize);
                    image.values[row * 40 + column]
                };
                let (left, top) = (x.floor(), y.floor());
                let above =
                    value(left, top) * (1.0 - x.fract()) + value(left + 1.0, top) * x.fract();
                let below = value(left, top + 1.0) * (1.0 - x.fract())
                    + value(left + 1.0, top + 1.0) * x.fract();
                let expected = above * (1.0 - y.fract()) + below * y.fract();
                assert!(
                    (found - expected).abs() < 1e-5,
                    "{at:?} {p}: {found} {expected}"
                );
            }
        }
    }
}
