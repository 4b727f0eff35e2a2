//! A run against a reference: the figures of `splat-mapper eval`.

use std::path::Path;

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::scenes::scene;
use splat_geometry::similarity;
use splat_mapper::eval::alignment::{AlignError, align};
use splat_mapper::eval::evaluation::{compare, evaluate};
use splat_mapper::eval::report_json::{Quality, Report};
use splat_mapper::eval::trajectory::{TimedPose, read_tum, write_tum};
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, Similarity, extent};

/// Noise-free data of size 10 in doubles; the eigenvalue solver loses some digits.
const EXACT: f64 = 1e-9;

fn fitted(source: &[DVec3], target: &[DVec3]) -> Option<Similarity> {
    let pairs: Vec<(DVec3, DVec3)> = target.iter().copied().zip(source.iter().copied()).collect();
    similarity::of_points(&pairs)
}

fn vector(rng: &mut Pcg64Mcg, size: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|_| rng.random_range(-size..size)))
}

fn rotation(rng: &mut Pcg64Mcg) -> DQuat {
    DQuat::from_scaled_axis(vector(rng, 2.0))
}

fn similarity(rng: &mut Pcg64Mcg) -> Similarity {
    Similarity {
        scale: rng.random_range(0.01..50.0),
        rotation: rotation(rng),
        translation: vector(rng, 10.0),
    }
}

fn poses(rng: &mut Pcg64Mcg, n: usize) -> Vec<Rigid> {
    (0..n)
        .map(|_| Rigid::new(rotation(rng), vector(rng, 10.0)))
        .collect()
}

fn timed(poses: &[Rigid]) -> Vec<TimedPose> {
    poses
        .iter()
        .enumerate()
        .map(|(ix, &pose)| TimedPose {
            stamp: Stamp::from_secs(0.1 * ix as f64),
            pose,
        })
        .collect()
}

fn moved(poses: &[TimedPose], similarity: &Similarity) -> Vec<TimedPose> {
    poses
        .iter()
        .map(|timed| TimedPose {
            pose: similarity.transform_pose(&timed.pose),
            ..*timed
        })
        .collect()
}

fn check_same(found: &Similarity, expected: &Similarity) {
    let angle = Rigid::new(found.rotation, DVec3::ZERO)
        .angle_to(&Rigid::new(expected.rotation, DVec3::ZERO));
    assert!(
        (found.scale / expected.scale - 1.0).abs() < EXACT,
        "{found:?} {expected:?}"
    );
    assert!(angle < EXACT, "{angle}");
    assert!(
        found.translation.distance(expected.translation) < EXACT * (1.0 + 20.0 * expected.scale),
        "{found:?} {expected:?}"
    );
}

#[test]
fn a_similarity_without_noise_is_found_exactly() {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for n in [3, 4, 50] {
        for _ in 0..40 {
            let expected = similarity(&mut rng);
            let source: Vec<DVec3> = (0..n).map(|_| vector(&mut rng, 10.0)).collect();
            let target: Vec<DVec3> = source
                .iter()
                .map(|p| expected.transform_point(*p))
                .collect();
            check_same(&fitted(&source, &target).unwrap(), &expected);
        }
    }
}

#[test]
fn mirrored_points_get_the_best_rotation_not_a_reflection() {
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    let source: Vec<DVec3> = (0..30).map(|_| vector(&mut rng, 5.0)).collect();
    let target: Vec<DVec3> = source.iter().map(|p| DVec3::new(-p.x, p.y, p.z)).collect();
    let found = fitted(&source, &target).unwrap();
    assert!((found.rotation.length() - 1.0).abs() < EXACT);
    let error = |s: &Similarity| {
        source
            .iter()
            .zip(&target)
            .map(|(a, b)| s.transform_point(*a).distance_squared(*b))
            .sum::<f64>()
    };
    let best = error(&found);
    for _ in 0..200 {
        let near = Similarity {
            scale: found.scale * rng.random_range(0.9..1.1),
            rotation: DQuat::from_scaled_axis(vector(&mut rng, 0.1)) * found.rotation,
            translation: found.translation + vector(&mut rng, 0.1),
        };
        assert!(error(&near) >= best, "a neighbour is better");
    }
}

#[test]
fn points_in_a_plane_are_aligned_exactly() {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    for _ in 0..20 {
        let expected = similarity(&mut rng);
        let source: Vec<DVec3> = (0..12)
            .map(|_| vector(&mut rng, 10.0) * DVec3::new(1.0, 1.0, 0.0))
            .collect();
        let target: Vec<DVec3> = source
            .iter()
            .map(|p| expected.transform_point(*p))
            .collect();
        check_same(&fitted(&source, &target).unwrap(), &expected);
    }
}

#[test]
fn on_a_line_the_orientations_say_the_roll() {
    let mut rng = Pcg64Mcg::seed_from_u64(4);
    for _ in 0..20 {
        let direction = vector(&mut rng, 1.0);
        let straight: Vec<Rigid> = (0..20)
            .map(|ix| Rigid::new(rotation(&mut rng), direction * f64::from(ix)))
            .collect();
        let expected = similarity(&mut rng);
        let reference: Vec<Rigid> = straight
            .iter()
            .map(|pose| expected.transform_pose(pose))
            .collect();
        let found = align(&straight, &reference).unwrap();
        assert!(found.is_line);
        // The line itself holds a square root of the rounding across it.
        let angle = Rigid::new(found.reference_from_estimate.rotation, DVec3::ZERO)
            .angle_to(&Rigid::new(expected.rotation, DVec3::ZERO));
        assert!(angle < 1e-7, "{angle}");
        let figures = compare(&timed(&straight), &timed(&reference));
        assert!(figures.note.unwrap().contains("line"));
        assert!(figures.ate_rmse.unwrap() < 1e-6 * expected.scale);
    }
}

#[test]
fn too_few_poses_or_one_place_cannot_be_aligned_and_say_so() {
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let two = poses(&mut rng, 2);
    assert_eq!(align(&two, &two), Err(AlignError::TooFew { found: 2 }));
    let many = poses(&mut rng, 6);
    let still: Vec<Rigid> = many
        .iter()
        .map(|pose| Rigid::new(pose.rotation, DVec3::new(1e3, 2.0, 3.0)))
        .collect();
    assert_eq!(align(&still, &many), Err(AlignError::Point { of: "run" }));
    assert_eq!(
        align(&many, &still),
        Err(AlignError::Point { of: "reference" })
    );
    let figures = compare(&timed(&two), &timed(&two));
    assert_eq!((figures.registered, figures.ate_rmse), (2, None));
    assert!(figures.note.unwrap().contains("at least 3"));
}

#[test]
fn a_scaled_turned_and_moved_copy_has_no_error() {
    let Some(fox) = scene("fox") else { return };
    let reference = read_tum(&fox.join("poses_tum.txt")).unwrap();
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    let world_from_reference = similarity(&mut rng);
    let run = tempfile::tempdir().unwrap();
    write_tum(
        &moved(&reference, &world_from_reference),
        &run.path().join("keyframes.tum"),
    )
    .unwrap();
    let figures = evaluate(run.path(), &fox.join("poses_tum.txt")).unwrap();
    assert_eq!(
        (figures.registered, figures.reference, figures.keyframes),
        (50, 50, 50)
    );
    // Nine decimals in both files.
    assert!(figures.ate_rmse.unwrap() < 1e-7, "{figures:?}");
    assert!(
        figures.rotation_mean_deg.unwrap() < 1e-5 && figures.rpe_rotation_deg.unwrap() < 1e-5,
        "{figures:?}"
    );
    assert!(
        (figures.aligned_scale.unwrap() * world_from_reference.scale - 1.0).abs() < 1e-7,
        "{figures:?}"
    );
    assert_eq!((figures.note, figures.quality), (None, None));
}

#[test]
fn known_perturbations_give_known_errors() {
    // A square in a plane, each corner moved out of the plane by 0.3 in turn up and down: no similarity helps.
    let corner = |x: f64, y: f64| Rigid::new(DQuat::IDENTITY, DVec3::new(x, y, 0.0));
    let reference = [
        corner(1.0, 1.0),
        corner(-1.0, 1.0),
        corner(-1.0, -1.0),
        corner(1.0, -1.0),
    ];
    let turn = DQuat::from_rotation_z(2f64.to_radians());
    let run: Vec<Rigid> = (reference.iter().zip([0.3, -0.3, 0.3, -0.3]))
        .map(|(pose, dz)| Rigid::new(turn, pose.translation + DVec3::new(0.0, 0.0, dz)))
        .collect();
    let figures = compare(&timed(&run), &timed(&reference));
    // The best scale shrinks the run a little: s = 2 / (2 + 0.09), error² = 2 (1 - s)² + 0.09 s².
    let s = 2.0 / 2.09;
    let ate = (2.0 * (1.0f64 - s).powi(2) + 0.09 * s * s).sqrt();
    assert!((figures.aligned_scale.unwrap() - s).abs() < EXACT);
    assert!(
        (figures.ate_rmse.unwrap() - ate).abs() < EXACT,
        "{figures:?} {ate}"
    );
    assert!((figures.ate_percent_of_extent.unwrap() - 100.0 * ate / 8f64.sqrt()).abs() < EXACT);
    assert!((figures.rotation_mean_deg.unwrap() - 2.0).abs() < EXACT);
    // All cameras are turned by the same angle: from one to the next nothing turns.
    assert!(figures.rpe_rotation_deg.unwrap() < EXACT);
    let side = DVec3::new(2.0, 0.0, 0.0);
    let step =
        DQuat::from_rotation_z(-2f64.to_radians()) * DVec3::new(2.0 * s, 0.0, 0.6 * s) - side;
    assert!((figures.rpe_translation.unwrap() - step.length()).abs() < EXACT);
}

/// The same perturbation, alignment (SVD) and figures written in numpy, to twelve digits.
#[test]
fn real_trajectories_get_the_figures_of_an_independent_program() {
    let expected = [
        (
            "fox",
            [
                0.0604653162048,
                0.847058138248,
                0.365449890841,
                0.0972926565337,
                0.48796111716,
                0.500061624013,
            ],
        ),
        (
            "kitti_vo1",
            [
                0.0603717971092,
                0.100857596089,
                0.38278749095,
                0.0966419602456,
                0.486114239389,
                0.500012429961,
            ],
        ),
    ];
    for (name, expected) in expected {
        let Some(folder) = scene(name) else { return };
        let reference = read_tum(&folder.join("poses_tum.txt")).unwrap();
        let world = DQuat::from_rotation_x(0.5);
        let run: Vec<TimedPose> = (reference.iter().enumerate())
            .map(|(ix, timed)| {
                let i = ix as f64;
                let off = 0.05 * DVec3::new(i.sin(), (2.0 * i).cos(), (3.0 * i).sin());
                let rotation =
                    world * timed.pose.rotation * DQuat::from_rotation_z(0.01 * (5.0 * i).sin());
                TimedPose {
                    pose: Rigid::new(rotation, 2.0 * (world * (timed.pose.translation + off))),
                    ..*timed
                }
            })
            .collect();
        let figures = compare(&run, &reference);
        let found = [
            figures.ate_rmse,
            figures.ate_percent_of_extent,
            figures.rotation_mean_deg,
            figures.rpe_translation,
            figures.rpe_rotation_deg,
            figures.aligned_scale,
        ];
        for (found, expected) in found.iter().zip(expected) {
            assert!(
                (found.unwrap() / expected - 1.0).abs() < EXACT,
                "{name}: {figures:?} {expected}"
            );
        }
        // The only one that drives straight ahead.
        let is_loose = figures.note.is_some_and(|n| n.contains("nearly on a line"));
        assert_eq!(is_loose, name == "kitti_vo1", "{name}");
    }
}

#[test]
fn the_extent_is_that_of_the_whole_reference() {
    let mut rng = Pcg64Mcg::seed_from_u64(7);
    let reference = timed(&poses(&mut rng, 40));
    let mut run = reference[..10].to_vec();
    run[3].pose.translation.x += 0.5;
    let figures = compare(&run, &reference);
    assert_eq!((figures.registered, figures.reference), (10, 40));
    let positions: Vec<DVec3> = reference
        .iter()
        .map(|timed| timed.pose.translation)
        .collect();
    let percent = 100.0 * figures.ate_rmse.unwrap() / extent(&positions);
    assert_eq!(figures.ate_percent_of_extent, Some(percent));

    let many: Vec<DVec3> = (0..9000)
        .map(|_| vector(&mut rng, 1.0).normalize())
        .collect();
    assert!(
        (extent(&many) / 2.0 - 1.0).abs() < 0.005,
        "points on a sphere of diameter 2"
    );
}

#[test]
fn evaluation_errors_name_the_file_and_the_way_out() {
    let run = tempfile::tempdir().unwrap();
    let reference = run.path().join("truth.txt");
    let keyframes = run.path().join("keyframes.tum");
    let message = || evaluate(run.path(), &reference).unwrap_err().to_string();
    assert!(message().contains("keyframes.tum"), "{}", message());
    std::fs::write(&keyframes, "# none\n").unwrap();
    assert!(message().contains("no poses"), "{}", message());
    std::fs::write(&keyframes, "1.0 0 0 0 0 0 0 1\n").unwrap();
    std::fs::write(&reference, [0xff, 0xfe, 0x00]).unwrap();
    assert!(message().contains("UTF-8"), "{}", message());
    std::fs::write(&reference, "5.5 0 0 0 0 0 0 1\n6.5 0 0 0 0 0 0 1\n").unwrap();
    assert!(
        message().contains("1.000000000") && message().contains("5.500000000 to 6.500000000"),
        "{}",
        message()
    );
    std::fs::write(run.path().join("report.json"), "{").unwrap();
    assert!(message().contains("report.json"), "{}", message());
    assert!(read_tum(Path::new("/dev/null")).unwrap().is_empty());
    assert!(read_tum(run.path()).is_err(), "a folder");
}

#[test]
fn the_json_of_an_evaluation_has_the_promised_keys() {
    let mut rng = Pcg64Mcg::seed_from_u64(9);
    let reference = timed(&poses(&mut rng, 5));
    let run = tempfile::tempdir().unwrap();
    let truth = run.path().join("truth.txt");
    write_tum(&reference, &truth).unwrap();
    write_tum(&reference, &run.path().join("keyframes.tum")).unwrap();
    let quality = Quality {
        holdout_every: 8,
        psnr_holdout: Some(24.5),
        psnr_holdout_half: Some(24.25),
        psnr_holdout_exposed: Some(25.75),
        ..Quality::default()
    };
    Report {
        quality,
        ..Report::default()
    }
    .write(&run.path().join("report.json"))
    .unwrap();
    let figures = evaluate(run.path(), &truth).unwrap();
    let json = serde_json::to_value(&figures).unwrap();
    for key in [
        "registered",
        "reference",
        "ate_rmse",
        "ate_percent_of_extent",
        "rotation_mean_deg",
        "rpe_translation",
        "rpe_rotation_deg",
        "aligned_scale",
    ] {
        assert!(json[key].is_number(), "{key}: {json}");
    }
    assert_eq!(json["quality"]["psnr_holdout"], 24.5);
    assert_eq!(json["quality"]["psnr_holdout_exposed"], 25.75);
    let text = figures.to_string();
    assert!(
        text.contains("5 of 5") && text.contains("PSNR 24.5000 dB") && text.contains("every 8th"),
        "{text}"
    );
    assert!(
        text.contains("PSNR 24.2500 dB") && text.contains("the left halves 25.7500 dB"),
        "{text}"
    );
}
