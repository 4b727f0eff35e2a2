//! Matching costs -> one plane per pixel by semi-global matching (Hirschmueller 2008) over eight paths.

use multiversion::multiversion;
use rayon::prelude::*;

use crate::mvs::luma::Grey;

/// Penalty for a step of one plane, in units of the cost (255 = no match at all).
pub(crate) const SMALL_STEP: u16 = 10;
/// Penalty for any larger jump where the image is even; an edge in the image divides it.
const LARGE_STEP: f32 = 90.0;
const LARGE_STEP_MIN: u16 = 24;
/// A luma difference of this halves the penalty of a jump.
const EDGE_LUMA: f32 = 10.0 / 255.0;

#[derive(Debug)]
pub(crate) struct Winners {
    /// Fractional plane, -1 = none.
    pub(crate) plane: Vec<f32>,
    /// ZNCC there, 0 to 1.
    pub(crate) score: Vec<f32>,
    /// 0 to 1.
    pub(crate) margin: Vec<f32>,
}

/// `costs` is `[y][x][plane]`.
pub(crate) fn best_planes(grey: &Grey, costs: &[u8], n_planes: usize) -> Winners {
    let (width, height) = (grey.width, grey.height);
    let row_cells = width * n_planes;
    let mut down = vec![0_u16; costs.len()];
    let mut up = vec![0_u16; costs.len()];
    down.par_chunks_mut(row_cells)
        .enumerate()
        .for_each(|(y, sums)| {
            along_row(
                grey.row(y),
                &costs[y * row_cells..(y + 1) * row_cells],
                n_planes,
                sums,
            );
        });
    rayon::join(
        || across_rows(grey, costs, n_planes, &mut down, |step| step),
        || across_rows(grey, costs, n_planes, &mut up, |step| height - 1 - step),
    );
    let n_pixels = width * height;
    let mut winners = Winners {
        plane: vec![-1.0; n_pixels],
        score: vec![0.0; n_pixels],
        margin: vec![0.0; n_pixels],
    };
    let rows = winners
        .plane
        .par_chunks_mut(width)
        .zip(winners.score.par_chunks_mut(width));
    rows.zip(winners.margin.par_chunks_mut(width))
        .enumerate()
        .for_each(|(y, ((plane, score), margin))| {
            let mut total = vec![0_u16; n_planes];
            for x in 0..width {
                let at = (y * width + x) * n_planes..(y * width + x + 1) * n_planes;
                add_into(&mut total, &down[at.clone()], &up[at.clone()]);
                let Some(dip) = dip_of(&total) else {
                    continue;
                };
                plane[x] = dip.fractional_plane();
                score[x] = score_of(costs[at.start + dip.plane]);
                margin[x] = dip.margin();
            }
        });
    winners
}

fn add_into(total: &mut [u16], a: &[u16], b: &[u16]) {
    for ((total, &a), &b) in total.iter_mut().zip(a).zip(b) {
        *total = a + b;
    }
}

/// `None` when the first or last plane wins: the surface lies outside of the range.
fn dip_of(total: &[u16]) -> Option<Dip> {
    let lowest = lowest_of(total);
    let plane = total.iter().position(|&sum| sum == lowest)?;
    if plane == 0 || plane + 1 == total.len() {
        return None;
    }
    Some(Dip {
        plane,
        before: total[plane - 1],
        lowest,
        after: total[plane + 1],
        second: lowest_of(&total[..plane - 1]).min(lowest_of(&total[plane + 2..])),
    })
}

/// The lowest sum of a pixel, neither on the first plane nor on the last.
#[derive(Debug)]
pub(crate) struct Dip {
    pub(crate) plane: usize,
    /// Sums on the planes beside it.
    pub(crate) before: u16,
    pub(crate) lowest: u16,
    pub(crate) after: u16,
    /// Lowest sum beyond those; the largest number where there is none.
    pub(crate) second: u16,
}

impl Dip {
    /// Fractional plane: the minimum of the parabola through the three sums.
    pub(crate) fn fractional_plane(&self) -> f32 {
        let (before, at, after) = (
            f32::from(self.before),
            f32::from(self.lowest),
            f32::from(self.after),
        );
        let curvature = before + after - 2.0 * at;
        let offset = if curvature > 0.0 {
            0.5 * (before - after) / curvature
        } else {
            0.0
        };
        self.plane as f32 + offset.clamp(-0.5, 0.5)
    }

    /// How far it stands out, 0 to 1.
    pub(crate) fn margin(&self) -> f32 {
        if self.second == u16::MAX {
            return 0.0;
        }
        let second = f32::from(self.second);
        (second - f32::from(self.lowest)) / second.max(1.0)
    }
}

/// ZNCC that a cost stands for.
pub(crate) fn score_of(cost: u8) -> f32 {
    1.0 - f32::from(cost) / 255.0
}

pub(crate) fn jump_penalty(luma: f32, previous: f32) -> u16 {
    let penalty = LARGE_STEP / (1.0 + (luma - previous).abs() / EDGE_LUMA);
    (penalty as u16).max(LARGE_STEP_MIN)
}

/// Costs of one path at one pixel, with a border on both sides that never wins.
#[derive(Clone)]
struct Path {
    costs: Vec<u16>,
    lowest: u16,
}

const BORDER: u16 = u16::MAX / 2;

impl Path {
    fn new(n_planes: usize) -> Self {
        let mut costs = vec![0; n_planes + 2];
        costs[0] = BORDER;
        costs[n_planes + 1] = BORDER;
        Self { costs, lowest: 0 }
    }
}

/// Both directions along one row; writes `sums`.
fn along_row(luma: &[f32], costs: &[u8], n_planes: usize, sums: &mut [u16]) {
    let width = luma.len();
    let (mut path, mut next) = (Path::new(n_planes), Path::new(n_planes));
    for x in 0..width {
        let penalty = jump_penalty(luma[x], luma[x.saturating_sub(1)]);
        let at = x * n_planes..(x + 1) * n_planes;
        follow(&path, &mut next, &costs[at.clone()], penalty, &mut sums[at]);
        std::mem::swap(&mut path, &mut next);
    }
    path = Path::new(n_planes);
    for x in (0..width).rev() {
        let penalty = jump_penalty(luma[x], luma[(x + 1).min(width - 1)]);
        let at = x * n_planes..(x + 1) * n_planes;
        follow(&path, &mut next, &costs[at.clone()], penalty, &mut sums[at]);
        std::mem::swap(&mut path, &mut next);
    }
}

/// The straight and the two slanted paths from row to row, in the order of `row_of`; adds to `sums`.
fn across_rows(
    grey: &Grey,
    costs: &[u8],
    n_planes: usize,
    sums: &mut [u16],
    row_of: impl Fn(usize) -> usize,
) {
    let (width, height) = (grey.width, grey.height);
    // Path k of pixel x came from column x + k - 1 of the row before; one column of border on both sides.
    let fresh = || {
        vec![
            [
                Path::new(n_planes),
                Path::new(n_planes),
                Path::new(n_planes)
            ];
            width + 2
        ]
    };
    let (mut paths, mut next) = (fresh(), fresh());
    for step in 0..height {
        let y = row_of(step);
        let luma = grey.row(y);
        let luma_before = grey.row(row_of(step.saturating_sub(1)));
        for x in 0..width {
            let at = (y * width + x) * n_planes..(y * width + x + 1) * n_planes;
            for k in 0..3 {
                let from = (x + k).saturating_sub(1).min(width - 1);
                let penalty = jump_penalty(luma[x], luma_before[from]);
                follow(
                    &paths[x + k][k],
                    &mut next[x + 1][k],
                    &costs[at.clone()],
                    penalty,
                    &mut sums[at.clone()],
                );
            }
        }
        std::mem::swap(&mut paths, &mut next);
    }
}

/// One step of a path: eq. 13 of the paper.
#[multiversion(targets("x86_64+avx2"))]
fn follow(path: &Path, next: &mut Path, costs: &[u8], jump: u16, sums: &mut [u16]) {
    let n = costs.len();
    let sums = &mut sums[..n];
    let (before, same, after) = (
        &path.costs[..n],
        &path.costs[1..n + 1],
        &path.costs[2..n + 2],
    );
    let into = &mut next.costs[1..n + 1];
    let floor = path.lowest;
    let ceiling = floor + jump;
    let mut lowest = u16::MAX;
    for d in 0..n {
        let neighbour = before[d].min(after[d]) + SMALL_STEP;
        let cost = u16::from(costs[d]) + same[d].min(neighbour).min(ceiling) - floor;
        into[d] = cost;
        sums[d] += cost;
        lowest = lowest.min(cost);
    }
    next.lowest = lowest;
}

#[multiversion(targets("x86_64+avx2"))]
fn lowest_of(sums: &[u16]) -> u16 {
    sums.iter().fold(u16::MAX, |lowest, &sum| lowest.min(sum))
}
