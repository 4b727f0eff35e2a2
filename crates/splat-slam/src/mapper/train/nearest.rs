//! Points -> how far apart they lie: each one's distance to its three nearest neighbours, by a k-d tree.

use glam::DVec3;
use rayon::prelude::*;

/// Neighbours whose distance counts (3DGS, section 5.1).
const N_NEIGHBOURS: usize = 3;
/// Fewer points than this are compared one by one.
const LEAF: usize = 8;

/// Points in an order in which the middle of each part divides the rest along one axis.
struct Tree {
    /// Place, and index of the point.
    points: Vec<(DVec3, usize)>,
    /// Axis of the part whose middle is at this place.
    axes: Vec<u8>,
}

/// Squared distances of the nearest so far, ascending.
type Nearest = [f64; N_NEIGHBOURS];

/// Root of the mean squared distance to the three nearest other points, or to all where they are fewer; 0 for a point alone.
pub(crate) fn spacings(points: &[DVec3]) -> Vec<f64> {
    let tree = Tree::new(points);
    let spacing = |(ix, at): (usize, &DVec3)| {
        let mut nearest = [f64::INFINITY; N_NEIGHBOURS];
        tree.search(0..points.len(), *at, ix, &mut nearest);
        let found = nearest.iter().filter(|square| square.is_finite());
        let n = found.clone().count().max(1);
        (found.sum::<f64>() / n as f64).sqrt()
    };
    points.par_iter().enumerate().map(spacing).collect()
}

impl Tree {
    fn new(points: &[DVec3]) -> Self {
        let mut tree = Self {
            points: points.iter().copied().zip(0..).collect(),
            axes: vec![0; points.len()],
        };
        divide(&mut tree.points, &mut tree.axes);
        tree
    }

    fn search(&self, part: std::ops::Range<usize>, at: DVec3, own: usize, nearest: &mut Nearest) {
        if part.len() <= LEAF {
            for (other, ix) in &self.points[part] {
                if *ix != own {
                    note(nearest, at.distance_squared(*other));
                }
            }
            return;
        }
        let middle = part.start + part.len() / 2;
        let (divider, ix) = self.points[middle];
        if ix != own {
            note(nearest, at.distance_squared(divider));
        }
        let axis = usize::from(self.axes[middle]);
        let beyond = at[axis] - divider[axis];
        let (below, above) = (part.start..middle, middle + 1..part.end);
        let (first, second) = if beyond < 0.0 {
            (below, above)
        } else {
            (above, below)
        };
        self.search(first, at, own, nearest);
        if beyond * beyond < nearest[N_NEIGHBOURS - 1] {
            self.search(second, at, own, nearest);
        }
    }
}

/// Along the axis in which the part is longest. As deep as the logarithm of the number of points.
fn divide(points: &mut [(DVec3, usize)], axes: &mut [u8]) {
    if points.len() <= LEAF {
        return;
    }
    let start = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (low, high) = points
        .iter()
        .fold(start, |(low, high), (p, _)| (low.min(*p), high.max(*p)));
    let axis = (high - low).max_position();
    let middle = points.len() / 2;
    let by_axis = |a: &(DVec3, usize), b: &(DVec3, usize)| {
        a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1))
    };
    points.select_nth_unstable_by(middle, by_axis);
    axes[middle] = axis as u8;
    let (below, above) = points.split_at_mut(middle);
    let (axes_below, axes_above) = axes.split_at_mut(middle);
    divide(below, axes_below);
    divide(&mut above[1..], &mut axes_above[1..]);
}

fn note(nearest: &mut Nearest, square: f64) {
    let mut square = square;
    for known in nearest.iter_mut() {
        if square < *known {
            std::mem::swap(known, &mut square);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    fn one_by_one(points: &[DVec3]) -> Vec<f64> {
        let spacing = |(ix, at): (usize, &DVec3)| {
            let others = points.iter().enumerate().filter(|(other, _)| *other != ix);
            let mut squares: Vec<f64> = others.map(|(_, p)| p.distance_squared(*at)).collect();
            squares.sort_by(f64::total_cmp);
            let n = squares.len().min(N_NEIGHBOURS);
            (squares[..n].iter().sum::<f64>() / n.max(1) as f64).sqrt()
        };
        points.iter().enumerate().map(spacing).collect()
    }

    #[test]
    fn the_tree_finds_the_neighbours_that_comparing_all_finds() {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        for n in [0, 1, 2, 3, 4, 9, 17, 100, 1000] {
            let mut points: Vec<DVec3> = (0..n)
                .map(|_| DVec3::from_array(std::array::from_fn(|_| rng.random::<f64>())))
                .collect();
            // Some in one place, some along a line, one far away.
            for ix in 0..n / 5 {
                points[ix] = DVec3::splat(0.5);
                points[n - 1 - ix].x = 0.25;
            }
            if n > 20 {
                points[n / 2] = DVec3::splat(1e6);
            }
            assert_eq!(spacings(&points), one_by_one(&points), "{n} points");
        }
    }

    #[test]
    fn corners_of_a_square_are_as_far_apart_as_pythagoras_says() {
        let corners = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0]];
        let points = corners.map(|[x, y]| DVec3::new(x, y, 7.0));
        // Squares 9, 9 and 18.
        assert_eq!(spacings(&points), [12.0_f64.sqrt(); 4]);
    }
}
