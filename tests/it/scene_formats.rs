//! Scenes of other programs (COLMAP, nerfstudio, instant-ngp, Blender) -> frames with poses and lenses.

use std::fmt::Write as _;
use std::path::Path;

use glam::{DMat3, DQuat, DVec3};

use crate::sources::params;
use splat_io::frame_source::SourceCounts;
use splat_io::params::SourceParams;
use splat_io::scene_formats::scene::{Layout, SceneView};
use splat_mapper::node::open_source;
use splat_types::camera::{CameraModel, Distortion};
use splat_types::frame::Frame;
use splat_types::transform::Rigid;

/// Numbers travel as decimals or through two inversions.
const TOLERANCE: f64 = 1e-9;
pub const SIZE: (u32, u32) = (64, 48);

/// A camera of COLMAP: number, name, parameters.
pub struct Camera(pub i32, pub &'static str, pub Vec<f64>);

pub fn pinhole() -> Camera {
    Camera(1, "PINHOLE", vec![50.0, 51.0, 31.0, 25.0])
}

/// Names out of order, with a gap, on purpose.
pub fn poses() -> Vec<(&'static str, Rigid)> {
    let pose = |k: f64| {
        let turn = DQuat::from_scaled_axis(DVec3::new(0.1 * k, -0.2, 0.3 + k));
        Rigid::new(turn, DVec3::new(k, 2.0 - k, 0.5 * k))
    };
    vec![
        ("f10.png", pose(3.0)),
        ("f1.png", pose(1.0)),
        ("f2.png", pose(2.0)),
    ]
}

pub fn test_image(folder: &Path, name: &str, (width, height): (u32, u32)) {
    let path = folder.join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::RgbImage::from_pixel(width, height, image::Rgb([90, 120, 150]))
        .save(path)
        .unwrap();
}

pub fn cameras_bin(camera: &Camera) -> Vec<u8> {
    let mut bytes = 1_u64.to_le_bytes().to_vec();
    bytes.extend(7_i32.to_le_bytes());
    bytes.extend(camera.0.to_le_bytes());
    bytes.extend(u64::from(SIZE.0).to_le_bytes());
    bytes.extend(u64::from(SIZE.1).to_le_bytes());
    bytes.extend(camera.2.iter().flat_map(|p| p.to_le_bytes()));
    bytes
}

pub fn images_bin(poses: &[(&str, Rigid)]) -> Vec<u8> {
    let mut bytes = (poses.len() as u64).to_le_bytes().to_vec();
    for (ix, (name, gt_from_cam)) in (0_i32..).zip(poses) {
        bytes.extend(ix.to_le_bytes());
        let pose = colmap_numbers(gt_from_cam);
        bytes.extend(pose.iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend(7_i32.to_le_bytes());
        bytes.extend(name.as_bytes());
        bytes.push(0);
        bytes.extend(2_u64.to_le_bytes());
        bytes.extend([0x5a; 48]);
    }
    bytes
}

fn colmap_numbers(gt_from_cam: &Rigid) -> [f64; 7] {
    let pose = gt_from_cam.inverse();
    let (q, t) = (pose.rotation, pose.translation);
    [q.w, q.x, q.y, q.z, t.x, t.y, t.z]
}

/// A COLMAP scene with all its images.
pub fn colmap(root: &Path, camera: &Camera) {
    let model = root.join("sparse/0");
    std::fs::create_dir_all(&model).unwrap();
    std::fs::write(model.join("cameras.bin"), cameras_bin(camera)).unwrap();
    std::fs::write(model.join("images.bin"), images_bin(&poses())).unwrap();
    for (name, _) in poses() {
        test_image(&root.join("images"), name, SIZE);
    }
}

fn colmap_text(root: &Path) {
    std::fs::create_dir_all(root).unwrap();
    let cameras = "# Camera list\n7 PINHOLE 64 48 50 51 31 25\n";
    std::fs::write(root.join("cameras.txt"), cameras).unwrap();
    let mut images = "# Image list\n# two lines each\n".to_owned();
    for (ix, (name, pose)) in poses().iter().enumerate() {
        let numbers = colmap_numbers(pose).map(|v| v.to_string()).join(" ");
        // The second image saw no points: its line is empty.
        let points = if ix == 1 { "" } else { "1.5 2.5 -1 3 4 17" };
        writeln!(images, "{ix} {numbers} 7 {name}\n{points}").unwrap();
    }
    std::fs::write(root.join("images.txt"), images).unwrap();
    for (name, _) in poses() {
        test_image(&root.join("images"), name, SIZE);
    }
}

/// One frame's matrix, with OpenGL axes.
pub fn matrix(gt_from_cam: &Rigid) -> String {
    let gl = DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z);
    let r = (gt_from_cam.rotation_matrix() * gl).to_cols_array_2d();
    let t = gt_from_cam.translation;
    let row = |i: usize, t: f64| format!("[{}, {}, {}, {t}]", r[0][i], r[1][i], r[2][i]);
    format!(
        "[{}, {}, {}, [0, 0, 0, 1]]",
        row(0, t.x),
        row(1, t.y),
        row(2, t.z)
    )
}

pub fn transforms(keys: &str, name_of: impl Fn(&str) -> String) -> String {
    let frame = |(name, pose): &(&str, Rigid)| {
        format!(
            r#"{{"file_path": "{}", "transform_matrix": {}}}"#,
            name_of(name),
            matrix(pose)
        )
    };
    let frames: Vec<String> = poses().iter().map(frame).collect();
    format!(r#"{{{keys}, "frames": [{}]}}"#, frames.join(",\n"))
}

fn frames_of(path: &Path, params: &SourceParams) -> (Vec<Frame>, SourceCounts) {
    let uri = format!("images:{}", path.display());
    let mut source = open_source::open(&uri, params, 0).unwrap();
    let frames = std::iter::from_fn(|| source.next()).collect();
    (frames, source.counts())
}

fn check_near(found: &Rigid, expected: &Rigid) {
    let near = found.translation.distance(expected.translation) < TOLERANCE
        && found.angle_to(expected) < TOLERANCE;
    assert!(near, "{found:?}, expected {expected:?}");
}

fn check_scene(path: &Path) {
    let (frames, counts) = frames_of(path, &params());
    assert_eq!(
        (frames.len(), counts.undecodable),
        (3, 0),
        "{}",
        path.display()
    );
    for (ix, k) in [1, 2, 0].into_iter().enumerate() {
        let frame = &frames[ix];
        assert_eq!(frame.stamp.nanos, ix as i64 * 100_000_000);
        check_near(&frame.truth.unwrap(), &poses()[k].1);
        let i = frame.intrinsics.unwrap();
        assert_eq!((i.fx, i.fy, i.cx, i.cy), (50.0, 51.0, 31.0, 25.0));
        assert_eq!((i.width_px, i.height_px), SIZE);
    }
}

fn views_of(path: &Path) -> Vec<SceneView> {
    Layout::find(path).unwrap().views(640).unwrap()
}

fn lens_of(camera: &Camera) -> Result<CameraModel, String> {
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), camera);
    let views = Layout::find(root.path()).unwrap().views(640);
    views.map(|v| v[0].lens.unwrap()).map_err(|e| e.to_string())
}

#[test]
fn binary_and_text_models_and_transforms_give_the_same_frames() {
    let root = tempfile::tempdir().unwrap();
    colmap(&root.path().join("binary"), &pinhole());
    check_scene(&root.path().join("binary"));
    check_scene(&root.path().join("binary/sparse/0"));
    colmap_text(&root.path().join("text"));
    check_scene(&root.path().join("text"));
    let camera = r#""fl_x": 50, "fl_y": 51, "cx": 31, "cy": 25, "w": 64, "h": 48.0"#;
    let ngp = root.path().join("ngp");
    for (name, _) in poses() {
        test_image(&ngp.join("images"), name, SIZE);
    }
    std::fs::write(
        ngp.join("transforms.json"),
        transforms(camera, |name| {
            format!("./images/{}", name.trim_end_matches(".png"))
        }),
    )
    .unwrap();
    check_scene(&ngp);
    check_scene(&ngp.join("transforms.json"));
}

#[test]
fn every_camera_model_becomes_its_lens_and_unknown_ones_an_error() {
    let k = [0.1, -0.02, 0.003, 0.004, 0.05, 0.06, 0.07, 0.08];
    let full = |n: usize| [&[50.0, 51.0, 31.0, 25.0], &k[..n]].concat();
    let simple = |n: usize| [&[50.0, 31.0, 25.0], &k[..n]].concat();
    let check = |camera: Camera, fy: f64, distortion: Distortion| {
        let lens = lens_of(&camera).unwrap();
        let i = lens.intrinsics;
        assert_eq!(
            (i.fx, i.fy, i.cx, i.cy),
            (50.0, fy, 31.0, 25.0),
            "{}",
            camera.1
        );
        assert_eq!(lens.distortion, distortion, "{}", camera.1);
    };
    check(
        Camera(0, "SIMPLE_PINHOLE", simple(0)),
        50.0,
        Distortion::None,
    );
    let radial = |k1, k2| Distortion::PlumbBob([k1, k2, 0.0, 0.0, 0.0]);
    check(
        Camera(2, "SIMPLE_RADIAL", simple(1)),
        50.0,
        radial(0.1, 0.0),
    );
    check(Camera(3, "RADIAL", simple(2)), 50.0, radial(0.1, -0.02));
    let opencv = Distortion::PlumbBob([0.1, -0.02, 0.003, 0.004, 0.0]);
    check(Camera(4, "OPENCV", full(4)), 51.0, opencv);
    let fisheye = Distortion::Equidistant([0.1, -0.02, 0.003, 0.004]);
    check(Camera(5, "OPENCV_FISHEYE", full(4)), 51.0, fisheye);
    check(
        Camera(6, "FULL_OPENCV", full(8)),
        51.0,
        Distortion::Rational(k),
    );
    let fov = lens_of(&Camera(7, "FOV", full(1))).unwrap_err();
    assert!(
        fov.contains("FOV") && fov.contains("image_undistorter"),
        "{fov}"
    );
    let unknown = lens_of(&Camera(77, "?", full(0))).unwrap_err();
    assert!(unknown.contains("unknown model 77"), "{unknown}");
}

#[test]
fn the_smallest_folder_that_is_large_enough_is_read_and_intrinsics_follow() {
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), &pinhole());
    for (name, _) in poses() {
        // The smaller copies have another extension, as some tools leave them.
        let name = name.replace("png", "JPG");
        test_image(&root.path().join("images_2"), &name, (32, 24));
        test_image(&root.path().join("images_4"), &name, (16, 12));
    }
    let check = |max_side: u32, folder: &str, width: u32| {
        let params = SourceParams {
            max_side,
            ..params()
        };
        let views = Layout::find(root.path()).unwrap().views(max_side).unwrap();
        assert!(
            views[0].image.starts_with(root.path().join(folder)),
            "{:?}",
            views[0]
        );
        let (frames, _) = frames_of(root.path(), &params);
        let i = frames[0].intrinsics.unwrap();
        assert_eq!(i.width_px, width);
        assert!((i.fx - 50.0 * f64::from(width) / 64.0).abs() < TOLERANCE);
    };
    check(640, "images", 64);
    check(33, "images", 33);
    check(32, "images_2", 32);
}

#[test]
fn missing_images_are_counted_and_keep_their_place() {
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), &pinhole());
    std::fs::remove_file(root.path().join("images/f2.png")).unwrap();
    let (frames, counts) = frames_of(root.path(), &params());
    assert_eq!((frames.len(), counts.undecodable), (2, 1));
    assert_eq!(frames[1].stamp.nanos, 200_000_000);
    assert_eq!(views_of(root.path()).len(), 3, "eval still has the pose");
    for name in ["f1.png", "f10.png"] {
        std::fs::remove_file(root.path().join("images").join(name)).unwrap();
    }
    let uri = format!("images:{}", root.path().display());
    let error = open_source::open(&uri, &params(), 0)
        .err()
        .unwrap()
        .to_string();
    assert!(error.contains("none of its 3 images"), "{error}");
}

#[test]
fn names_choose_the_views_and_those_held_out() {
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), &pinhole());
    let params = SourceParams {
        include_prefixes: "f1".to_owned(),
        holdout_prefixes: "f10".to_owned(),
        ..params()
    };
    let (frames, _) = frames_of(root.path(), &params);
    let seen: Vec<(i64, bool)> = frames
        .iter()
        .map(|f| (f.stamp.nanos, f.is_held_out))
        .collect();
    let two = SourceParams {
        subsample: 2,
        ..crate::sources::params()
    };
    let stamps = |(frames, _): (Vec<Frame>, SourceCounts)| -> Vec<i64> {
        frames.iter().map(|f| f.stamp.nanos).collect()
    };
    let drawn = stamps(frames_of(root.path(), &two));
    assert_eq!(drawn.len(), 2);
    assert_eq!(
        drawn,
        stamps(frames_of(root.path(), &two)),
        "the seed draws"
    );
    assert_eq!(
        seen,
        [(0, false), (200_000_000, true)],
        "stamps are those of the whole scene"
    );
}

#[test]
fn blender_scenes_hold_out_their_test_views_and_take_the_size_from_a_image() {
    let root = tempfile::tempdir().unwrap();
    for (file, folder) in [
        ("transforms_train.json", "train"),
        ("transforms_test.json", "test"),
    ] {
        for (name, _) in poses() {
            test_image(&root.path().join(folder), name, SIZE);
        }
        let name_of = |name: &str| format!("./{folder}/{}", name.trim_end_matches(".png"));
        let text = transforms(r#""camera_angle_x": 1.2"#, name_of);
        std::fs::write(root.path().join(file), text).unwrap();
    }
    let (frames, _) = frames_of(root.path(), &params());
    let held_out: Vec<bool> = frames.iter().map(|f| f.is_held_out).collect();
    assert_eq!(held_out, [true, true, true, false, false, false]);
    let i = frames[0].intrinsics.unwrap();
    let focal = 32.0 / 0.6_f64.tan();
    assert!((i.fx - focal).abs() < TOLERANCE && (i.fy - focal).abs() < TOLERANCE);
    assert_eq!((i.cx, i.cy), (32.0, 24.0));
}

#[test]
fn nerfstudio_keys_give_lens_depth_and_the_world_before_its_turn() {
    let root = tempfile::tempdir().unwrap();
    for (name, _) in poses() {
        test_image(&root.path().join("images"), name, SIZE);
    }
    image::ImageBuffer::from_pixel(8, 6, image::Luma([1500_u16]))
        .save(root.path().join("depth.png"))
        .unwrap();
    let keys = r#""w": 64, "h": 48, "fl_x": 60, "camera_model": "OPENCV_FISHEYE", "k1": 0.1,
        "applied_transform": [[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]]"#;
    let text = transforms(keys, |name| format!("images/{name}")).replacen(
        r#""transform_matrix""#,
        r#""fl_x": 55, "depth_file_path": "depth.png", "transform_matrix""#,
        1,
    );
    std::fs::write(root.path().join("transforms.json"), text).unwrap();
    let views = views_of(root.path());
    let lenses: Vec<CameraModel> = views.iter().map(|v| v.lens.unwrap()).collect();
    assert_eq!(
        lenses[2].intrinsics.fx, 55.0,
        "a frame's own key goes first"
    );
    assert_eq!(lenses[0].intrinsics.fx, 60.0);
    assert_eq!(
        lenses[0].distortion,
        Distortion::Equidistant([0.1, 0.0, 0.0, 0.0])
    );
    let t = poses()[1].1.translation - DVec3::new(5.0, 0.0, 0.0);
    let undone = DVec3::new(t.x, -t.z, t.y);
    assert!(views[0].gt_from_cam.translation.distance(undone) < TOLERANCE);
    let (frames, _) = frames_of(root.path(), &params());
    let depth = frames[2].sensor_depth.as_ref().unwrap();
    assert!(depth.depth.iter().all(|d| (d - 1.5).abs() < 1e-6));
    assert!(frames[0].sensor_depth.is_none());
}
