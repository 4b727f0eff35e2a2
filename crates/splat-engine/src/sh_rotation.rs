//! Turns the view-dependent colour of a splat with the splat, exactly, for bands up to 3.
//!
//! Band l of a turned function is a linear map of band l of the old one: the products of old and turned basis,
//! integrated over the sphere. Their polynomials have degree 6, and the quadrature below is exact to degree 7.

use glam::{DQuat, DVec3};

use crate::sh::{MAX_COEFFICIENTS, basis, n_coefficients};

/// Gauss-Legendre nodes and weights of four points, for the height of a direction (exact to degree 7).
const HEIGHTS: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_2),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_2),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
];
/// Evenly spaced round each height (exact to degree 7).
const N_AROUND: usize = 8;

/// What a rotation does to coefficients.
#[derive(Debug, Clone)]
pub struct ShRotation {
    degree: u8,
    /// `weights[a][b]`: share of the old coefficient b in the new coefficient a, of equal bands.
    weights: [[f64; MAX_COEFFICIENTS]; MAX_COEFFICIENTS],
}

impl ShRotation {
    /// For functions that turn along with a rotation, of splats of this degree.
    pub fn new(rotation: DQuat, degree: u8) -> Self {
        let mut weights = [[0.0; MAX_COEFFICIENTS]; MAX_COEFFICIENTS];
        let back = rotation.normalize().conjugate();
        for (height, share) in HEIGHTS {
            let radius = (1.0 - height * height).sqrt();
            for k in 0..N_AROUND {
                let angle = std::f64::consts::TAU * (k as f64 + 0.5) / N_AROUND as f64;
                let dir = DVec3::new(radius * angle.cos(), radius * angle.sin(), height);
                let area = share * std::f64::consts::TAU / N_AROUND as f64;
                // The turned function shows in a direction what the old one showed in that direction turned back.
                let (new, old) = (basis(dir, degree), basis(back * dir, degree));
                for band in 0..=degree {
                    let range = usize::from(band).pow(2)..n_coefficients(band);
                    for a in range.clone() {
                        for b in range.clone() {
                            weights[a][b] += area * new[a] * old[b];
                        }
                    }
                }
            }
        }
        Self { degree, weights }
    }

    /// `sh[coefficient][rgb]` of one splat.
    pub fn apply(&self, sh: &mut [f32]) {
        for band in 1..=self.degree {
            let range = usize::from(band).pow(2)..n_coefficients(band);
            let old: Vec<f32> = sh[3 * range.start..3 * range.end].to_vec();
            for a in range.clone() {
                for channel in 0..3 {
                    let parts = range.clone().map(|b| {
                        self.weights[a][b] * f64::from(old[3 * (b - range.start) + channel])
                    });
                    sh[3 * a + channel] = parts.sum::<f64>() as f32;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Coefficients are f32.
    const TOLERANCE: f64 = 2e-6;

    fn colour(sh: &[f32], dir: DVec3) -> f64 {
        let values = basis(dir, 3);
        values
            .iter()
            .enumerate()
            .map(|(b, y)| y * f64::from(sh[3 * b + 1]))
            .sum()
    }

    #[test]
    fn a_turned_splat_shows_its_colours_in_turned_directions() {
        let sh: Vec<f32> = (0..48_u8).map(|k| (f32::from(k) * 1.7).sin()).collect();
        for n in 0..20 {
            let t = f64::from(n);
            let rotation =
                DQuat::from_scaled_axis(DVec3::new(t.sin() * 3.0, (1.3 * t).cos(), 0.2 * t));
            let mut turned = sh.clone();
            ShRotation::new(rotation, 3).apply(&mut turned);
            let dir = DVec3::new((2.1 * t).cos(), (0.7 * t).sin(), 0.4).normalize();
            let (old, new) = (colour(&sh, dir), colour(&turned, rotation * dir));
            assert!((old - new).abs() < TOLERANCE, "{n}: {old} {new}");
        }
    }

    #[test]
    fn no_rotation_changes_nothing_and_a_plain_colour_stays() {
        let sh: Vec<f32> = (0..48_u8).map(f32::from).collect();
        let mut same = sh.clone();
        ShRotation::new(DQuat::IDENTITY, 3).apply(&mut same);
        assert!(sh.iter().zip(&same).all(|(a, b)| (a - b).abs() < 1e-4));
        let mut plain = [0.1, 0.2, 0.3];
        ShRotation::new(DQuat::from_rotation_x(1.0), 0).apply(&mut plain);
        assert_eq!(plain, [0.1, 0.2, 0.3]);
    }
}
