//! 3D Gaussian Splatting from the points of a COLMAP scene: the whole program on a room that is written as one.

use std::fmt::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use glam::DVec2;
use serde_json::Value;

use crate::scene_points::points_bin;
use splat_io::frame_source::Source as _;
use splat_mapper::params::settings::Settings;
use splat_synth::source::SyntheticSource;
use splat_types::frame::Frame;
use splat_types::sparse_point::SparsePoint;

const ROOM: &str = "room?frames=16&width=128&height=96&speed=3";
/// Every n-th pixel of a depth map is a point: about as many as COLMAP finds in an image of this size.
const STRIDE: usize = 41;
/// A few hundred steps of what the preset spreads over 30,000.
const SHORT: [&str; 8] = [
    "train.steps=300",
    "densify.start=40",
    "densify.every=40",
    "densify.until=200",
    "densify.opacity_reset_every=130",
    "track.enabled=false",
    "map.holdout=5",
    "train.sh_interval=20",
];

/// A synthetic scene as COLMAP leaves one, its points from exact depth. Returns how many points it has.
fn write_as_colmap(root: &Path, scene: &str) -> usize {
    let params = Settings::shipped().params().unwrap().source;
    let mut source = SyntheticSource::open(scene, &params, 0).unwrap();
    let (images, model) = (root.join("images"), root.join("sparse/0"));
    std::fs::create_dir_all(&images).unwrap();
    std::fs::create_dir_all(&model).unwrap();
    let (mut list, mut points) = (String::new(), Vec::new());
    while let Some(frame) = source.next() {
        let name = format!("{:04}.png", frame.seq);
        let (k, image) = (frame.intrinsics.unwrap(), &frame.image);
        let size = (image.width_px, image.height_px);
        image::RgbImage::from_raw(size.0, size.1, image.pixels.clone())
            .unwrap()
            .save(images.join(&name))
            .unwrap();
        let pose = frame.truth.unwrap().inverse();
        let (q, t) = (pose.rotation, pose.translation);
        writeln!(
            list,
            "{} {} {} {} {} {} {} {} 1 {name}\n",
            frame.seq + 1,
            q.w,
            q.x,
            q.y,
            q.z,
            t.x,
            t.y,
            t.z
        )
        .unwrap();
        let camera = format!(
            "1 PINHOLE {} {} {} {} {} {}\n",
            size.0, size.1, k.fx, k.fy, k.cx, k.cy
        );
        std::fs::write(model.join("cameras.txt"), camera).unwrap();
        points.extend(points_of(&frame));
    }
    std::fs::write(model.join("images.txt"), list).unwrap();
    std::fs::write(model.join("points3D.bin"), points_bin(&points)).unwrap();
    points.len()
}

fn points_of(frame: &Frame) -> Vec<SparsePoint> {
    let depth = frame.sensor_depth.as_ref().unwrap();
    let (width, height) = (depth.width_px, depth.height_px);
    let (image, lens) = (&frame.image, frame.intrinsics.unwrap());
    let small = lens.resized(width, height);
    let gt_from_cam = frame.truth.unwrap();
    // Another part of the pixels in each image.
    let first = frame.seq as usize % STRIDE;
    let pixels = (first..depth.depth.len()).step_by(STRIDE);
    pixels
        .filter(|at| depth.depth[*at] > 0.0)
        .map(|at| {
            let (x, y) = (at % width as usize, at / width as usize);
            let ray = small.ray_in_cam(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
            let in_cam = ray * f64::from(depth.depth[at]);
            let pixel = lens.project(in_cam).unwrap();
            let row = (pixel.y as usize).min(image.height_px as usize - 1);
            let column = (pixel.x as usize).min(image.width_px as usize - 1);
            let at = 3 * (row * image.width_px as usize + column);
            SparsePoint {
                position_in_gt: gt_from_cam.transform_point(in_cam),
                rgb: [0, 1, 2].map(|c| image.pixels[at + c]),
                error_px: 0.5,
                n_images: 2,
            }
        })
        .collect()
}

fn replay(scene: &Path, out: &Path, arguments: &[&str], settings: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    command
        .args(["replay", scene.to_str().unwrap()])
        .args(["--out", out.to_str().unwrap()])
        .args(arguments);
    for setting in settings {
        command.args(["--set", setting]);
    }
    command.output().unwrap()
}

fn report(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap()
}

fn last_line(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr);
    text.lines().last().unwrap_or_default().to_owned()
}

/// Splats, PSNR of views that were held out.
fn trained(scene: &Path, backend: &str, more: &[&str]) -> (u64, f64) {
    let out = tempfile::tempdir().unwrap();
    let arguments = [
        "--geometry",
        "ground_truth",
        "--preset",
        "3dgs",
        "--backend",
        backend,
    ];
    let settings: Vec<&str> = SHORT.iter().chain(more).copied().collect();
    let output = replay(scene, out.path(), &arguments, &settings);
    assert!(output.status.success(), "{}", last_line(&output));
    let report = report(out.path());
    let psnr = report["quality"]["psnr_holdout"].as_f64().unwrap();
    (report["splats"].as_u64().unwrap(), psnr)
}

#[test]
fn a_colmap_scene_is_trained_from_its_points() {
    let scene = tempfile::tempdir().unwrap();
    let n_points = write_as_colmap(scene.path(), ROOM) as u64;
    let (n_start, _) = trained(scene.path(), "cpu", &["train.steps=1"]);
    assert!(
        n_start <= n_points && 10 * n_start > 9 * n_points,
        "{n_start} splats of {n_points} points"
    );
    let (n_fixed, fixed) = trained(scene.path(), "cpu", &["densify.enabled=false"]);
    assert_eq!(
        n_fixed, n_start,
        "nothing else adds splats, or removes them"
    );
    let (n_grown, grown) = trained(scene.path(), "cpu", &[]);
    eprintln!(
        "{n_points} points; fixed: {n_fixed} splats {fixed:.2} dB; densified: {n_grown} splats {grown:.2} dB"
    );
    assert!(n_grown > n_start, "{n_grown} splats of {n_start}");
    assert!(fixed > 18.0 && grown > 18.0, "{fixed:.2} and {grown:.2} dB");
}

#[test]
fn densification_on_a_gpu_is_that_on_the_processor() {
    let scene = tempfile::tempdir().unwrap();
    write_as_colmap(scene.path(), ROOM);
    let short = ["train.steps=130"];
    let (n_cpu, cpu) = trained(scene.path(), "cpu", &short);
    let (n_gpu, gpu) = trained(scene.path(), "wgpu", &short);
    eprintln!("cpu: {n_cpu} splats {cpu:.2} dB; wgpu: {n_gpu} splats {gpu:.2} dB");
    // A gradient at the threshold falls to either side by rounding.
    let off = n_cpu.abs_diff(n_gpu) as f64 / n_cpu as f64;
    assert!(off < 0.02, "{n_cpu} and {n_gpu} splats");
    assert!((cpu - gpu).abs() < 0.3, "{cpu:.2} and {gpu:.2} dB");
}

#[test]
fn a_start_from_points_that_cannot_be_says_what_to_do() {
    let scene = tempfile::tempdir().unwrap();
    write_as_colmap(scene.path(), "room?frames=2&width=64&height=48");
    let out = tempfile::tempdir().unwrap();
    let error = |geometry: &str, settings: &[&str]| {
        let output = replay(
            scene.path(),
            out.path(),
            &["--geometry", geometry],
            settings,
        );
        assert!(!output.status.success());
        last_line(&output)
    };
    let other_frame = error("sfm", &["train.start=points"]);
    assert!(
        other_frame.contains("--geometry ground_truth"),
        "{other_frame}"
    );
    std::fs::remove_file(scene.path().join("sparse/0/points3D.bin")).unwrap();
    let none = error("ground_truth", &["train.start=points"]);
    assert!(
        none.contains("points3D") && none.contains("train.start=depth"),
        "{none}"
    );
    std::fs::write(scene.path().join("sparse/0/points3D.bin"), [7; 12]).unwrap();
    let cut = error("ground_truth", &["train.start=points"]);
    assert!(cut.contains("points3D.bin"), "{cut}");
}
