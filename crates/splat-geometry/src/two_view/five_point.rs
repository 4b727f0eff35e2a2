//! Five pairs of rays -> the essential matrices that agree with all of them.
//!
//! Every combination `x X + y Y + z Z + W` of four matrices fulfils the five epipolar constraints. That it is essential
//! gives ten cubic equations in x, y and z, whose solutions are read off the eigenvalues of the matrix that multiplies by
//! z (Nistér 2004; Stewénius, Engels and Nistér 2006).

use glam::{DMat3, DVec2};
use nalgebra::linalg::Schur;
use nalgebra::{SMatrix, SVector};

/// An eigenvalue with a smaller imaginary part, relative to its size, counts as real.
const MAX_IMAGINARY: f64 = 1e-8;
/// Of the constraints, the smallest pivot relative to the largest below which they are not five.
const MIN_PIVOT: f64 = 1e-8;
/// QR iterations of an eigenvalue problem of size 10; some 30 are common.
const MAX_ITERATIONS: usize = 500;

/// Exponents of x, y and z. First those of degree 3, then the basis that solutions are expressed in.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [2, 1, 0],
    [2, 0, 1],
    [1, 2, 0],
    [1, 1, 1],
    [1, 0, 2],
    [0, 3, 0],
    [0, 2, 1],
    [0, 1, 2],
    [0, 0, 3],
    [2, 0, 0],
    [1, 1, 0],
    [1, 0, 1],
    [0, 2, 0],
    [0, 1, 1],
    [0, 0, 2],
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
    [0, 0, 0],
];
/// Places of x, y, z and 1 in the basis, which begins at `BASIS`.
const BASIS: usize = 10;
const X: usize = 6;
const Y: usize = 7;
const Z: usize = 8;
const ONE: usize = 9;

/// `PRODUCT[i][j]`: the place of basis monomial i times the j-th of x, y, z, 1.
const PRODUCT: [[usize; 4]; 10] = products();

const fn products() -> [[usize; 4]; 10] {
    let mut table = [[0; 4]; 10];
    let mut i = 0;
    while i < 10 {
        let mut j = 0;
        while j < 4 {
            let (a, b) = (MONOMIALS[BASIS + i], MONOMIALS[BASIS + X + j]);
            let mut k = 0;
            while MONOMIALS[k][0] != a[0] + b[0]
                || MONOMIALS[k][1] != a[1] + b[1]
                || MONOMIALS[k][2] != a[2] + b[2]
            {
                k += 1;
            }
            table[i][j] = k;
            j += 1;
        }
        i += 1;
    }
    table
}

/// Coefficients of x, y, z, 1; of the basis; of all monomials.
type Linear = [f64; 4];
type Quadratic = SVector<f64, 10>;
type Cubic = SVector<f64, 20>;

/// Essential matrices E with `second^T E first = 0` for five rays (x, y, 1) of each camera; at most ten, none where the
/// five do not determine them. Of any scale.
pub(crate) fn essential_matrices(first: &[DVec2; 5], second: &[DVec2; 5]) -> Vec<DMat3> {
    let Some(basis) = null_space(first, second) else {
        return Vec::new();
    };
    let entries: [[Linear; 3]; 3] = std::array::from_fn(|row| {
        std::array::from_fn(|column| std::array::from_fn(|k| basis[k][3 * row + column]))
    });
    let Some(multiply_by_z) = action_matrix(&equations(&entries)) else {
        return Vec::new();
    };
    let Some(schur) = Schur::try_new(multiply_by_z, f64::EPSILON, MAX_ITERATIONS) else {
        return Vec::new();
    };
    let assemble = |[x, y, z]: [f64; 3]| {
        let rows: [f64; 9] = std::array::from_fn(|i| {
            x * basis[0][i] + y * basis[1][i] + z * basis[2][i] + basis[3][i]
        });
        DMat3::from_cols_array(&rows).transpose()
    };
    schur
        .complex_eigenvalues()
        .iter()
        .filter(|value| value.im.abs() < MAX_IMAGINARY * (1.0 + value.re.abs()))
        .filter_map(|value| solution(&multiply_by_z, value.re))
        .map(assemble)
        .filter(DMat3::is_finite)
        .collect()
}

/// Four orthonormal matrices, row by row, that fulfil the epipolar constraints of all five pairs.
fn null_space(first: &[DVec2; 5], second: &[DVec2; 5]) -> Option<[[f64; 9]; 4]> {
    let mut constraints = SMatrix::<f64, 9, 5>::zeros();
    for (i, (a, b)) in first.iter().zip(second).enumerate() {
        let row = [
            b.x * a.x,
            b.x * a.y,
            b.x,
            b.y * a.x,
            b.y * a.y,
            b.y,
            a.x,
            a.y,
            1.0,
        ];
        constraints.set_column(i, &SVector::from(row));
    }
    let qr = constraints.col_piv_qr();
    let pivots = qr.r().diagonal().abs();
    if pivots.min() <= MIN_PIVOT * pivots.max() || !pivots.iter().all(|p| p.is_finite()) {
        return None;
    }
    // Columns 6 to 9 of Q are orthogonal to all constraints.
    let mut transposed = SMatrix::<f64, 9, 9>::identity();
    qr.q_tr_mul(&mut transposed);
    Some(std::array::from_fn(|k| {
        std::array::from_fn(|i| transposed[(5 + k, i)])
    }))
}

/// `det E = 0` and `2 E E^T E - trace(E E^T) E = 0`, halved; one equation per row, over `MONOMIALS`.
fn equations(e: &[[Linear; 3]; 3]) -> SMatrix<f64, 10, 20> {
    let mut squares = [[Quadratic::zeros(); 3]; 3];
    for i in 0..3 {
        for j in i..3 {
            let square: Quadratic = (0..3).map(|k| product(&e[i][k], &e[j][k])).sum();
            (squares[i][j], squares[j][i]) = (square, square);
        }
    }
    let half_trace = (squares[0][0] + squares[1][1] + squares[2][2]) * 0.5;
    for (i, row) in squares.iter_mut().enumerate() {
        row[i] -= half_trace;
    }
    let minor = |a: usize, b: usize| product(&e[1][a], &e[2][b]) - product(&e[1][b], &e[2][a]);
    let determinant = raised(&minor(1, 2), &e[0][0]) - raised(&minor(0, 2), &e[0][1])
        + raised(&minor(0, 1), &e[0][2]);
    let mut rows = SMatrix::<f64, 10, 20>::zeros();
    rows.set_row(0, &determinant.transpose());
    for (ix, row) in squares
        .iter()
        .flat_map(|s| [0, 1, 2].map(|j| (s, j)))
        .enumerate()
    {
        let (squares, column) = row;
        let cubic: Cubic = (0..3).map(|k| raised(&squares[k], &e[k][column])).sum();
        rows.set_row(1 + ix, &cubic.transpose());
    }
    rows
}

fn product(a: &Linear, b: &Linear) -> Quadratic {
    let mut sum = Quadratic::zeros();
    for (i, a) in a.iter().enumerate() {
        for (j, b) in b.iter().enumerate() {
            sum[PRODUCT[X + i][j] - BASIS] += a * b;
        }
    }
    sum
}

fn raised(a: &Quadratic, b: &Linear) -> Cubic {
    let mut sum = Cubic::zeros();
    for (i, a) in a.iter().enumerate() {
        for (j, b) in b.iter().enumerate() {
            sum[PRODUCT[i][j]] += a * b;
        }
    }
    sum
}

/// Maps the values of the basis at a solution to z times these values.
fn action_matrix(equations: &SMatrix<f64, 10, 20>) -> Option<SMatrix<f64, 10, 10>> {
    let cubic = equations.fixed_columns::<10>(0).into_owned();
    let basis = equations.fixed_columns::<10>(BASIS).into_owned();
    // Each monomial of degree 3 as a combination of the basis, but for the sign.
    let reduced = cubic.lu().solve(&basis)?;
    let mut action = SMatrix::<f64, 10, 10>::zeros();
    for (row, products) in PRODUCT.iter().enumerate() {
        let raised = products[Z - X];
        if raised < BASIS {
            action.set_row(row, &-reduced.row(raised));
        } else {
            action[(row, raised - BASIS)] = 1.0;
        }
    }
    action.iter().all(|v| v.is_finite()).then_some(action)
}

/// x, y and z from the eigenvector of eigenvalue z, whose last value, that of the monomial 1, is one.
fn solution(multiply_by_z: &SMatrix<f64, 10, 10>, z: f64) -> Option<[f64; 3]> {
    let shifted = multiply_by_z - SMatrix::<f64, 10, 10>::identity() * z;
    let unknown = shifted.fixed_view::<9, 9>(0, 0).into_owned();
    let known = -shifted.fixed_view::<9, 1>(0, ONE);
    let values = unknown.lu().solve(&known)?;
    Some([values[X], values[Y], z])
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;
    use splat_types::transform::skew;

    /// Rays to random points in front of both cameras, and the matrix of their motion, of length 1.
    fn sample(rng: &mut Pcg32) -> ([DVec2; 5], [DVec2; 5], DMat3) {
        let mut random = || DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
        let rotation = DQuat::from_scaled_axis(0.3 * random());
        let translation = random().normalize();
        let points: [DVec3; 5] = std::array::from_fn(|_| random() * 2.0 + 5.0 * DVec3::Z);
        let rays = |p: DVec3| p.truncate() / p.z;
        let first = points.map(rays);
        let second = points.map(|p| rays(rotation * p + translation));
        let essential = skew(translation) * DMat3::from_quat(rotation);
        (first, second, scaled(&essential))
    }

    fn scaled(e: &DMat3) -> DMat3 {
        let squares: f64 = e.to_cols_array().iter().map(|v| v * v).sum();
        *e * squares.sqrt().recip()
    }

    /// Largest difference of two matrices of length 1, but for the sign.
    fn apart(a: &DMat3, b: &DMat3) -> f64 {
        let largest = |m: DMat3| {
            m.to_cols_array()
                .into_iter()
                .fold(0.0, |l: f64, v| l.max(v.abs()))
        };
        largest(*a - *b).min(largest(*a + *b))
    }

    #[test]
    fn the_true_matrix_is_among_the_solutions() {
        let mut rng = Pcg32::seed_from_u64(5);
        let mut errors: Vec<f64> = (0..2000)
            .map(|_| {
                let (first, second, truth) = sample(&mut rng);
                let found = essential_matrices(&first, &second);
                assert!(found.len() <= 10);
                let errors = found.iter().map(|e| apart(&scaled(e), &truth));
                errors.fold(f64::INFINITY, f64::min)
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        // Samples with two solutions close together lose half of the digits or, as a complex pair, their solution.
        assert!(errors[1000] < 1e-12, "median {}", errors[1000]);
        assert!(errors[1980] < 1e-7, "99 of 100: {}", errors[1980]);
    }

    #[test]
    fn every_solution_is_essential_and_fulfils_the_constraints() {
        let mut rng = Pcg32::seed_from_u64(6);
        let mut count = 0;
        let mut off: Vec<f64> = Vec::new();
        for _ in 0..500 {
            let (first, second, _) = sample(&mut rng);
            for e in essential_matrices(&first, &second) {
                let e = scaled(&e);
                count += 1;
                for (a, b) in first.iter().zip(&second) {
                    let value = b.extend(1.0).dot(e * a.extend(1.0));
                    assert!(value.abs() < 1e-12, "{value}");
                }
                let square = e * e.transpose();
                let trace = square.x_axis.x + square.y_axis.y + square.z_axis.z;
                let cubic = square * e * 2.0 - e * trace;
                let values = cubic.to_cols_array().into_iter().chain([e.determinant()]);
                off.push(values.fold(0.0, |l: f64, v| l.max(v.abs())));
            }
        }
        assert!(count > 1500, "{count} solutions");
        off.sort_by(f64::total_cmp);
        assert!(off[count * 99 / 100] < 1e-8, "{}", off[count * 99 / 100]);
    }

    #[test]
    fn pairs_that_are_not_five_give_nothing() {
        let mut rng = Pcg32::seed_from_u64(7);
        let (mut first, mut second, _) = sample(&mut rng);
        (first[4], second[4]) = (first[0], second[0]);
        assert_eq!(essential_matrices(&first, &second), []);
        assert_eq!(essential_matrices(&[DVec2::ZERO; 5], &[DVec2::ZERO; 5]), []);
        assert_eq!(essential_matrices(&[DVec2::NAN; 5], &second), []);
    }
}
