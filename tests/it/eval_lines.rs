//! Paths that are nearly a line: the figures say what cannot be known.

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use splat_mapper::eval::evaluation::compare;
use splat_mapper::eval::trajectory::TimedPose;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

fn vector(rng: &mut Pcg64Mcg, size: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|_| rng.random_range(-size..size)))
}

fn timed(poses: &[Rigid]) -> Vec<TimedPose> {
    let at = |ix: usize| Stamp::from_secs(0.1 * ix as f64);
    let timed = |(ix, &pose)| TimedPose {
        stamp: at(ix),
        pose,
    };
    poses.iter().enumerate().map(timed).collect()
}

/// A road that bends by a thousandth of its length, followed to within a few centimetres.
#[test]
fn a_path_that_is_nearly_a_line_says_that_its_roll_is_loose() {
    let mut rng = Pcg64Mcg::seed_from_u64(8);
    let along = |ix: i32| DVec3::new(0.1 * (0.3 * f64::from(ix)).sin(), 0.0, 3.0 * f64::from(ix));
    let road: Vec<Rigid> = (0..30)
        .map(|ix| Rigid::new(DQuat::IDENTITY, along(ix)))
        .collect();
    let mut driven = |error: f64| {
        let shaken = |pose: &Rigid| {
            Rigid::new(
                pose.rotation,
                pose.translation + vector(&mut rng, 1.0) * error,
            )
        };
        let run: Vec<Rigid> = road.iter().map(shaken).collect();
        compare(&timed(&run), &timed(&road))
    };
    let loose = driven(0.1);
    let note = loose.note.unwrap();
    assert!(note.contains("nearly on a line"), "{note}");
    // The orientations are exact, so the roll that they ask for leaves only the tilt of the fitted line.
    let without: f64 = note.rsplit(' ').next().unwrap().parse().unwrap();
    assert!(
        without < 0.2 && loose.rotation_mean_deg.unwrap() > without,
        "{note}"
    );
    assert_eq!(driven(0.001).note, None);
}
