//! Rows of pixels -> their matching costs: the inner loops of the sweep.

use multiversion::multiversion;

use crate::mvs::gpu_types::SWEEP_WINDOW;
use crate::mvs::luma::Grey;
use crate::mvs::warp::{Warp, WarpedRow};

/// Side of the matching window in pixels. A wider one makes things wider; smoothness takes care of the noise.
pub(crate) const WINDOW: usize = SWEEP_WINDOW as usize;
const RADIUS: usize = WINDOW / 2;

/// Pixels that the inner loops take at once; rows are padded to a multiple. Fixed arrays of this length and no branch
/// let LLVM turn them into vector code.
const BLOCK: usize = 16;
type Block = [f32; BLOCK];

/// Added to a number from 0 to 2^23, it leaves the nearest integer in the low bits of the mantissa.
const TO_INTEGER: f32 = 8_388_608.0;

/// Variance of a pixel that is noise only, squared luma: about one grey level after averaging. It pulls the ZNCC of
/// blank walls to 0, where smoothness decides, instead of letting noise decide.
pub(crate) const NOISE_VARIANCE: f32 = (1.0 / 255.0) * (1.0 / 255.0);

/// Cost of a plane that no source sees: as bad as a ZNCC of this.
pub(crate) const UNSEEN_ZNCC: f32 = 0.2;

/// Of a score, what the pixel itself says; the rest is ZNCC.
pub(crate) const OWN_SHARE: f32 = 0.4;

/// A difference of luma from which on the pixel itself says no.
pub(crate) const MOST_OFF: f32 = 0.03;

/// Length of a row.
pub(crate) fn padded(width: usize) -> usize {
    width.next_multiple_of(BLOCK)
}

/// Sums over the window around each reference pixel, cut off at the border of the image; rows are padded.
pub(crate) struct Statistics {
    pub(crate) sum: Vec<f32>,
    /// n * variance + noise.
    pub(crate) spread: Vec<f32>,
    pub(crate) one_over_n: Vec<f32>,
    /// How far off the luma of the pixel itself may be for its place alone: half way to its neighbours (Birchfield and
    /// Tomasi 1998).
    pub(crate) slack: Vec<f32>,
}

impl Statistics {
    pub(crate) fn of(grey: &Grey) -> Self {
        let stride = padded(grey.width);
        let mut all = Self {
            sum: vec![0.0; stride * grey.height],
            spread: vec![1.0; stride * grey.height],
            one_over_n: vec![1.0; stride * grey.height],
            slack: vec![0.0; stride * grey.height],
        };
        for y in 0..grey.height {
            let rows = y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(grey.height);
            for x in 0..grey.width {
                let columns = x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(grey.width);
                let n = (rows.len() * columns.len()) as f32;
                let (mut sum, mut squares) = (0.0, 0.0);
                for row in rows.clone() {
                    for &value in &grey.row(row)[columns.clone()] {
                        sum += value;
                        squares += value * value;
                    }
                }
                let ix = y * stride + x;
                all.sum[ix] = sum;
                all.spread[ix] = (squares - sum * sum / n).max(0.0) + n * NOISE_VARIANCE;
                all.one_over_n[ix] = 1.0 / n;
                all.slack[ix] = slack(grey, x, y);
            }
        }
        all
    }
}

pub(crate) fn slack(grey: &Grey, x: usize, y: usize) -> f32 {
    let (row, own) = (grey.row(y), grey.row(y)[x]);
    let beside = [
        row[x.saturating_sub(1)],
        row[(x + 1).min(grey.width - 1)],
        grey.row(y.saturating_sub(1))[x],
        grey.row((y + 1).min(grey.height - 1))[x],
    ];
    let widest = beside.iter().fold(0.0_f32, |w, b| w.max((b - own).abs()));
    0.5 * widest
}

/// What one source needs between rows: its last `WINDOW` warped rows.
struct Ring {
    values: Vec<f32>,
    /// 1 where the warped pixel lies in the source image.
    seen: Vec<f32>,
}

/// Cost 0 (perfect) to 255 of every pixel on one plane.
pub(crate) fn plane_costs(
    reference: &Grey,
    statistics: &Statistics,
    warps: &[Warp<'_>],
    own_share: f32,
    inverse_depth: f64,
    costs: &mut [u8],
) {
    let (width, height) = (reference.width, reference.height);
    let stride = padded(width);
    let mut rings: Vec<Ring> = warps
        .iter()
        .map(|_| Ring {
            values: vec![0.0; WINDOW * stride],
            seen: vec![0.0; WINDOW * stride],
        })
        .collect();
    let mut scratch = Scratch::new(width);
    for y in 0..height + RADIUS {
        if y < height {
            for (warp, ring) in warps.iter().zip(&mut rings) {
                let slot = (y % WINDOW) * stride;
                let (values, seen) = (
                    &mut ring.values[slot..slot + stride],
                    &mut ring.seen[slot..slot + stride],
                );
                warp_row(warp, &warp.row(y, inverse_depth), values, seen);
            }
        }
        let Some(centre) = y.checked_sub(RADIUS) else {
            continue;
        };
        let window_rows = centre.saturating_sub(RADIUS)..(centre + RADIUS + 1).min(height);
        let at = centre * stride..(centre + 1) * stride;
        scratch.best.fill(-1.0);
        scratch.second.fill(-1.0);
        for (ring, warp) in rings.iter().zip(warps) {
            column_sums(reference, ring, window_rows.clone(), &mut scratch);
            let of_reference = [
                &statistics.sum[at.clone()],
                &statistics.spread[at.clone()],
                &statistics.one_over_n[at.clone()],
            ];
            let slot = (centre % WINDOW) * stride;
            let own = &ring.values[slot..slot + width];
            let slack = &statistics.slack[at.start..at.start + width];
            let shown = &warp.shown[centre * width..(centre + 1) * width];
            likeness(shown, own, slack, &mut scratch.likeness);
            window_scores(
                of_reference,
                &ring.seen[slot..slot + stride],
                own_share,
                &mut scratch,
            );
        }
        let into = &mut costs[centre * width..(centre + 1) * width];
        mean_costs(&scratch.best, &scratch.second, into);
    }
}

/// Rows that live as long as one plane.
struct Scratch {
    /// Column sums with `RADIUS` zeros on both sides: source, source squared, source times reference.
    sums: [Vec<f32>; 3],
    likeness: Vec<f32>,
    best: Vec<f32>,
    second: Vec<f32>,
}

impl Scratch {
    fn new(width: usize) -> Self {
        let row = || vec![0.0_f32; padded(width)];
        let wide = || vec![0.0_f32; padded(width) + 2 * RADIUS];
        Self {
            sums: [wide(), wide(), wide()],
            likeness: row(),
            best: row(),
            second: row(),
        }
    }
}

/// Pixels of the source along one row of the reference, and 1 where they lie in it.
#[multiversion(targets("x86_64+avx2"))]
fn warp_row(warp: &Warp<'_>, row: &WarpedRow, values: &mut [f32], seen: &mut [f32]) {
    let (width, height) = (warp.source.width, warp.source.height);
    let (last_x, last_y) = ((width - 1) as f32, (height - 1) as f32);
    let (cell_x, cell_y) = ((width - 2) as f32, (height - 2) as f32);
    let stride = width as u32;
    let pixels = &warp.source.values[..];
    let blocks = values.as_chunks_mut::<BLOCK>().0.iter_mut();
    let blocks = blocks.zip(seen.as_chunks_mut::<BLOCK>().0);
    for (block_ix, (values, seen)) in blocks.enumerate() {
        let mut index = [0_u32; BLOCK];
        let (mut share_x, mut share_y): (Block, Block) = ([0.0; BLOCK], [0.0; BLOCK]);
        for x in 0..BLOCK {
            let along = (block_ix * BLOCK + x) as f32;
            let depth = row.start[2] + along * row.step[2];
            let over = 1.0 / depth.max(1e-6);
            let u = (row.start[0] + along * row.step[0]) * over;
            let v = (row.start[1] + along * row.step[1]) * over;
            // Half a pixel beyond the outermost centres still belongs to the image.
            let inside = (depth > 1e-6)
                & (u >= -0.5)
                & (v >= -0.5)
                & (u <= last_x + 0.5)
                & (v <= last_y + 0.5);
            seen[x] = if inside { 1.0 } else { 0.0 };
            let u = u.max(0.0).min(last_x);
            let v = v.max(0.0).min(last_y);
            let left = u.floor().min(cell_x);
            let top = v.floor().min(cell_y);
            share_x[x] = u - left;
            share_y[x] = v - top;
            index[x] = integer(top) * stride + integer(left);
        }
        let (mut above, mut below): ([Block; 2], [Block; 2]) =
            ([[0.0; BLOCK]; 2], [[0.0; BLOCK]; 2]);
        for x in 0..BLOCK {
            let at = index[x] as usize;
            let (upper, lower) = (&pixels[at..at + 2], &pixels[at + width..at + width + 2]);
            (above[0][x], above[1][x]) = (upper[0], upper[1]);
            (below[0][x], below[1][x]) = (lower[0], lower[1]);
        }
        for x in 0..BLOCK {
            let above = above[0][x] + (above[1][x] - above[0][x]) * share_x[x];
            let below = below[0][x] + (below[1][x] - below[0][x]) * share_x[x];
            values[x] = above + (below - above) * share_y[x];
        }
    }
}

/// Of a whole number from 0 to 2^22; a conversion by `as` is not vectorised for its care about NaN and overflow.
#[inline(always)]
pub(crate) fn integer(whole: f32) -> u32 {
    (whole + TO_INTEGER).to_bits() & 0x007F_FFFF
}

#[multiversion(targets("x86_64+avx2"))]
fn column_sums(reference: &Grey, ring: &Ring, rows: std::ops::Range<usize>, scratch: &mut Scratch) {
    let (width, stride) = (reference.width, padded(reference.width));
    let [sum, squares, products] = &mut scratch.sums;
    let sum = &mut sum[RADIUS..RADIUS + width];
    let squares = &mut squares[RADIUS..RADIUS + width];
    let products = &mut products[RADIUS..RADIUS + width];
    sum.fill(0.0);
    squares.fill(0.0);
    products.fill(0.0);
    for y in rows {
        let source = &ring.values[(y % WINDOW) * stride..][..width];
        let row = &reference.row(y)[..width];
        for x in 0..width {
            let value = source[x];
            sum[x] += value;
            squares[x] += value * value;
            products[x] += value * row[x];
        }
    }
}

/// What the pixels themselves say: 1 alike, 0 not. `shown`: the reference in the light of the source.
#[multiversion(targets("x86_64+avx2"))]
fn likeness(shown: &[f32], source: &[f32], slack: &[f32], into: &mut [f32]) {
    let pairs = shown.iter().zip(source).zip(slack);
    for (((own, other), slack), like) in pairs.zip(into) {
        let off = ((own - other).abs() - slack).max(0.0);
        *like = 1.0 - (off / MOST_OFF).min(1.0);
    }
}

/// Keeps the best two sources of every pixel of a row.
#[multiversion(targets("x86_64+avx2"))]
fn window_scores(of_reference: [&[f32]; 3], seen: &[f32], own_share: f32, scratch: &mut Scratch) {
    let [reference_sum, reference_spread, one_over_n] =
        of_reference.map(|row| row.as_chunks::<BLOCK>().0);
    let seen = seen.as_chunks::<BLOCK>().0;
    let likeness = scratch.likeness.as_chunks::<BLOCK>().0;
    let best = scratch.best.as_chunks_mut::<BLOCK>().0;
    let second = scratch.second.as_chunks_mut::<BLOCK>().0;
    let blocks = best.iter_mut().zip(second).zip(seen.iter().zip(likeness));
    let of_reference = reference_sum.iter().zip(reference_spread).zip(one_over_n);
    let [sum, squares, products] = &scratch.sums;
    for (
        ix,
        (((best, second), (seen, likeness)), ((reference_sum, reference_spread), one_over_n)),
    ) in blocks.zip(of_reference).enumerate()
    {
        let at = ix * BLOCK;
        let (s, ss, rs) = (across(sum, at), across(squares, at), across(products, at));
        for x in 0..BLOCK {
            let share = one_over_n[x];
            let spread = (ss[x] - s[x] * s[x] * share).max(0.0) + NOISE_VARIANCE / share;
            let zncc =
                (rs[x] - reference_sum[x] * s[x] * share) / (reference_spread[x] * spread).sqrt();
            let score = zncc + own_share * (likeness[x] - zncc.max(0.0));
            let score = if seen[x] > 0.0 { score } else { -1.0 };
            second[x] = second[x].max(score.min(best[x]));
            best[x] = best[x].max(score);
        }
    }
}

/// Sums of `WINDOW` neighbours, from `at` on.
#[inline(always)]
fn across(row: &[f32], at: usize) -> Block {
    let mut sums = [0.0; BLOCK];
    if let Some(row) = row[at..].first_chunk::<{ BLOCK + 2 * RADIUS }>() {
        for x in 0..BLOCK {
            sums[x] = (row[x] + row[x + 1]) + (row[x + 2] + row[x + 3]) + row[x + 4];
        }
    }
    sums
}

/// -1 stands for a source that does not see the plane.
#[multiversion(targets("x86_64+avx2"))]
fn mean_costs(best: &[f32], second: &[f32], costs: &mut [u8]) {
    for ((&best, &second), cost) in best.iter().zip(second).zip(costs) {
        let second = if second > -1.0 {
            second
        } else {
            best.min(UNSEEN_ZNCC)
        };
        let zncc = if best > -1.0 {
            0.5 * (best + second)
        } else {
            UNSEEN_ZNCC
        };
        *cost = integer((1.0 - zncc.clamp(0.0, 1.0)) * 255.0) as u8;
    }
}
