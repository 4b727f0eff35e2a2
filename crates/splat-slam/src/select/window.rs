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
/// Per pixel of the window, the smaller eigenvalue of the structure tensor below which a point has no definite place.
const MIN_EIGENVALUE: f32 = 1e-4;
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
        match Samples::of(image.size(), centre) {
            Some(samples) => cut_inside(&mut window, image, gradients, samples),
            None => window.cut_at_border(image, gradients, centre),
        }
        window
    }

    fn cut_at_border(&mut self, image: &GreyImage, [gx, gy]: &[GreyImage; 2], centre: [f32; 2]) {
        let [a, b, c] = &mut self.tensor;
        for (p, at) in positions(centre).enumerate() {
            self.image[p] = clamped(image, at);
            let (x, y) = (clamped(gx, at), clamped(gy, at));
            (self.gradients[0][p], self.gradients[1][p]) = (x, y);
            *a += x * x;
            *b += x * y;
            *c += y * y;
        }
    }

    /// `None` where the window has too little structure to be followed.
    pub(crate) fn inverse_tensor(&self) -> Option<Inverse> {
        let [a, b, c] = self.tensor;
        let determinant = a * c - b * b;
        if determinant.abs() < MIN_DETERMINANT {
            return None;
        }
        let spread = a - c;
        let smaller = (a + c - (spread * spread + 4.0 * b * b).sqrt()) * 0.5;
        if smaller / (N_PIXELS as f32) < MIN_EIGENVALUE {
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
            return descent_inside(self, image, samples);
        }
        let mut sums = [0.0; 2];
        for (p, at) in positions(at).enumerate() {
            let difference = clamped(image, at) - self.image[p];
            sums[0] -= self.gradients[0][p] * difference;
            sums[1] -= self.gradients[1][p] * difference;
        }
        sums
    }

    /// Mean absolute difference.
    pub(crate) fn difference(&self, image: &GreyImage, at: [f32; 2]) -> f32 {
        let sum = match Samples::of(image.size(), at) {
            Some(samples) => difference_inside(self, image, samples),
            None => self.difference_at_border(image, at),
        };
        sum / N_PIXELS as f32
    }

    fn difference_at_border(&self, image: &GreyImage, at: [f32; 2]) -> f32 {
        let mut sum = 0.0;
        for (p, at) in positions(at).enumerate() {
            sum += (clamped(image, at) - self.image[p]).abs();
        }
        sum
    }
}

/// The pixels of the window around a point, row by row.
fn positions([x, y]: [f32; 2]) -> impl Iterator<Item = [f32; 2]> {
    let offset = |ix: usize| ix as f32 - HALF as f32;
    (0..N_PIXELS).map(move |p| [x + offset(p % WINDOW), y + offset(p / WINDOW)])
}

/// Bilinear; outside, the border pixel goes on.
fn clamped(image: &GreyImage, [x, y]: [f32; 2]) -> f32 {
    let (right, bottom) = (image.width - 1, image.height - 1);
    let (x, y) = (x.clamp(0.0, right as f32), y.clamp(0.0, bottom as f32));
    let (column, row) = (x.trunc() as usize, y.trunc() as usize);
    let (next_column, next_row) = ((column + 1).min(right), (row + 1).min(bottom));
    let at = |row: usize, column: usize| image.values[row * image.width + column];
    let [w00, w01, w10, w11] = weights(x.fract(), y.fract());
    at(row, column) * w00
        + at(row, next_column) * w01
        + at(next_row, column) * w10
        + at(next_row, next_column) * w11
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
    fn rows<'a>(&self, image: &'a GreyImage, row: usize) -> [&'a [f32; WINDOW + 1]; 2] {
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

with_or_without_fma!(cut_inside(window: &mut Window, image: &GreyImage, gradients: &[GreyImage; 2], samples: Samples) -> () = cut);
with_or_without_fma!(descent_inside(window: &Window, image: &GreyImage, samples: Samples) -> [f32; 2] = descent);
with_or_without_fma!(difference_inside(window: &Window, image: &GreyImage, samples: Samples) -> f32 = difference);

#[inline(always)]
fn cut<const FMA: bool>(
    window: &mut Window,
    image: &GreyImage,
    gradients: &[GreyImage; 2],
    samples: Samples,
) {
    let weights = samples.weights;
    let mut lanes = [[0.0_f32; LANES]; 3];
    let mut rest = [0.0_f32; 3];
    for row in 0..WINDOW {
        let pixels = samples.rows(image, row);
        let [gx, gy] = gradients.each_ref().map(|g| samples.rows(g, row));
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
fn descent<const FMA: bool>(window: &Window, image: &GreyImage, samples: Samples) -> [f32; 2] {
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
fn difference<const FMA: bool>(window: &Window, image: &GreyImage, samples: Samples) -> f32 {
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
        cut::<true>(&mut with, &image, &gradients, samples);
        cut::<false>(&mut without, &image, &gradients, samples);
        let is_near = |a: f32, b: f32| (a - b).abs() <= 1e-5 * with.tensor[0].abs();
        for i in 0..3 {
            assert!(
                is_near(with.tensor[i], without.tensor[i]),
                "{:?}",
                with.tensor
            );
        }
        let plain = descent::<false>(&with, &other, samples);
        for (a, b) in descent::<true>(&with, &other, samples)
            .into_iter()
            .zip(plain)
        {
            assert!(is_near(a, b), "{a} {b}");
        }
        // As if it lay at the border, pixel by pixel.
        let difference = with.difference(&other, at) * N_PIXELS as f32;
        assert!(difference > 1.0 && is_near(difference, with.difference_at_border(&other, at)));
    }
}
