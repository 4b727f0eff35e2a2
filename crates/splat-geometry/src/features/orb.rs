//! An image -> corners with 256 bits each that survive turn, light and moderate scale (ORB, Rublee 2011).
//!
//! Corners are maxima of the Harris response, which is computed everywhere: that costs little with wide registers, places
//! corners to parts of a pixel by a quadratic fit, and makes the FAST test in front of it pointless.

use std::sync::LazyLock;

use glam::DVec2;
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;

use crate::features::descriptor::{Descriptors, Features, resized};
use crate::features::scale_space::Grey;

/// Sizes of the image that corners are looked for in, and the ratio between neighbours (Rublee 2011).
const LEVELS: usize = 8;
const LEVEL_RATIO: f64 = 1.2;
/// Half the side of the patch that a corner is described by (Rublee 2011: 31 pixels).
const RADIUS: i32 = 15;
/// The patch turned, and a pixel for rounding.
const BORDER: usize = RADIUS as usize + 2;
/// Blur of the window of the Harris response, and of what the bits compare (Rublee 2011), in pixels of the level.
const WINDOW_SIGMA: f32 = 1.5;
const BITS_SIGMA: f32 = 2.0;
/// Weight of the squared trace (Harris 1988).
const HARRIS_K: f32 = 0.04;
/// Response of a corner with a contrast of about 0.01; noise makes more of those than scenes do.
const MIN_RESPONSE: f32 = 1e-9;
/// Side of the cells that corners are spread over.
const CELL_PX: usize = 32;

struct Corner {
    x: f32,
    y: f32,
    response: f32,
}

/// At most `max_features` corners, finer levels first, the strongest of each level first.
pub fn features(image: &Grey, max_features: usize) -> Features {
    let (w, h) = (image.width, image.height);
    if w.min(h) < 2 * BORDER + 4 || !image.is_whole() {
        return Features::default();
    }
    let shares: Vec<f64> = (0..LEVELS)
        .map(|level| LEVEL_RATIO.powi(-(level as i32)))
        .collect();
    let all: f64 = shares.iter().sum();
    let found: Vec<Vec<(DVec2, f32, [u64; 4])>> = shares
        .par_iter()
        .map(|share| {
            let side = |px: usize| (px as f64 * share).round() as usize;
            let wanted = (max_features as f64 * share / all) as usize;
            level(image, (side(w), side(h)), wanted)
        })
        .collect();
    let (mut pixels, mut sigmas, mut bits) = (Vec::new(), Vec::new(), Vec::new());
    for (pixel, sigma, descriptor) in found.into_iter().flatten() {
        pixels.push(pixel);
        sigmas.push(sigma);
        bits.push(descriptor);
    }
    Features {
        pixels,
        sigmas,
        descriptors: Descriptors::Orb(bits),
    }
}

/// Corners of one size of the image: (pixel of the image, size, bits).
fn level(image: &Grey, (w, h): (usize, usize), wanted: usize) -> Vec<(DVec2, f32, [u64; 4])> {
    if w.min(h) < 2 * BORDER + 4 {
        return Vec::new();
    }
    let is_first = (w, h) == (image.width, image.height);
    let small = (!is_first).then(|| resized(image, w as u32, h as u32));
    let Some(level) = small.as_ref().map_or(Some(image), Option::as_ref) else {
        return Vec::new();
    };
    let corners = spread(corners(&responses(level)), w, wanted);
    let smooth = level.blurred(BITS_SIGMA);
    let scale = DVec2::new(
        image.width as f64 / w as f64,
        image.height as f64 / h as f64,
    );
    let described = |corner: &Corner| {
        let at = DVec2::new(f64::from(corner.x) + 0.5, f64::from(corner.y) + 0.5);
        let direction = direction(&smooth, corner);
        (
            at * scale,
            BITS_SIGMA * scale.x as f32,
            bits(&smooth, corner, direction),
        )
    };
    corners.par_iter().map(described).collect()
}

/// The Harris response everywhere.
fn responses(level: &Grey) -> Grey {
    let (w, h) = (level.width, level.height);
    let of = |pixels| Grey {
        width: w,
        height: h,
        pixels,
    };
    let mut products = [(); 3].map(|()| of(vec![0.0; w * h]));
    for y in 1..h - 1 {
        let [xx, xy, yy] = products
            .each_mut()
            .map(|p| &mut p.pixels[y * w + 1..][..w - 2]);
        gradient_products(&level.pixels[(y - 1) * w..][..3 * w], [xx, xy, yy]);
    }
    let [xx, xy, yy] = products.map(|product| product.blurred(WINDOW_SIGMA));
    let mut out = xx;
    harris(&mut out.pixels, &xy.pixels, &yy.pixels);
    out
}

#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn gradient_products(rows: &[f32], [xx, xy, yy]: [&mut [f32]; 3]) {
    let n = xx.len();
    let w = n + 2;
    let (above, below) = (&rows[1..][..n], &rows[2 * w + 1..][..n]);
    let (left, right) = (&rows[w..][..n], &rows[w + 2..][..n]);
    let (xx, xy, yy) = (&mut xx[..n], &mut xy[..n], &mut yy[..n]);
    for x in 0..n {
        let (dx, dy) = (right[x] - left[x], below[x] - above[x]);
        xx[x] = dx * dx;
        xy[x] = dx * dy;
        yy[x] = dy * dy;
    }
}

#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn harris(xx: &mut [f32], xy: &[f32], yy: &[f32]) {
    for ((a, b), c) in xx.iter_mut().zip(xy).zip(yy) {
        let trace = *a + c;
        *a = *a * c - b * b - HARRIS_K * trace * trace;
    }
}

/// Maxima of the response, to parts of a pixel.
fn corners(response: &Grey) -> Vec<Corner> {
    let (w, h) = (response.width, response.height);
    let mut found = Vec::new();
    for y in BORDER..h - BORDER {
        let rows: [&[f32]; 3] = std::array::from_fn(|i| &response.pixels[(y + i - 1) * w..][..w]);
        for x in BORDER..w - BORDER {
            let c = rows[1][x];
            // Of equals the first one in the order of reading wins.
            let is_peak = c > MIN_RESPONSE
                && c > rows[1][x - 1]
                && c >= rows[1][x + 1]
                && rows[0][x - 1..=x + 1].iter().all(|&v| c > v)
                && rows[2][x - 1..=x + 1].iter().all(|&v| c >= v);
            if !is_peak {
                continue;
            }
            let (dx, dy) = summit(&rows, x);
            found.push(Corner {
                x: x as f32 + dx,
                y: y as f32 + dy,
                response: c,
            });
        }
    }
    found
}

/// Top of the quadratic through a maximum and its neighbours, at most half a pixel off on each axis.
fn summit(rows: &[&[f32]; 3], x: usize) -> (f32, f32) {
    let c = rows[1][x];
    let (gx, gy) = (
        0.5 * (rows[1][x + 1] - rows[1][x - 1]),
        0.5 * (rows[2][x] - rows[0][x]),
    );
    let (xx, yy) = (
        rows[1][x + 1] + rows[1][x - 1] - 2.0 * c,
        rows[2][x] + rows[0][x] - 2.0 * c,
    );
    let xy = 0.25 * (rows[2][x + 1] - rows[2][x - 1] - rows[0][x + 1] + rows[0][x - 1]);
    let det = xx * yy - xy * xy;
    if det <= 0.0 {
        return (0.0, 0.0);
    }
    let (dx, dy) = ((xy * gy - yy * gx) / det, (xy * gx - xx * gy) / det);
    (dx.clamp(-0.5, 0.5), dy.clamp(-0.5, 0.5))
}

/// The best of the corners, those of crowded cells at a discount.
fn spread(mut corners: Vec<Corner>, width: usize, wanted: usize) -> Vec<Corner> {
    corners.sort_by(|a, b| b.response.total_cmp(&a.response));
    let cells_across = width.div_ceil(CELL_PX);
    let mut taken = std::collections::BTreeMap::new();
    let mut ranked: Vec<(f32, Corner)> = Vec::with_capacity(corners.len());
    for corner in corners {
        let cell = corner.y as usize / CELL_PX * cells_across + corner.x as usize / CELL_PX;
        let before = taken.entry(cell).or_insert(0_u32);
        // The fourth root grows as contrast does.
        let worth = corner.response.sqrt().sqrt() / (1.0 + *before as f32).sqrt();
        *before += 1;
        ranked.push((worth, corner));
    }
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
    ranked.truncate(wanted);
    ranked.into_iter().map(|(_, corner)| corner).collect()
}

/// Half the width of the disc in each of its rows.
static DISC: LazyLock<[i32; 2 * RADIUS as usize + 1]> = LazyLock::new(|| {
    std::array::from_fn(|row| {
        let y = row as i32 - RADIUS;
        f64::from(RADIUS * RADIUS - y * y).sqrt() as i32
    })
});

/// Cosine and sine of the direction from a corner to the centre of brightness of the disc about it.
fn direction(smooth: &Grey, corner: &Corner) -> (f32, f32) {
    let (cx, cy) = (corner.x.round() as i32, corner.y.round() as i32);
    let (mut mx, mut my) = (0.0_f32, 0.0_f32);
    for (row, &half) in DISC.iter().enumerate() {
        let y = row as i32 - RADIUS;
        let at = (cy + y) as usize * smooth.width + (cx - half) as usize;
        let line = &smooth.pixels[at..=at + 2 * half as usize];
        let mut sum = 0.0;
        for (i, &v) in line.iter().enumerate() {
            mx += (i as i32 - half) as f32 * v;
            sum += v;
        }
        my += y as f32 * sum;
    }
    let length = (mx * mx + my * my).sqrt();
    if length > 0.0 {
        (mx / length, my / length)
    } else {
        (1.0, 0.0)
    }
}

type Pair = [[f32; 2]; 2];

/// Places to compare, drawn from a Gaussian of a fifth of the patch (Calonder 2010, G II) and a fixed seed.
static PAIRS: LazyLock<Vec<Pair>> = LazyLock::new(|| {
    let mut rng = rand_pcg::Pcg32::seed_from_u64(1);
    // Sums of uniforms: exact on every machine, which logarithms are not.
    let mut normal = move || {
        (0..12)
            .map(|_| rng.random_range(-0.5..0.5_f32))
            .sum::<f32>()
    };
    let sigma = (2 * RADIUS + 1) as f32 / 5.0;
    let mut place = move || loop {
        let at = [(); 2].map(|()| (sigma * normal()).round());
        if at[0] * at[0] + at[1] * at[1] <= (RADIUS * RADIUS) as f32 {
            return at;
        }
    };
    let mut pairs: Vec<Pair> = Vec::with_capacity(256);
    while pairs.len() < 256 {
        let pair = [place(), place()];
        let away = (pair[0][0] - pair[1][0]).abs() + (pair[0][1] - pair[1][1]).abs();
        // Closer than the blur, both places hold the same.
        if away > BITS_SIGMA * 1.5 && !pairs.contains(&pair) {
            pairs.push(pair);
        }
    }
    pairs
});

/// Which of two places is darker, 256 times, in the frame of the corner's direction.
fn bits(smooth: &Grey, corner: &Corner, (cosine, sine): (f32, f32)) -> [u64; 4] {
    let (x, y) = (corner.x + 0.5, corner.y + 0.5);
    let value = |[u, v]: [f32; 2]| {
        // Truncation of x + 0.5 rounds: the border keeps all places positive.
        let column = (x + cosine * u - sine * v) as u32;
        let row = (y + sine * u + cosine * v) as u32;
        smooth.pixels[row as usize * smooth.width + column as usize]
    };
    let mut out = [0; 4];
    for (word, pairs) in out.iter_mut().zip(PAIRS.chunks_exact(64)) {
        for (i, &[a, b]) in pairs.iter().enumerate() {
            *word |= u64::from(value(a) < value(b)) << i;
        }
    }
    out
}
