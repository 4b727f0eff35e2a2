//! The envelope against a dense matrix.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::optim::bundle::reduced::*;

/// Cameras of a loop, each of which meets the two before it; some are held.
fn system() -> (Layout, System, DMatrix<f64>, DVector<f64>) {
    let n = 23_u32;
    let points: Vec<[u32; 3]> = (0..n).map(|i| [i, (i + 1) % n, (i + 2) % n]).collect();
    let is_held: Vec<bool> = (0..n).map(|i| i % 9 == 4).collect();
    let layout = Layout::new(&is_held, points.iter().map(|p| &p[..]));
    let mut system = System::zero(&layout);
    let size = 6 * layout.n_slots() + LENS;
    let mut dense = DMatrix::<f64>::identity(size, size) * 0.01;
    let mut rng = Pcg32::seed_from_u64(3);
    for _ in 0..40 {
        for cameras in &points {
            let slots: Vec<usize> = cameras
                .iter()
                .map(|&c| layout.slot_of[c as usize])
                .filter(|s| *s != HELD)
                .map(|s| s as usize)
                .collect();
            let mut row = DVector::<f64>::zeros(size);
            for &slot in &slots {
                (0..6).for_each(|k| row[6 * slot + k] = rng.random_range(-1.0..1.0));
            }
            (0..LENS).for_each(|k| row[size - 1 - k] = rng.random_range(-1.0..1.0));
            dense += &row * row.transpose();
        }
    }
    let right = DVector::<f64>::from_fn(size, |_, _| rng.random_range(-1.0..1.0));
    for i in 0..layout.n_slots() {
        for j in layout.first[i]..=i {
            *system.block(i, j) = std::array::from_fn(|k| dense[(6 * i + k / 6, 6 * j + k % 6)]);
        }
        system.gradient[i] = std::array::from_fn(|k| right[6 * i + k]);
        system.border[i] =
            std::array::from_fn(|k| dense[(6 * i + k / LENS, size - LENS + k % LENS)]);
    }
    for i in 0..LENS {
        system.corner[i] = std::array::from_fn(|j| dense[(size - LENS + i, size - LENS + j)]);
        system.lens_gradient[i] = right[size - LENS + i];
    }
    (layout, system, dense, right)
}

#[test]
fn the_envelope_holds_the_system_and_its_solution_is_the_dense_one() {
    let (layout, system, dense, right) = system();
    let n_blocks: usize = system.rows.iter().map(Vec::len).sum();
    let n = layout.n_slots();
    assert!(n_blocks < n * (n + 1) / 3, "{n_blocks} blocks for {n} rows");
    let inverse = dense.clone().try_inverse().unwrap();
    let wanted = -(&inverse * right);
    let found = system.solve([true, true]).unwrap();
    let flat = found.poses.iter().flatten().chain(&found.lens);
    for (found, wanted) in flat.zip(&wanted) {
        assert!((found - wanted).abs() < 1e-9, "{found} {wanted}");
    }
    let last = wanted.len() - 1;
    assert!((found.lens_variance[1] / inverse[(last, last)] - 1.0).abs() < 1e-9);
}

#[test]
fn a_lens_parameter_that_is_held_does_not_move() {
    let (_, system, mut dense, mut right) = system();
    let last = right.len() - 1;
    right[last] = 0.0;
    for i in 0..last {
        (dense[(last, i)], dense[(i, last)]) = (0.0, 0.0);
    }
    let wanted = -(dense.try_inverse().unwrap() * right);
    let found = system.solve([true, false]).unwrap();
    assert_eq!(found.lens[1], 0.0);
    assert!((found.lens[0] - wanted[last - 1]).abs() < 1e-9);
    assert!((found.poses[3][2] - wanted[20]).abs() < 1e-9);
}

#[test]
fn what_is_not_positive_definite_has_no_solution() {
    let (_, mut system, ..) = system();
    system.block(5, 5)[0] = -1.0;
    assert!(system.solve([false, false]).is_none());
}
