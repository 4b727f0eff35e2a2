//! Repeatable randomness over the plane: lattice hashes, smooth noise, cells, edges that fade before they alias.
//!
//! `footprint` is the size of a sample on the surface in the unit of the coordinates.

use glam::{IVec2, Vec2};

/// Mixes all bits of all input bits (two rounds of xor-shift and multiply).
pub(crate) fn hash(value: u32) -> u32 {
    let mut x = value ^ 0x9E37_79B9;
    x = (x ^ (x >> 16)).wrapping_mul(0x21F0_AAAD);
    x = (x ^ (x >> 15)).wrapping_mul(0x735A_2D97);
    x ^ (x >> 15)
}

pub(crate) fn hash2(cell: IVec2, seed: u32) -> u32 {
    let (x, y) = (cell.x as u32, cell.y as u32);
    hash(x.wrapping_mul(0x85EB_CA6B) ^ y.wrapping_mul(0xC2B2_AE35).rotate_left(13) ^ seed)
}

/// [0, 1) from a hash.
pub(crate) fn unit(hash: u32) -> f32 {
    (hash >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// The `n`-th independent number in [0, 1) of one hash.
pub(crate) fn pick(seed: u32, n: u32) -> f32 {
    unit(hash(seed.wrapping_add(n.wrapping_mul(0x9E37_79B9))))
}

/// 1 where a detail of this wavelength can be shown, 0 where it would alias.
pub(crate) fn visible(wavelength: f32, footprint: f32) -> f32 {
    (wavelength / footprint - 1.0).clamp(0.0, 1.0)
}

/// 0 below the edge, 1 above, a ramp as wide as a sample between.
pub(crate) fn edge(at: f32, x: f32, footprint: f32) -> f32 {
    ((x - at) / footprint + 0.5).clamp(0.0, 1.0)
}

/// 1 within `half_width` of 0, thinner than a sample it pales instead of flickering.
pub(crate) fn stroke(x: f32, half_width: f32, footprint: f32) -> f32 {
    (edge(-half_width, x, footprint) - edge(half_width, x, footprint)).max(0.0)
}

/// Smooth noise in [-1, 1] with lattice size 1.
pub(crate) fn value_noise(p: Vec2, seed: u32) -> f32 {
    let base = p.floor();
    let f = p - base;
    let s = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
    let cell = base.as_ivec2();
    let at = |dx: i32, dy: i32| unit(hash2(cell + IVec2::new(dx, dy), seed));
    let low = at(0, 0) + (at(1, 0) - at(0, 0)) * s.x;
    let high = at(0, 1) + (at(1, 1) - at(0, 1)) * s.x;
    2.0 * (low + (high - low) * s.y) - 1.0
}

/// Noise summed over octaves from wavelength 1 down; octaves finer than a sample are left out.
pub(crate) fn fractal(p: Vec2, seed: u32, n_octaves: u32, footprint: f32) -> f32 {
    let (mut sum, mut scale, mut weight) = (0.0, 1.0, 0.5);
    for octave in 0..n_octaves {
        let share = visible(1.0, footprint * scale);
        if share <= 0.0 {
            break;
        }
        // Each octave is turned, or the lattices would line up.
        let turned = Vec2::from_angle(0.6 * octave as f32).rotate(p) * scale;
        sum += weight * share * value_noise(turned, seed.wrapping_add(octave * 7919));
        scale *= 2.03;
        weight *= 0.6;
    }
    sum
}

/// The nearest of random points, one per unit cell.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Nearest {
    pub(crate) id: u32,
    pub(crate) distance: f32,
    /// Distance to the border with the next cell, about.
    pub(crate) border: f32,
    /// From the point to the place asked for.
    pub(crate) offset: Vec2,
}

pub(crate) fn nearest_point(p: Vec2, seed: u32) -> Nearest {
    let base = p.floor().as_ivec2();
    let mut best = Nearest {
        id: 0,
        distance: f32::MAX,
        border: 0.0,
        offset: Vec2::ZERO,
    };
    let mut second = f32::MAX;
    for dy in -1..=1 {
        for dx in -1..=1 {
            let cell = base + IVec2::new(dx, dy);
            let id = hash2(cell, seed);
            let point =
                cell.as_vec2() + Vec2::new(0.1 + 0.8 * pick(id, 1), 0.1 + 0.8 * pick(id, 2));
            let distance = p.distance(point);
            if distance < best.distance {
                second = best.distance;
                best = Nearest {
                    id,
                    distance,
                    border: 0.0,
                    offset: p - point,
                };
            } else {
                second = second.min(distance);
            }
        }
    }
    best.border = 0.5 * (second - best.distance);
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_smooth_and_fills_its_range() {
        let mut seen = (f32::MAX, f32::MIN);
        for i in 0..5000 {
            let p = Vec2::new(i as f32 * 0.37, i as f32 * 0.11);
            let value = value_noise(p, 5);
            assert!((value - value_noise(p + 1e-3, 5)).abs() < 0.02);
            seen = (seen.0.min(value), seen.1.max(value));
        }
        assert!(
            seen.0 < -0.8 && seen.0 >= -1.0 && seen.1 > 0.8 && seen.1 <= 1.0,
            "{seen:?}"
        );
    }

    #[test]
    fn what_a_sample_cannot_show_is_left_out() {
        assert_eq!(fractal(Vec2::new(0.3, 0.4), 1, 5, 2.0), 0.0);
        assert_eq!(stroke(0.0, 0.1, 0.01), 1.0);
        assert!((stroke(0.0, 0.1, 1.0) - 0.2).abs() < 1e-6);
    }
}
