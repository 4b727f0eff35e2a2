//! What `splat-mapper render` writes and what intrinsics it takes.

use glam::{DQuat, DVec3};

use crate::hooked::{Hooked, Hooks};
use crate::scenes::scene;
use splat_engine::cpu::engine::CpuEngine;
use splat_mapper::eval::render::{read_intrinsics, render_poses};
use splat_types::camera::Intrinsics;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Renders a ramp that depends on the pose, so that files can be determined apart.
#[derive(Debug, Default)]
struct Ramp;

impl Hooks for Ramp {
    fn render(
        &mut self,
        _: &mut CpuEngine,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid,
        _: u8,
    ) -> Rendering {
        let n = (intrinsics.width_px * intrinsics.height_px) as usize;
        // The camera stands at x = 1, 2, …, so the map's origin lies at -1, -2, … in its frame.
        let step = -cam_from_world.translation.x as f32;
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
        log_scales: vec![[0.0; 3]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]],
        opacity_logits: vec![0.0],
        sh: vec![0.0; 3],
        sh_degree: 0,
        anchors: vec![0],
    };
    let folder = out.path().join("new/folder");
    let n = render_poses(
        &splats,
        &mut Hooked::<Ramp>::default(),
        &[pose(1.0), pose(3.0)],
        &intrinsics,
        &folder,
        true,
    )
    .unwrap();
    assert_eq!(n, 2);
    let image = image::open(folder.join("000001.png")).unwrap().into_rgb8();
    assert_eq!(image.dimensions(), (7, 5));
    let expected: Vec<u8> = (0..105)
        .map(|ix| (ix * 3 - 2).clamp(0, 255) as u8)
        .collect();
    assert_eq!(image.into_raw(), expected);
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
