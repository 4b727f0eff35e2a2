//! Scenes of other programs that are cut off, lie about their lengths or hold the wrong types: errors, never a panic,
//! and no memory beyond the bytes at hand.

use std::path::Path;

use crate::declared_lengths::in_little_memory;
use crate::scene_formats::{Camera, cameras_bin, colmap, images_bin, pinhole, poses, transforms};
use splat_io::scene_formats::scene::Layout;

/// Every n-th length of a cut file is tried.
const STRIDE: usize = 7;

fn error_of(root: &Path) -> Option<String> {
    let layout = Layout::find(root)?;
    layout.views(640).err().map(|e| e.to_string())
}

#[test]
fn cut_models_are_errors_that_name_the_file() {
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), &pinhole());
    let model = root.path().join("sparse/0");
    for (name, whole) in [
        ("cameras.bin", cameras_bin(&pinhole())),
        ("images.bin", images_bin(&poses())),
    ] {
        for length in (0..whole.len()).step_by(STRIDE) {
            std::fs::write(model.join(name), &whole[..length]).unwrap();
            let error = error_of(root.path()).unwrap_or_else(|| panic!("{name} cut to {length}"));
            assert!(
                error.contains(name) && error.lines().count() == 1,
                "{error}"
            );
        }
        std::fs::write(model.join(name), &whole).unwrap();
    }
    // Views need no points: whatever stands here is left alone.
    std::fs::write(model.join("points3D.bin"), [0xff; 8]).unwrap();
    assert_eq!(error_of(root.path()), None);
}

#[test]
fn declared_counts_take_no_memory() {
    in_little_memory("hostile_scenes::declared_counts_take_no_memory", || {
        let root = tempfile::tempdir().unwrap();
        colmap(root.path(), &pinhole());
        let model = root.path().join("sparse/0");
        let huge = 1_000_000_000_000_000_000_u64.to_le_bytes();
        let mut cameras = cameras_bin(&pinhole());
        cameras[..8].copy_from_slice(&huge);
        std::fs::write(model.join("cameras.bin"), &cameras).unwrap();
        assert!(error_of(root.path()).unwrap().contains("cameras"));
        std::fs::write(model.join("cameras.bin"), cameras_bin(&pinhole())).unwrap();
        let whole = images_bin(&poses());
        // Of the images, and of the points of the first one.
        let n_points = 8 + 4 + 56 + 4 + "f10.png".len() + 1;
        for at in [0, n_points] {
            let mut images = whole.clone();
            images[at..at + 8].copy_from_slice(&huge);
            std::fs::write(model.join("images.bin"), &images).unwrap();
            assert!(error_of(root.path()).is_some());
        }
        let mut images = whole[..n_points - 8].to_vec();
        images.extend(vec![b'a'; 1 << 20]);
        std::fs::write(model.join("images.bin"), &images).unwrap();
        assert!(error_of(root.path()).unwrap().contains("name without end"));
        let nested = "[".repeat(1 << 20);
        std::fs::write(root.path().join("transforms.json"), nested).unwrap();
        assert!(error_of(root.path()).is_some());
    });
}

#[test]
fn numbers_that_no_camera_has_are_refused() {
    let check = |camera: Camera| {
        let root = tempfile::tempdir().unwrap();
        colmap(root.path(), &camera);
        let error = error_of(root.path()).unwrap();
        assert!(error.contains("camera 7"), "{error}");
    };
    check(Camera(1, "PINHOLE", vec![f64::NAN, 51.0, 31.0, 25.0]));
    check(Camera(1, "PINHOLE", vec![50.0, -51.0, 31.0, 25.0]));
    check(Camera(1, "PINHOLE", vec![50.0, 51.0, f64::INFINITY, 25.0]));
    check(Camera(
        4,
        "OPENCV",
        vec![50.0, 51.0, 31.0, 25.0, f64::NAN, 0.0, 0.0, 0.0],
    ));
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), &pinhole());
    for number in [f64::NAN, f64::INFINITY] {
        let mut bad = poses();
        bad[1].1.translation.x = number;
        std::fs::write(root.path().join("sparse/0/images.bin"), images_bin(&bad)).unwrap();
        assert!(error_of(root.path()).unwrap().contains("image 1"));
    }
    let mut images = images_bin(&poses());
    images[12..44].fill(0);
    std::fs::write(root.path().join("sparse/0/images.bin"), images).unwrap();
    assert!(
        error_of(root.path()).unwrap().contains("the pose 0"),
        "a quaternion of zeros"
    );
}

#[test]
fn transforms_of_wrong_types_are_errors_that_say_where() {
    let good = r#""fl_x": 50, "w": 64, "h": 48"#;
    let whole = transforms(good, str::to_owned);
    let check = |text: &str, word: &str| {
        let root = tempfile::tempdir().unwrap();
        std::fs::write(root.path().join("transforms.json"), text).unwrap();
        let error = error_of(root.path()).unwrap_or_else(|| panic!("{text}"));
        assert!(
            error.contains(word) && error.lines().count() == 1,
            "{error}"
        );
    };
    for length in (0..whole.len()).step_by(STRIDE) {
        check(&whole[..length], "transforms.json");
    }
    check("[]", "transforms.json");
    check(r#"{"frames": 7}"#, "expected a sequence");
    check(r#"{"frames": [{"file_path": 7}]}"#, "expected a string");
    check(&whole.replace(": 50", ": \"wide\""), "expected f64");
    check(&whole.replace(": 50", ": -50"), "fl_x -50");
    check(&whole.replace(": 50", ": 1e999"), "number out of range");
    check(&whole.replace(": 64", ": 1e18"), "px");
    let zero = "[[0,0,0,0],[0,0,0,0],[0,0,0,0]]";
    let frames = |matrix: &str| {
        format!(r#"{{{good}, "frames": [{{"file_path": "a", "transform_matrix": {matrix}}}]}}"#)
    };
    check(&frames(zero), "no turn and shift");
    check(
        &frames("[[1,0,0,0],[0,1,0,0],[0,0,-1,0]]"),
        "no turn and shift",
    );
    check(
        &frames("[[1,0,0,1e400],[0,1,0,0],[0,0,1,0]]"),
        "out of range",
    );
    check(&frames("[]"), "no turn and shift");
    check(&frames("{}"), "expected a sequence");
}

#[test]
fn names_do_not_lead_out_of_the_scene() {
    let outer = tempfile::tempdir().unwrap();
    let root = outer.path().join("scene");
    std::fs::create_dir(&root).unwrap();
    crate::scene_formats::test_image(outer.path(), "secret.png", (8, 8));
    let secret = outer.path().join("secret.png");
    for name in [
        "../secret.png",
        "images/../../secret.png",
        secret.to_str().unwrap(),
    ] {
        let text = transforms(r#""fl_x": 50, "w": 64, "h": 48"#, |_| name.to_owned());
        std::fs::write(root.join("transforms.json"), text).unwrap();
        let views = Layout::find(&root).unwrap().views(640).unwrap();
        assert!(
            views
                .iter()
                .all(|v| v.image.starts_with(&root) && !v.image.is_file())
        );
    }
}
