//! Reference and source pictures -> matching cost of each pixel on each plane of a sweep.
//!
//! Planes are parallel to the reference picture. A cost is 1 - ZNCC over a square window, averaged over the two
//! sources that match best: a point hidden from some sources is still seen by two.

use multiversion::multiversion;
use rayon::prelude::*;

use super::Prepared;
use super::grey::Grey;
use super::planes::Planes;

/// Side of the matching window in pixels.
pub(super) const WINDOW: usize = 7;
const RADIUS: usize = WINDOW / 2;

/// Variance of a pixel that is noise only, squared luma: about one grey level after averaging. It pulls the ZNCC of
/// blank walls to 0, where smoothness decides, instead of letting noise decide.
pub(super) const NOISE_VARIANCE: f32 = (1.0 / 255.0) * (1.0 / 255.0);

/// Cost of a plane that no source sees: as bad as a ZNCC of this.
pub(super) const UNSEEN_ZNCC: f32 = 0.2;

/// Below this angle between the rays, depth from noisy poses is guesswork.
const MIN_ANGLE_RAD: f64 = 0.008;

/// Below this way across the source picture, from the near to the far plane, there is nothing to tell planes apart.
const MIN_TRAVEL_PX: f64 = 1.5;

/// The way from reference pixels to source pixels: `pixel_map * (x, y, 1) + inverse_depth * shift`, homogeneous.
#[derive(Debug)]
pub(super) struct Warp<'a> {
    pub(super) source: &'a Grey,
    /// Columns for x, y and 1. Pixel index space on both sides: centres at integers.
    pub(super) pixel_map: [[f64; 3]; 3],
    shift: [f64; 3],
}

impl<'a> Warp<'a> {
    /// `None` without parallax.
    pub(super) fn new(reference: &Prepared, source: &'a Prepared, planes: &Planes) -> Option<Self> {
        let source_from_reference = source.world_from_cam.inverse() * reference.world_from_cam;
        let rotation = source_from_reference.rotation_matrix();
        let (from, to) = (&reference.intrinsics, &source.intrinsics);
        // Half a pixel less on the way out, half a pixel more on the way in.
        let project = |p: glam::DVec3| {
            [
                to.fx * p.x + (to.cx - 0.5) * p.z,
                to.fy * p.y + (to.cy - 0.5) * p.z,
                p.z,
            ]
        };
        let corner = glam::DVec3::new((0.5 - from.cx) / from.fx, (0.5 - from.cy) / from.fy, 1.0);
        let warp = Self {
            source: &source.grey,
            pixel_map: [
                project(rotation.x_axis / from.fx),
                project(rotation.y_axis / from.fy),
                project(rotation * corner),
            ],
            shift: project(source_from_reference.translation),
        };
        let middle = 0.5 * (planes.inverse_near + planes.inverse_far);
        let angle = source_from_reference.translation.length() * middle;
        (angle >= MIN_ANGLE_RAD && warp.travel_px(reference, planes) >= MIN_TRAVEL_PX)
            .then_some(warp)
    }

    /// Longest way of a few test pixels across the source, from the far to the near plane; 0 where both miss it.
    fn travel_px(&self, reference: &Prepared, planes: &Planes) -> f64 {
        let mut longest = 0.0_f64;
        for (share_x, share_y) in [(0.5, 0.5), (0.2, 0.2), (0.8, 0.2), (0.2, 0.8), (0.8, 0.8)] {
            let x = share_x * reference.grey.width as f64;
            let y = share_y * reference.grey.height as f64;
            let far = self.pixel_in_source(x, y, planes.inverse_far);
            let near = self.pixel_in_source(x, y, planes.inverse_near);
            longest = match (far, near) {
                (Some(far), Some(near)) => longest.max((far - near).length()),
                // Behind the source on one end: it moves as far as can be.
                (Some(_), None) | (None, Some(_)) => f64::INFINITY,
                (None, None) => longest,
            };
        }
        longest
    }

    pub(super) fn homogeneous(&self, x: f64, y: f64, inverse_depth: f64) -> glam::DVec3 {
        let column = |ix: usize| glam::DVec3::from_array(self.pixel_map[ix]);
        column(0) * x
            + column(1) * y
            + column(2)
            + glam::DVec3::from_array(self.shift) * inverse_depth
    }

    fn pixel_in_source(&self, x: f64, y: f64, inverse_depth: f64) -> Option<glam::DVec2> {
        let h = self.homogeneous(x, y, inverse_depth);
        (h.z > 1e-9).then(|| h.truncate() / h.z)
    }

    fn row(&self, y: usize, inverse_depth: f64) -> WarpedRow {
        WarpedRow {
            start: self
                .homogeneous(0.0, y as f64, inverse_depth)
                .as_vec3()
                .to_array(),
            step: glam::DVec3::from_array(self.pixel_map[0])
                .as_vec3()
                .to_array(),
        }
    }
}

/// Homogeneous source pixels along one row of the reference.
struct WarpedRow {
    start: [f32; 3],
    step: [f32; 3],
}

/// Cost 0 (perfect) to 255, `[y][x][plane]`.
pub(super) fn matching_costs(reference: &Grey, warps: &[Warp<'_>], planes: &Planes) -> Vec<u8> {
    let n_pixels = reference.width * reference.height;
    let statistics = Statistics::of(reference);
    let mut by_plane = vec![0_u8; planes.n * n_pixels];
    by_plane
        .par_chunks_mut(n_pixels)
        .enumerate()
        .for_each(|(plane, costs)| {
            plane_costs(
                reference,
                &statistics,
                warps,
                planes.inverse_depth(plane as f64),
                costs,
            );
        });
    let mut costs = vec![0_u8; planes.n * n_pixels];
    let (width, n_planes) = (reference.width, planes.n);
    costs
        .par_chunks_mut(width * n_planes)
        .enumerate()
        .for_each(|(y, row)| {
            for plane in 0..n_planes {
                let from = &by_plane[plane * n_pixels + y * width..][..width];
                for (into, &cost) in row[plane..].iter_mut().step_by(n_planes).zip(from) {
                    *into = cost;
                }
            }
        });
    costs
}

/// Sums over the window around each reference pixel, cut off at the border of the picture.
pub(super) struct Statistics {
    pub(super) sum: Vec<f32>,
    /// n * variance + noise.
    pub(super) spread: Vec<f32>,
    pub(super) one_over_n: Vec<f32>,
}

impl Statistics {
    pub(super) fn of(grey: &Grey) -> Self {
        let n_pixels = grey.values.len();
        let mut all = Self {
            sum: vec![0.0; n_pixels],
            spread: vec![0.0; n_pixels],
            one_over_n: vec![0.0; n_pixels],
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
                let ix = y * grey.width + x;
                all.sum[ix] = sum;
                all.spread[ix] = (squares - sum * sum / n).max(0.0) + n * NOISE_VARIANCE;
                all.one_over_n[ix] = 1.0 / n;
            }
        }
        all
    }
}

/// What one source needs between rows: its last `WINDOW` warped rows.
struct Ring {
    values: Vec<f32>,
    /// 1 where the warped pixel lies in the source picture.
    seen: Vec<f32>,
}

fn plane_costs(
    reference: &Grey,
    statistics: &Statistics,
    warps: &[Warp<'_>],
    inverse_depth: f64,
    costs: &mut [u8],
) {
    let (width, height) = (reference.width, reference.height);
    let mut rings: Vec<Ring> = warps
        .iter()
        .map(|_| Ring {
            values: vec![0.0; WINDOW * width],
            seen: vec![0.0; WINDOW * width],
        })
        .collect();
    let mut scratch = Scratch::new(width);
    for y in 0..height + RADIUS {
        if y < height {
            for (warp, ring) in warps.iter().zip(&mut rings) {
                let slot = (y % WINDOW) * width;
                let (values, seen) = (
                    &mut ring.values[slot..slot + width],
                    &mut ring.seen[slot..slot + width],
                );
                warp_row(
                    warp,
                    &warp.row(y, inverse_depth),
                    &mut scratch,
                    values,
                    seen,
                );
            }
        }
        let Some(centre) = y.checked_sub(RADIUS) else {
            continue;
        };
        let window_rows = centre.saturating_sub(RADIUS)..(centre + RADIUS + 1).min(height);
        let at = centre * width..(centre + 1) * width;
        scratch.best.fill(-1.0);
        scratch.second.fill(-1.0);
        for ring in &rings {
            column_sums(reference, ring, window_rows.clone(), &mut scratch);
            let of_reference = [
                &statistics.sum[at.clone()],
                &statistics.spread[at.clone()],
                &statistics.one_over_n[at.clone()],
            ];
            let slot = (centre % WINDOW) * width;
            window_zncc(of_reference, &ring.seen[slot..slot + width], &mut scratch);
        }
        mean_costs(&scratch.best, &scratch.second, &mut costs[at]);
    }
}

/// Rows that live as long as one plane.
struct Scratch {
    index: Vec<i32>,
    share_x: Vec<f32>,
    share_y: Vec<f32>,
    /// Column sums with `RADIUS` zeros on both sides: source, source squared, source times reference.
    sums: [Vec<f32>; 3],
    best: Vec<f32>,
    second: Vec<f32>,
}

impl Scratch {
    fn new(width: usize) -> Self {
        let row = || vec![0.0_f32; width];
        let padded = || vec![0.0_f32; width + 2 * RADIUS];
        Self {
            index: vec![0; width],
            share_x: row(),
            share_y: row(),
            sums: [padded(), padded(), padded()],
            best: row(),
            second: row(),
        }
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn warp_row(
    warp: &Warp<'_>,
    row: &WarpedRow,
    scratch: &mut Scratch,
    values: &mut [f32],
    seen: &mut [f32],
) {
    let n = values.len();
    let (width, height) = (warp.source.width, warp.source.height);
    let (last_x, last_y) = ((width - 1) as f32, (height - 1) as f32);
    let (cell_x, cell_y) = ((width - 2) as f32, (height - 2) as f32);
    let (index, share_x, share_y) = (
        &mut scratch.index[..n],
        &mut scratch.share_x[..n],
        &mut scratch.share_y[..n],
    );
    let seen = &mut seen[..n];
    for x in 0..n {
        let along = x as f32;
        let depth = row.start[2] + along * row.step[2];
        let over = 1.0 / depth.max(1e-6);
        let u = (row.start[0] + along * row.step[0]) * over;
        let v = (row.start[1] + along * row.step[1]) * over;
        // Half a pixel beyond the outermost centres still belongs to the picture.
        let inside =
            (depth > 1e-6) & (u >= -0.5) & (v >= -0.5) & (u <= last_x + 0.5) & (v <= last_y + 0.5);
        seen[x] = if inside { 1.0 } else { 0.0 };
        let u = u.max(0.0).min(last_x);
        let v = v.max(0.0).min(last_y);
        let left = u.floor().min(cell_x);
        let top = v.floor().min(cell_y);
        share_x[x] = u - left;
        share_y[x] = v - top;
        index[x] = top as i32 * width as i32 + left as i32;
    }
    let pixels = &warp.source.values[..];
    for x in 0..n {
        let at = index[x] as usize;
        let (upper, lower) = (&pixels[at..at + 2], &pixels[at + width..at + width + 2]);
        let above = upper[0] + (upper[1] - upper[0]) * share_x[x];
        let below = lower[0] + (lower[1] - lower[0]) * share_x[x];
        values[x] = above + (below - above) * share_y[x];
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn column_sums(reference: &Grey, ring: &Ring, rows: std::ops::Range<usize>, scratch: &mut Scratch) {
    let width = reference.width;
    let [sum, squares, products] = &mut scratch.sums;
    let sum = &mut sum[RADIUS..RADIUS + width];
    let squares = &mut squares[RADIUS..RADIUS + width];
    let products = &mut products[RADIUS..RADIUS + width];
    sum.fill(0.0);
    squares.fill(0.0);
    products.fill(0.0);
    for y in rows {
        let source = &ring.values[(y % WINDOW) * width..][..width];
        let row = &reference.row(y)[..width];
        for x in 0..width {
            let value = source[x];
            sum[x] += value;
            squares[x] += value * value;
            products[x] += value * row[x];
        }
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn window_zncc(of_reference: [&[f32]; 3], seen: &[f32], scratch: &mut Scratch) {
    let n = seen.len();
    let [sum, squares, products] = &scratch.sums;
    let (sum, squares, products) = (&sum[..n + 6], &squares[..n + 6], &products[..n + 6]);
    let [reference_sum, reference_spread, one_over_n] = of_reference.map(|slice| &slice[..n]);
    let (best, second) = (&mut scratch.best[..n], &mut scratch.second[..n]);
    for x in 0..n {
        let across = |of: &[f32]| {
            (of[x] + of[x + 1]) + (of[x + 2] + of[x + 3]) + (of[x + 4] + of[x + 5]) + of[x + 6]
        };
        let (s, ss, rs) = (across(sum), across(squares), across(products));
        let share = one_over_n[x];
        let spread = (ss - s * s * share).max(0.0) + NOISE_VARIANCE / share;
        let zncc = (rs - reference_sum[x] * s * share) / (reference_spread[x] * spread).sqrt();
        let zncc = if seen[x] > 0.0 { zncc } else { -1.0 };
        second[x] = second[x].max(zncc.min(best[x]));
        best[x] = best[x].max(zncc);
    }
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
        *cost = ((1.0 - zncc.max(0.0)) * 255.0 + 0.5) as u8;
    }
}
