//! Real spherical harmonics to degree 3: direction -> basis, and its derivative.
//!
//! Sign and order as 3D Gaussian Splatting files store them (Kerbl et al. 2023).

use glam::DVec3;

pub(crate) const MAX_COEFFICIENTS: usize = 16;

const C0: f64 = 0.282_094_791_773_878_14;
const C1: f64 = 0.488_602_511_902_919_9;
const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

pub(crate) fn n_coefficients(degree: u8) -> usize {
    (usize::from(degree) + 1).pow(2)
}

/// Basis in a unit direction; entries above `degree` are 0.
pub(crate) fn basis(dir: DVec3, degree: u8) -> [f64; MAX_COEFFICIENTS] {
    let (x, y, z) = (dir.x, dir.y, dir.z);
    let mut b = [0.0; MAX_COEFFICIENTS];
    b[0] = C0;
    if degree >= 1 {
        b[1] = -C1 * y;
        b[2] = C1 * z;
        b[3] = -C1 * x;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        b[4] = C2[0] * x * y;
        b[5] = C2[1] * y * z;
        b[6] = C2[2] * (2.0 * zz - xx - yy);
        b[7] = C2[3] * x * z;
        b[8] = C2[4] * (xx - yy);
    }
    if degree >= 3 {
        b[9] = C3[0] * y * (3.0 * xx - yy);
        b[10] = C3[1] * x * y * z;
        b[11] = C3[2] * y * (4.0 * zz - xx - yy);
        b[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        b[13] = C3[4] * x * (4.0 * zz - xx - yy);
        b[14] = C3[5] * z * (xx - yy);
        b[15] = C3[6] * x * (xx - 3.0 * yy);
    }
    b
}

/// `sum_b weights[b] * d basis[b] / d dir`, the polynomials taken off the sphere as `basis` writes them.
pub(crate) fn basis_gradient(dir: DVec3, degree: u8, weights: &[f64; MAX_COEFFICIENTS]) -> DVec3 {
    let (x, y, z) = (dir.x, dir.y, dir.z);
    let w = weights;
    let mut g = DVec3::ZERO;
    if degree >= 1 {
        g += C1 * DVec3::new(-w[3], -w[1], w[2]);
    }
    if degree >= 2 {
        g += C2[0] * w[4] * DVec3::new(y, x, 0.0);
        g += C2[1] * w[5] * DVec3::new(0.0, z, y);
        g += C2[2] * w[6] * DVec3::new(-2.0 * x, -2.0 * y, 4.0 * z);
        g += C2[3] * w[7] * DVec3::new(z, 0.0, x);
        g += C2[4] * w[8] * DVec3::new(2.0 * x, -2.0 * y, 0.0);
    }
    if degree >= 3 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        g += C3[0] * w[9] * DVec3::new(6.0 * x * y, 3.0 * (xx - yy), 0.0);
        g += C3[1] * w[10] * DVec3::new(y * z, x * z, x * y);
        g += C3[2] * w[11] * DVec3::new(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z);
        g += C3[3] * w[12] * DVec3::new(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy);
        g += C3[4] * w[13] * DVec3::new(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z);
        g += C3[5] * w[14] * DVec3::new(2.0 * x * z, -2.0 * y * z, xx - yy);
        g += C3[6] * w[15] * DVec3::new(3.0 * (xx - yy), -6.0 * x * y, 0.0);
    }
    g
}

#[cfg(test)]
mod tests {
    use super::{MAX_COEFFICIENTS, basis, basis_gradient};
    use glam::DVec3;

    /// Central differences of cubic polynomials in f64 lose nothing above this.
    const TOLERANCE: f64 = 1e-8;

    #[test]
    fn the_gradient_of_every_band_agrees_with_differences() {
        let dir = DVec3::new(0.3, -0.5, 0.7);
        for band in 0..MAX_COEFFICIENTS {
            let mut weights = [0.0; MAX_COEFFICIENTS];
            weights[band] = 1.0;
            let found = basis_gradient(dir, 3, &weights);
            for axis in 0..3 {
                let mut step = DVec3::ZERO;
                step[axis] = 1e-5;
                let expected = (basis(dir + step, 3)[band] - basis(dir - step, 3)[band]) / 2e-5;
                assert!(
                    (found[axis] - expected).abs() < TOLERANCE,
                    "band {band} axis {axis}"
                );
            }
        }
    }
}
