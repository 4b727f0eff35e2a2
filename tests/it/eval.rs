//! Trajectories against a reference, pictures from poses: what `eval` and `render` compute and write.

use std::path::Path;

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use splat_mapper::camera::Intrinsics;
use splat_mapper::clock::Stamp;
use splat_mapper::eval::align::{AlignError, align, umeyama};
use splat_mapper::eval::evaluation::{compare, evaluate, extent};
use splat_mapper::eval::render::{read_intrinsics, render_poses};
use splat_mapper::eval::report::{Quality, Report};
use splat_mapper::eval::trajectory::{
    TOLERANCE_SECS, TimedPose, associate, format_tum, parse_tum, read_tum, write_tum,
};
use splat_mapper::pose::{Rigid, Similarity};
use splat_mapper::splat::{Engine, Rendering, Splats, StepSettings, StepStats, TrainingView};

use crate::scenes::scene;

/// Noise-free data of size 10 in doubles; the eigenvalue solver loses some digits.
const EXACT: f64 = 1e-9;

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
            check_same(&umeyama(&source, &target).unwrap(), &expected);
        }
    }
}

#[test]
fn mirrored_points_get_the_best_rotation_not_a_reflection() {
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    let source: Vec<DVec3> = (0..30).map(|_| vector(&mut rng, 5.0)).collect();
    let target: Vec<DVec3> = source.iter().map(|p| DVec3::new(-p.x, p.y, p.z)).collect();
    let found = umeyama(&source, &target).unwrap();
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
        check_same(&umeyama(&source, &target).unwrap(), &expected);
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
    let map_from_reference = similarity(&mut rng);
    let run = tempfile::tempdir().unwrap();
    write_tum(
        &moved(&reference, &map_from_reference),
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
        (figures.aligned_scale.unwrap() * map_from_reference.scale - 1.0).abs() < 1e-7,
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
fn poses_are_paired_by_time_once_each() {
    let at = |secs: &[f64]| -> Vec<TimedPose> {
        secs.iter()
            .map(|&secs| TimedPose {
                stamp: Stamp::from_secs(secs),
                pose: Rigid::IDENTITY,
            })
            .collect()
    };
    let check = |run: &[f64], reference: &[f64], expected: &[(usize, usize)]| {
        assert_eq!(
            associate(&at(run), &at(reference), TOLERANCE_SECS),
            expected,
            "{run:?} {reference:?}"
        );
    };
    check(&[1.0, 2.0, 3.0], &[1.004, 2.2, 2.991], &[(0, 0), (2, 2)]);
    check(&[1.01], &[1.0], &[(0, 0)]);
    check(&[1.011], &[1.0], &[]);
    check(&[1.0, 1.004, 1.009], &[1.003], &[(1, 0)]);
    check(&[1.004, 1.0], &[], &[]);
    check(
        &[1_403_715_273.262_143],
        &[1_403_715_273.262_1, 1_403_715_273.262_2],
        &[(0, 0)],
    );
}

#[test]
fn trajectories_survive_a_file() {
    let mut rng = Pcg64Mcg::seed_from_u64(8);
    let mut written = timed(&poses(&mut rng, 30));
    written[29].stamp = Stamp::from_nanos(1_403_715_273_262_142_976);
    let read = parse_tum(&format_tum(&written), Path::new("memory")).unwrap();
    for (a, b) in written.iter().zip(&read) {
        assert_eq!(a.stamp, b.stamp);
        assert!(
            a.pose.translation.distance(b.pose.translation) < 1e-8
                && a.pose.angle_to(&b.pose) < 1e-8
        );
    }
    assert_eq!(read.len(), written.len());
    assert!(format_tum(&written).contains("1403715273.262142976 "));
}

#[test]
fn a_bad_line_is_named() {
    let good = "0.5 1 2 3 0 0 0 1";
    let check = |bad: &str, expected: &str| {
        let text = format!("# head\n\n{good}\n{bad}\n");
        let message = parse_tum(&text, Path::new("some/poses.txt"))
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("line 4")
                && message.contains(expected)
                && message.ends_with("some/poses.txt"),
            "{message}"
        );
    };
    check("1.0 1 2 3 0 0 0", "fewer than eight");
    check("1.0 1 2 3 0 0 0 1 9", "more than eight");
    check("1.0 1 2 three 0 0 0 1", "no number");
    check("1.0 1 2 NaN 0 0 0 1", "not finite");
    check("1.0 1 2 inf 0 0 0 1", "not finite");
    check("1.0 1 2 1e300 0 0 0 1", "absurdly large");
    check("nan 1 2 3 0 0 0 1", "stamp");
    check("1403715273262142976 1 2 3 0 0 0 1", "stamp");
    check("1.0 1 2 3 0 0 0 0", "length 1");
    check("0.5 1 2 4 0 0 0 1", "repeats the stamp 0.500000000");
    check(&"x".repeat(100_000), "…");
}

#[test]
fn order_comments_and_repeated_lines_do_not_matter() {
    let text = "# c\n2.0 1 0 0 0 0 0 1 # behind\n  1.5e0\t1 0 0 0 0 0 2e0\n";
    assert!(
        parse_tum(text, Path::new("x")).is_err(),
        "a quaternion of length 2"
    );
    let text =
        "# c\r\n2.0 1 0 0 0 0 0 1 # behind\r\n\r\n  1.5e0\t1 0 0 0 0 0 1.001\r\n2.0 1 0 0 0 0 0 1";
    let poses = parse_tum(text, Path::new("x")).unwrap();
    let stamps: Vec<f64> = poses.iter().map(|timed| timed.stamp.secs()).collect();
    assert_eq!(stamps, [1.5, 2.0]);
    assert_eq!(poses[0].pose.rotation, DQuat::IDENTITY);
    assert_eq!(parse_tum("", Path::new("x")).unwrap(), []);
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
    std::fs::write(&reference, "5.0 0 0 0 0 0 0 1\n6.0 0 0 0 0 0 0 1\n").unwrap();
    assert!(
        message().contains("1.000000000") && message().contains("5.000000000 to 6.000000000"),
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
    let text = figures.to_string();
    assert!(
        text.contains("5 of 5") && text.contains("PSNR 24.5000 dB") && text.contains("every 8th"),
        "{text}"
    );
}

/// Renders a ramp that depends on the pose, so that files can be told apart.
#[derive(Debug, Default)]
struct Ramp {
    n_splats: usize,
}

impl Engine for Ramp {
    fn adapter(&self) -> String {
        "ramp".to_owned()
    }
    fn append(&mut self, splats: &Splats) {
        self.n_splats += splats.len();
    }
    fn retain(&mut self, _: &[bool]) {}
    fn overwrite(&mut self, _: &Splats) {}
    fn n_splats(&self) -> usize {
        self.n_splats
    }
    fn add_view(&mut self, _: TrainingView) -> usize {
        0
    }
    fn set_pose(&mut self, _: usize, _: Rigid) {}
    fn step(&mut self, _: usize, _: &StepSettings) {}
    fn take_stats(&mut self) -> StepStats {
        StepStats::default()
    }
    fn poses(&mut self) -> Vec<Rigid> {
        Vec::new()
    }
    fn splats(&mut self) -> Splats {
        Splats::default()
    }
    fn render(&mut self, intrinsics: &Intrinsics, cam_from_map: &Rigid, _: u8) -> Rendering {
        let n = (intrinsics.width_px * intrinsics.height_px) as usize;
        // The camera stands at x = 1, 2, …, so the map's origin lies at -1, -2, … in its frame.
        let step = -cam_from_map.translation.x as f32;
        Rendering {
            width_px: intrinsics.width_px,
            height_px: intrinsics.height_px,
            rgb: (0..3 * n)
                .map(|ix| (ix as f32 * step - 2.0) / 255.0)
                .collect(),
            alpha: vec![1.0; n],
            depth: (0..n)
                .map(|ix| [0.0, 1.234 * step, 1e-5, 100.0, f32::NAN][ix % 5])
                .collect(),
        }
    }
}

#[test]
fn renders_are_files_that_hold_the_rendering() {
    let out = tempfile::tempdir().unwrap();
    let intrinsics = Intrinsics {
        width_px: 7,
        height_px: 5,
        fx: 8.0,
        fy: 8.0,
        cx: 3.5,
        cy: 2.5,
    };
    let pose = |x: f64| {
        (
            Stamp::from_secs(x / 10.0),
            Rigid::new(DQuat::IDENTITY, DVec3::new(x, 0.0, 0.0)),
        )
    };
    let splats = Splats {
        means: vec![[0.0; 3]],
        ..Splats::default()
    };
    let folder = out.path().join("new/folder");
    let n = render_poses(
        &splats,
        &mut Ramp::default(),
        &[pose(1.0), pose(3.0)],
        &intrinsics,
        &folder,
        true,
    )
    .unwrap();
    assert_eq!(n, 2);
    let picture = image::open(folder.join("000001.png")).unwrap().into_rgb8();
    assert_eq!(picture.dimensions(), (7, 5));
    let expected: Vec<u8> = (0..105)
        .map(|ix| (ix * 3 - 2).clamp(0, 255) as u8)
        .collect();
    assert_eq!(picture.into_raw(), expected);
    let depth = image::open(folder.join("depth/000001.png")).unwrap();
    assert_eq!(depth.color(), image::ColorType::L16);
    assert_eq!(
        depth.into_luma16().into_raw()[..6],
        [0, 3702, 1, 65_535, 0, 0]
    );
    let list = std::fs::read_to_string(folder.join("images.txt")).unwrap();
    assert!(
        list.ends_with("0.100000000 000000.png\n0.300000000 000001.png\n"),
        "{list}"
    );
    let mut names: Vec<_> = std::fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name())
        .collect();
    names.sort();
    assert_eq!(
        names,
        ["000000.png", "000001.png", "depth", "images.txt"],
        "no partial files stay"
    );
}

#[test]
fn intrinsics_move_from_integer_centres_to_ours() {
    let Some(fox) = scene("fox") else { return };
    let intrinsics = read_intrinsics(&fox.join("intrinsics.json")).unwrap();
    assert_eq!(
        (intrinsics.width_px, intrinsics.height_px, intrinsics.fx),
        (540, 960, 687.76)
    );
    assert_eq!((intrinsics.cx, intrinsics.cy), (277.279, 482.634));
}

#[test]
fn hostile_intrinsics_are_refused_with_what_was_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("intrinsics.json");
    let check = |text: &str, expected: &str| {
        std::fs::write(&path, text).unwrap();
        let message = read_intrinsics(&path).unwrap_err().to_string();
        assert!(
            message.contains(expected) && message.ends_with("intrinsics.json"),
            "{text}: {message}"
        );
    };
    let with = |width: &str, fx: &str, model: &str| {
        format!(
            r#"{{"width": {width}, "height": 480, "fx": {fx}, "fy": 500, "cx": 320, "cy": 240, "model": "{model}"}}"#
        )
    };
    check("", "EOF");
    check("[]", "expected");
    check(r#"{"width": 640}"#, "missing field");
    check(&with("0", "500", "PINHOLE"), "0 x 480");
    check(&with("-640", "500", "PINHOLE"), "-640 x 480");
    check(&with("640.5", "500", "PINHOLE"), "640.5 x 480");
    check(&with("90000000", "500", "PINHOLE"), "100 megapixels");
    check(&with("1e400", "500", "PINHOLE"), "number out of range");
    check(&with("640", "0", "PINHOLE"), "fx 0");
    check(&with("640", "-500", "PINHOLE"), "fx -500");
    check(&with("640", "1e9", "PINHOLE"), "focal length");
    check(&with("640", "500", "OPENCV_FISHEYE"), "rectify");
    std::fs::write(&path, with("640", "500", "pinhole")).unwrap();
    read_intrinsics(&path).unwrap();
}
