//! Least squares in order of time: what is known of a state and of constants, as the triangle of a QR decomposition.
//!
//! The square-root information filter (Bierman 1977, "Factorization Methods for Discrete Sequential Estimation", chapters V and VII):
//! nothing need be known at the start, and no precision is lost on the way.

use nalgebra::{DMatrix, DVector};

/// Rows of `unknowns -> value`, each with a standard deviation of 1.
#[derive(Debug, Clone)]
pub(crate) struct Information {
    n: usize,
    /// The triangle, and its right side in the last column.
    rows: DMatrix<f64>,
    /// Sum of the squares that no values explain, and how many there are more than unknowns.
    pub(crate) squares: f64,
    pub(crate) n_rows: usize,
}

impl Information {
    /// Nothing is known of `n` unknowns.
    pub(crate) fn nothing(n: usize) -> Self {
        Self {
            n,
            rows: DMatrix::zeros(n, n + 1),
            squares: 0.0,
            n_rows: 0,
        }
    }

    /// Takes in rows of `n` coefficients and the value.
    pub(crate) fn add(&mut self, rows: &DMatrix<f64>) {
        let (n, more) = (self.n, rows.nrows());
        let mut stacked = DMatrix::zeros(n + more, n + 1);
        stacked.rows_mut(0, n).copy_from(&self.rows);
        stacked.rows_mut(n, more).copy_from(rows);
        self.n_rows += more;
        self.reduce(stacked);
    }

    /// The first `m` unknowns become others: `rows` hold the old ones, then the new ones, then the rest, then the value. Something must be
    /// known of each old one, be it little, by the rows so far or by these.
    pub(crate) fn replace_first(&mut self, m: usize, rows: &DMatrix<f64>) {
        let (n, more) = (self.n, rows.nrows());
        let mut stacked = DMatrix::zeros(n + more, n + m + 1);
        stacked
            .view_mut((0, 0), (n, m))
            .copy_from(&self.rows.columns(0, m));
        let rest = n + 1 - m;
        let own = self.rows.columns(m, rest);
        stacked.view_mut((0, 2 * m), (n, rest)).copy_from(&own);
        stacked.rows_mut(n, more).copy_from(rows);
        let triangle = stacked.qr().unpack_r();
        // Nobody asks for the old ones any more: their rows go, with them the columns.
        let left = triangle.nrows() - m;
        self.n_rows += more - m;
        self.reduce(triangle.view((m, m), (left, n + 1)).into_owned());
    }

    fn reduce(&mut self, stacked: DMatrix<f64>) {
        let triangle = stacked.qr().unpack_r();
        let kept = triangle.nrows().min(self.n);
        self.rows = DMatrix::zeros(self.n, self.n + 1);
        self.rows
            .rows_mut(0, kept)
            .copy_from(&triangle.rows(0, kept));
        if triangle.nrows() > self.n {
            self.squares += triangle[(self.n, self.n)].powi(2);
        }
    }

    /// The values, and their covariance; `None` where some of them are not known at all.
    pub(crate) fn solve(&self) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let triangle = self.rows.columns(0, self.n).into_owned();
        let scale = triangle.amax();
        let is_known = triangle.diagonal().iter().all(|d| d.abs() > 1e-13 * scale);
        if !is_known || scale <= 0.0 {
            return None;
        }
        let values = triangle.solve_upper_triangular(&self.rows.column(self.n))?;
        let inverse = triangle.solve_upper_triangular(&DMatrix::identity(self.n, self.n))?;
        Some((values, &inverse * inverse.transpose()))
    }

    /// Squares per row that is more than needed: 1 where the rows' standard deviations are right.
    pub(crate) fn variance(&self) -> f64 {
        let spare = self.n_rows.saturating_sub(self.n).max(1);
        self.squares / spare as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A speed that is constant but for its noise, seen by its places: the same by all rows at once.
    #[test]
    fn one_after_the_other_is_the_same_as_all_at_once() {
        let places = [0.0, 1.1, 1.9, 3.2, 4.0];
        // Unknown: place, speed. Each second the place goes on by the speed, to a tenth.
        let mut found = Information::nothing(2);
        found.add(&DMatrix::from_row_slice(1, 3, &[2.0, 0.0, 2.0 * places[0]]));
        for place in &places[1..] {
            let step = [-10.0, 10.0, -10.0, 0.0];
            found.replace_first(1, &DMatrix::from_row_slice(1, 4, &step));
            found.add(&DMatrix::from_row_slice(1, 3, &[2.0, 0.0, 2.0 * place]));
        }
        let (values, covariance) = found.solve().unwrap();
        // All five places and the speed.
        let mut rows = DMatrix::zeros(9, 6);
        let mut right = DVector::zeros(9);
        for (ix, place) in places.iter().enumerate() {
            (rows[(ix, ix)], right[ix]) = (2.0, 2.0 * place);
            if ix > 0 {
                let row = 4 + ix;
                rows[(row, ix - 1)] = -10.0;
                rows[(row, ix)] = 10.0;
                rows[(row, 5)] = -10.0;
            }
        }
        let inverse = (rows.transpose() * &rows).try_inverse().unwrap();
        let all = &inverse * rows.transpose() * &right;
        for (own, ix) in [(0, 4), (1, 5)] {
            assert!((values[own] - all[ix]).abs() < 1e-12);
            assert!((covariance[(own, own)] - inverse[(ix, ix)]).abs() < 1e-12);
        }
        let squares = (&rows * &all - &right).norm_squared();
        assert!(
            (found.squares - squares).abs() < 1e-12,
            "{} {squares}",
            found.squares
        );
        assert_eq!(found.n_rows, 5 + 4 - 4);
    }

    #[test]
    fn what_is_not_known_is_not_solved_for() {
        let mut found = Information::nothing(2);
        found.add(&DMatrix::from_row_slice(1, 3, &[1.0, 1.0, 2.0]));
        assert!(found.solve().is_none());
        found.add(&DMatrix::from_row_slice(1, 3, &[0.0, 1.0, 1.0]));
        let (values, _) = found.solve().unwrap();
        assert!((values[0] - 1.0).abs() < 1e-12);
    }
}
