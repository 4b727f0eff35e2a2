//! Poses of frames as they are reported when the frames come, on real scenes with reference poses: how far off, and whether that
//! is what their stated standard deviations say.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use crate::scenes::scene;
use splat_geometry::similarity;
use splat_mapper::eval::trajectory::{associate, read_tum, shifted, stamp_offset_nanos};
use splat_types::transform::extent;

const TOLERANCE_SECS: f64 = 0.01;
/// An error is within so many standard deviations of the least certain axis with 95 % where all three axes are as uncertain.
const N_STD: f64 = 2.8;

struct Found {
    /// RMSE after the best similarity, as a share of the reference path's extent.
    error: f64,
    /// Share of the frames whose error is what their covariance says.
    within: f64,
    n: usize,
}

/// Of the poses in `trajectory_live.tum` of a replay that trains little, as nothing here depends on it.
fn replayed(source: &Path, reference: &Path) -> Found {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path();
    let output = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["replay", source.to_str().unwrap(), "--steps", "20"])
        .args(["--out", out.to_str().unwrap()])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}");
    let reference = read_tum(reference).unwrap();
    let live = read_tum(&out.join("trajectory_live.tum")).unwrap();
    let offset = stamp_offset_nanos(&live, &reference, TOLERANCE_SECS);
    let moved = shifted(&live, offset);
    let table = std::fs::read_to_string(out.join("frames.csv")).unwrap();
    let std_of = |line: &str| {
        let words: Vec<&str> = line.split(',').collect();
        Some((words[0].to_owned(), words[4].parse::<f64>().ok()?))
    };
    let stds: BTreeMap<String, f64> = table.lines().skip(1).filter_map(std_of).collect();
    let pairs = associate(&moved, &reference, TOLERANCE_SECS);
    let points: Vec<_> = pairs
        .iter()
        .map(|(a, b)| (reference[*b].pose.translation, moved[*a].pose.translation))
        .collect();
    let reference_from_map = similarity::of_points(&points).unwrap();
    let errors: Vec<f64> = points
        .iter()
        .map(|(truth, found)| reference_from_map.transform_point(*found).distance(*truth))
        .collect();
    let stamp = |ix: usize| {
        let nanos = live[ix].stamp.nanos;
        format!("{}.{:09}", nanos / 1_000_000_000, nanos % 1_000_000_000)
    };
    let is_within = |((ix, _), error): (&(usize, usize), &f64)| {
        let std = stds[&stamp(*ix)] * reference_from_map.scale;
        *error <= N_STD * std
    };
    let n_within = pairs.iter().zip(&errors).filter(|pair| is_within(*pair));
    let squares = errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64;
    let way: Vec<_> = points.iter().map(|(truth, _)| *truth).collect();
    Found {
        error: squares.sqrt() / extent(&way),
        within: n_within.count() as f64 / errors.len() as f64,
        n: errors.len(),
    }
}

#[test]
fn frames_of_an_uneven_phone_video_are_where_they_are_said_to_be() {
    let Some(fox) = scene("fox_clean") else {
        return;
    };
    let found = replayed(&fox.join("rosbag2"), &fox.join("poses_tum.txt"));
    assert!(found.n >= 38, "{} of 50 frames were tracked", found.n);
    assert!(found.error < 0.005, "off by {} of the extent", found.error);
    assert!(
        found.within >= 0.8,
        "{} are as sure as they say",
        found.within
    );
}

#[test]
fn frames_of_a_car_are_where_they_are_said_to_be() {
    let Some(kitti) = scene("kitti_vo1") else {
        return;
    };
    let found = replayed(&kitti, &kitti.join("poses_tum.txt"));
    assert!(found.n >= 44, "{} of 51 frames were tracked", found.n);
    assert!(found.error < 0.005, "off by {} of the extent", found.error);
    assert!(
        found.within >= 0.8,
        "{} are as sure as they say",
        found.within
    );
}
