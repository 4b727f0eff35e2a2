//! TUM files read and written, and which poses belong together.

use std::path::Path;

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use splat_mapper::eval::trajectory::{
    TOLERANCE_SECS, TimedPose, associate, format_tum, parse_tum, shifted, stamp_offset_nanos,
};
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

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
    let mut written: Vec<TimedPose> = (0..30)
        .map(|ix| {
            let size = f64::from(ix);
            let rotation = DQuat::from_scaled_axis(DVec3::new(0.1, -0.2, 0.3) * size);
            let pose = Rigid::new(
                rotation,
                DVec3::new(size / 3.0, -size / 7.0, 1e3 / (size + 1.0)),
            );
            TimedPose {
                stamp: Stamp::from_secs(0.1 * size),
                pose,
            }
        })
        .collect();
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
fn damaged_files_end_in_poses_or_an_error_never_a_panic() {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let good = "# head\n0.1 1 2 3 0 0 0 1\n1.5e0 -1.25 2e-3 3 0.5 0.5 0.5 0.5\n3 4 5 6 0 0 0 -1\n";
    let (mut n_read, mut n_refused) = (0, 0);
    for _ in 0..4000 {
        let mut bytes = good.as_bytes().to_vec();
        for _ in 0..rng.random_range(1..4) {
            let at = rng.random_range(0..bytes.len());
            match rng.random_range(0..3) {
                0 => bytes[at] = b"0123456789.-+eEnainf# \n\t\0\xc3\xa9"[rng.random_range(0..27)],
                1 => bytes.truncate(at + 1),
                _ => bytes.insert(at, bytes[at]),
            }
        }
        match parse_tum(&String::from_utf8_lossy(&bytes), Path::new("x")) {
            Ok(poses) => {
                n_read += 1;
                assert!(poses.iter().all(|timed| timed.pose.is_finite()));
                assert!(poses.is_sorted_by(|a, b| a.stamp < b.stamp));
            }
            Err(_) => n_refused += 1,
        }
    }
    assert!(n_read > 100 && n_refused > 100, "{n_read} {n_refused}");
}

#[test]
fn a_recording_with_an_epoch_of_its_own_still_meets_its_reference() {
    let at = |i: i64| TimedPose {
        stamp: Stamp::from_nanos(100_000_000 * i),
        pose: Rigid::IDENTITY,
    };
    let reference: Vec<TimedPose> = (0..100).map(at).collect();
    let run: Vec<TimedPose> = (3..90).step_by(4).map(at).collect();
    let epoch = 1_700_000_000 * 1_000_000_000;
    let offset = |run: &[TimedPose]| stamp_offset_nanos(run, &reference, TOLERANCE_SECS);
    assert_eq!(offset(&run), 0, "stamps that meet stay as they are");
    assert_eq!(offset(&shifted(&run, epoch)), -epoch);
    // Half a frame beside every reference stamp: no whole number of seconds helps.
    assert_eq!(offset(&shifted(&run, epoch + 50_000_000)), 0);
}
