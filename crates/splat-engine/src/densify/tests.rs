//! Fates and parts against numbers worked out by hand.

use super::*;

/// Opacity, largest scale, mean gradient.
type Row = (f32, f32, f32);

const SETTINGS: DensifySettings = DensifySettings {
    gradient: 2e-4,
    dense_scale: 0.05,
    max_scale: 0.5,
    min_opacity: 0.005,
    max_splats: 1000,
    seed: 3,
};

fn splats_of(rows: &[Row]) -> (Splats, ScreenGradients) {
    let mut splats = Splats::default();
    let mut gradients = ScreenGradients::default();
    for (ix, (opacity, scale, gradient)) in rows.iter().enumerate() {
        splats.means.push([ix as f32, 0.0, 0.0]);
        splats
            .log_scales
            .push([scale.ln(), (0.5 * scale).ln(), (0.1 * scale).ln()]);
        // A quarter turn about z: the own x axis is the world's y.
        let half = 0.5_f32.sqrt();
        splats.quats.push([half, 0.0, 0.0, half]);
        splats.opacity_logits.push(logit(*opacity));
        splats.sh.extend([0.1; 3]);
        splats.anchors.push(ix as u32);
        // Seen four times.
        gradients.sums.push(4.0 * gradient);
        gradients.counts.push(4);
    }
    (splats, gradients)
}

fn check(rows: &[Row], settings: &DensifySettings, expected: &[Fate]) {
    let (splats, gradients) = splats_of(rows);
    assert_eq!(fates(&splats, &gradients, settings), expected);
}

#[test]
fn small_ones_are_cloned_large_ones_split_faint_and_huge_ones_removed() {
    use Fate::{Cloned, Kept, Removed, Split};
    check(
        &[
            (0.5, 0.04, 3e-4),
            (0.5, 0.06, 3e-4),
            (0.5, 0.04, 1e-4),
            (0.5, 0.06, 1e-4),
            (0.004, 0.04, 3e-4),
            (0.004, 0.06, 3e-4),
            (0.5, 0.6, 1e-4),
            // Its parts have a scale of 0.375.
            (0.5, 0.6, 3e-4),
            // Its parts would have one of 0.5625.
            (0.5, 0.9, 3e-4),
        ],
        &SETTINGS,
        &[
            Cloned, Split, Kept, Kept, Removed, Removed, Removed, Split, Removed,
        ],
    );
    let unbounded = DensifySettings {
        max_scale: f32::INFINITY,
        ..SETTINGS
    };
    check(
        &[(0.5, 900.0, 3e-4), (0.5, 900.0, 1e-4)],
        &unbounded,
        &[Split, Kept],
    );
}

#[test]
fn where_room_is_short_the_largest_gradients_go_first() {
    use Fate::{Cloned, Kept, Removed, Split};
    let rows = [
        (0.5, 0.04, 3e-4),
        (0.5, 0.04, 9e-4),
        (0.5, 0.06, 5e-4),
        (0.001, 0.04, 0.0),
        (0.5, 0.7, 4e-4),
    ];
    // One goes, two of four candidates have room. The one that is too large must not stay as it is.
    let settings = DensifySettings {
        max_splats: 6,
        ..SETTINGS
    };
    check(&rows, &settings, &[Kept, Cloned, Split, Removed, Removed]);
    let full = DensifySettings {
        max_splats: 1,
        ..SETTINGS
    };
    check(&rows, &full, &[Kept, Kept, Kept, Removed, Removed]);
}

#[test]
fn a_splat_that_no_step_saw_or_that_lost_its_numbers_is_none_to_multiply() {
    let (mut splats, mut gradients) = splats_of(&[(0.5, 0.04, 3e-4); 3]);
    gradients.counts[0] = 0;
    splats.means[1][2] = f32::NAN;
    gradients.sums.truncate(2);
    gradients.counts.truncate(2);
    let found = fates(&splats, &gradients, &SETTINGS);
    assert_eq!(found, [Fate::Kept, Fate::Removed, Fate::Kept]);
}

#[test]
fn rows_that_come_stem_from_those_that_are_cloned_and_split() {
    let (splats, _) = splats_of(&[(0.5, 0.04, 3e-4), (0.3, 0.08, 3e-4), (0.5, 0.04, 0.0)]);
    let found = densify(&splats, &[Fate::Cloned, Fate::Split, Fate::Removed], 3);
    assert_eq!(found.keep, [true, false, false]);
    assert_eq!(found.parents, [0, 1, 1]);
    assert_eq!(found.added.picked(&[0]), splats.picked(&[0]), "a clone");
    for row in [1, 2] {
        let eta = normal3([3, 1, row - 1]);
        // Turned by 90 degrees: own x goes to y, own y to -x.
        let expected = [1.0 - 0.04 * eta[1], 0.08 * eta[0], 0.008 * eta[2]];
        for (found, expected) in found.added.means[row as usize].iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{found}, {expected}");
        }
        let scale = found.added.log_scales[row as usize][0].exp();
        assert!((scale - 0.05).abs() < 1e-6, "{scale}");
        assert_eq!(
            found.added.opacity_logits[row as usize],
            splats.opacity_logits[1]
        );
        assert_eq!(found.added.quats[row as usize], splats.quats[1]);
        assert_eq!(found.added.anchors[row as usize], 1);
    }
    assert_ne!(found.added.means[1], found.added.means[2]);
}

#[test]
fn parts_have_the_spread_of_the_splat_they_stem_from() {
    const N: u32 = 4000;
    let (splats, _) = splats_of(&[(0.5, 0.08, 3e-4)]);
    let (mut mean, mut square) = ([0.0; 3], [0.0; 3]);
    for seed in 0..N {
        let found = densify(&splats, &[Fate::Split], seed);
        for axis in 0..3 {
            let x = f64::from(found.added.means[0][axis]);
            mean[axis] += x / f64::from(N);
            square[axis] += x * x / f64::from(N);
        }
    }
    for (axis, sigma) in [0.04, 0.08, 0.008].into_iter().enumerate() {
        // Five standard errors.
        let error = 5.0 / f64::from(N).sqrt();
        assert!(mean[axis].abs() < error * sigma, "{mean:?}");
        let variance = square[axis] / (sigma * sigma);
        assert!((variance - 1.0).abs() < 1.5 * error, "{variance}");
    }
}
