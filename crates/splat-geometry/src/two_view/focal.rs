//! Fundamental matrices of many pairs of one camera -> its focal length.
//!
//! With the right focal length every `K^T F K` has two equal singular values (Mendonca and Cipolla 1999); the focal
//! length sought is the one for which most pairs come near that. Square pixels, principal point at the centre.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::Matrix3;

/// One pair's evidence.
#[derive(Debug, Clone, Copy)]
pub struct PairView {
    /// In pixels counted from the principal point: `second^T F first = 0`.
    pub fundamental: DMat3,
    /// How much the pair may say: many matches, and not all on one plane.
    pub weight: f64,
}

/// Focal lengths looked at, as shares of the longer side: 130 to 20 degrees of view.
const SHARES: (f64, f64) = (0.25, 2.8);
const N_GRID: usize = 80;
/// Relative gap of the singular values at which a pair counts half.
const GAP: f64 = 0.03;

/// Focal length in units of `longest_px` pixels; `None` without pairs, or where no value is better than the ends.
pub fn focal_share(pairs: &[PairView], longest_px: f64) -> Option<f64> {
    let step = (SHARES.1 / SHARES.0).ln() / (N_GRID - 1) as f64;
    let share = |i: usize| SHARES.0 * (step * i as f64).exp();
    let costs: Vec<f64> = (0..N_GRID)
        .map(|i| cost(pairs, share(i) * longest_px))
        .collect();
    let best = (1..N_GRID - 1).min_by(|&a, &b| costs[a].total_cmp(&costs[b]))?;
    if pairs.is_empty() || costs[best] > costs[0].min(costs[N_GRID - 1]) {
        return None;
    }
    let (left, here, right) = (costs[best - 1], costs[best], costs[best + 1]);
    let bend = left - 2.0 * here + right;
    let offset = if bend > 1e-12 {
        (0.5 * (left - right) / bend).clamp(-1.0, 1.0)
    } else {
        0.0
    };
    Some(share(best) * (step * offset).exp())
}

/// `F` about the principal point from `F` in pixels.
pub fn centred(fundamental: &DMat3, first_centre: DVec2, second_centre: DVec2) -> DMat3 {
    let shift = |c: DVec2| DMat3::from_cols(DVec3::X, DVec3::Y, DVec3::new(c.x, c.y, 1.0));
    shift(second_centre).transpose() * *fundamental * shift(first_centre)
}

fn cost(pairs: &[PairView], focal: f64) -> f64 {
    let k = DMat3::from_diagonal(DVec3::new(focal, focal, 1.0));
    let one = |pair: &PairView| {
        let essential = k * pair.fundamental * k;
        let values = Matrix3::from_column_slice(&essential.to_cols_array()).singular_values();
        let gap = (values[0] - values[1]) / (values[0] + values[1]).max(1e-300);
        let square = (gap / GAP).powi(2);
        pair.weight * square / (1.0 + square)
    };
    pairs.iter().map(one).sum()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::*;
    use splat_types::transform::Rigid;
    use splat_types::transform::skew;

    /// Pairs of a camera of the given focal length; the share `wrong` of them says nothing about it.
    fn pairs(focal: f64, wrong: f64) -> Vec<PairView> {
        let mut rng = rand_pcg::Pcg32::seed_from_u64(3);
        let mut vector =
            |size: f64| DVec3::from_array([(); 3].map(|()| rng.random_range(-size..size)));
        (0..40)
            .map(|i| {
                let pose = Rigid::exp(vector(1.0), vector(0.4));
                let f = if f64::from(i) < 40.0 * wrong {
                    focal * (0.4 + 0.05 * f64::from(i))
                } else {
                    focal
                };
                let k = DMat3::from_diagonal(DVec3::new(1.0 / f, 1.0 / f, 1.0));
                PairView {
                    fundamental: k * skew(pose.translation) * pose.rotation_matrix() * k,
                    weight: 1.0,
                }
            })
            .collect()
    }

    #[test]
    fn the_focal_length_is_found_among_misleading_pairs() {
        for share in [0.5, 0.72, 1.3] {
            let found = focal_share(&pairs(share * 640.0, 0.3), 640.0).unwrap();
            assert!(
                (found / share - 1.0).abs() < 0.01,
                "{found} instead of {share}"
            );
        }
    }

    #[test]
    fn without_evidence_there_is_no_answer() {
        assert_eq!(focal_share(&[], 640.0), None);
        assert_eq!(focal_share(&pairs(20.0 * 640.0, 0.0), 640.0), None);
    }

    #[test]
    fn centring_moves_the_origin_to_the_principal_points() {
        let f = DMat3::from_cols_array(&[0.1, 0.3, -2.0, 0.5, -0.2, 1.0, 3.0, -1.0, 7.0]);
        let (a, b) = (DVec2::new(320.0, 240.0), DVec2::new(300.0, 250.0));
        let (p, q) = (DVec2::new(12.0, -30.0), DVec2::new(5.0, 44.0));
        let value = |m: DMat3, p: DVec2, q: DVec2| q.extend(1.0).dot(m * p.extend(1.0));
        assert!((value(f, p + a, q + b) - value(centred(&f, a, b), p, q)).abs() < 1e-6);
    }
}
