//! What `export` writes: the formats of other programs against their descriptions, and scenes that our own readers read back.

use std::path::Path;

use glam::{Quat, Vec3};
use serde_json::Value;

use crate::formats::random_splats;
use crate::replay::{last_line, program};
use splat_io::scene_formats::scene::Layout;
use splat_mapper::formats::file::{self, SplatFormat};
use splat_mapper::formats::spz::SpzVersion;
use splat_slam::mapper::map_file::checkpoint;
use splat_types::splats::splats::{SH_C0, Splats};

fn written(splats: &Splats, name: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    let format = SplatFormat::of(Path::new(name), SpzVersion::V3).unwrap();
    format.write(splats, &mut bytes).unwrap();
    bytes
}

fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

#[test]
fn names_choose_the_format() {
    let of = |name: &str| SplatFormat::of(Path::new(name), SpzVersion::V4);
    assert_eq!(of("a/map.ply"), Some(SplatFormat::Ply));
    assert_eq!(of("map.compressed.PLY"), Some(SplatFormat::CompressedPly));
    assert_eq!(of("map.spz"), Some(SplatFormat::Spz(SpzVersion::V4)));
    assert_eq!(of("map.glb"), Some(SplatFormat::Glb));
    assert_eq!(of("map.splat"), Some(SplatFormat::Splat));
    for none in ["map.splatmap", "map", ".ply", "map.txt"] {
        assert_eq!(of(none), None, "{none}");
    }
}

#[test]
fn a_splat_file_has_32_bytes_a_splat_and_the_largest_first() {
    let splats = random_splats(50, 2, 7);
    let bytes = written(&splats, "map.splat");
    assert_eq!(bytes.len(), 50 * 32);
    let sizes: Vec<f32> = bytes
        .chunks_exact(32)
        .map(|b| f32_at(b, 12) * f32_at(b, 16) * f32_at(b, 20) * f32::from(b[27]))
        .collect();
    let n_falling = sizes
        .windows(2)
        .filter(|two| two[0] >= 0.9 * two[1])
        .count();
    assert!(
        n_falling >= 47,
        "{n_falling}: opacity is rounded, all else is exact"
    );
    for record in bytes.chunks_exact(32) {
        let mean = [0, 4, 8].map(|at| f32_at(record, at));
        let ix = splats.means.iter().position(|m| *m == mean).unwrap();
        for k in 0..3 {
            let scale = splats.log_scales[ix][k].exp();
            assert!((f32_at(record, 12 + 4 * k) / scale - 1.0).abs() < 1e-5);
            let colour = (0.5 + SH_C0 * splats.sh[27 * ix + k]).clamp(0.0, 1.0);
            assert!((f32::from(record[24 + k]) / 255.0 - colour).abs() < 0.003);
        }
        let [w, x, y, z] = splats.quats[ix];
        let wanted = Quat::from_xyzw(x, y, z, w).normalize();
        let [w, x, y, z] = [28, 29, 30, 31].map(|at| (f32::from(record[at]) - 128.0) / 128.0);
        let found = Quat::from_xyzw(x, y, z, w).normalize();
        assert!(found.dot(wanted).abs() > 0.9995, "{found} {wanted}");
    }
}

/// Decoded as the format's description has it.
#[test]
fn a_compressed_ply_decodes_within_its_steps() {
    let splats = random_splats(600, 1, 8);
    let bytes = written(&splats, "map.compressed.ply");
    let end = bytes
        .windows(11)
        .position(|w| w == b"end_header\n")
        .unwrap()
        + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    for line in [
        "element chunk 3",
        "element vertex 600",
        "element sh 600",
        "property uchar f_rest_8",
    ] {
        assert!(header.contains(line), "{header}");
    }
    let chunks = &bytes[end..];
    let vertices = &chunks[3 * 72..];
    assert_eq!(vertices.len(), 600 * (16 + 9));
    let mut is_found = vec![false; 600];
    for at in 0..600 {
        let chunk = &chunks[at / 256 * 72..][..72];
        let between = |kind: usize, k: usize, share: f32| {
            let (low, high) = (
                f32_at(chunk, 24 * kind + 4 * k),
                f32_at(chunk, 24 * kind + 12 + 4 * k),
            );
            (low + share * (high - low), (high - low) / 1023.0)
        };
        let word = |k: usize| u32_at(vertices, 16 * at + 4 * k);
        let three = |w: u32| {
            [
                (w >> 21) as f32 / 2047.0,
                ((w >> 11) & 1023) as f32 / 1023.0,
                (w & 2047) as f32 / 2047.0,
            ]
        };
        let shares = three(word(0));
        let mean = [0, 1, 2].map(|k| between(0, k, shares[k]));
        let ix = (0..600)
            .find(|ix| (0..3).all(|k| (splats.means[*ix][k] - mean[k].0).abs() <= mean[k].1));
        let ix = ix.unwrap_or_else(|| panic!("no splat lies at {mean:?}"));
        is_found[ix] = true;
        let shares = three(word(2));
        for (k, share) in shares.into_iter().enumerate() {
            let (scale, step) = between(1, k, share);
            assert!((scale - splats.log_scales[ix][k]).abs() <= step + 1e-6);
        }
        let colour = word(3).to_be_bytes();
        for (k, byte) in colour.iter().enumerate().take(3) {
            let (value, step) = between(2, k, f32::from(*byte) / 255.0);
            assert!((value - (0.5 + SH_C0 * splats.sh[12 * ix + k])).abs() <= 3.0 * step + 1e-6);
        }
        assert!((f32::from(colour[3]) / 255.0 - sigmoid(splats.opacity_logits[ix])).abs() < 0.003);
        let rotation = word(1);
        let largest = (rotation >> 30) as usize;
        let mut quat = [0.0_f32; 4];
        for (place, k) in (0..4).rev().filter(|k| *k != largest).enumerate() {
            let part = (rotation >> (10 * place)) & 1023;
            quat[k] = (part as f32 / 1023.0 - 0.5) * std::f32::consts::SQRT_2;
        }
        quat[largest] = (1.0 - quat.iter().map(|v| v * v).sum::<f32>()).sqrt();
        let as_quat = |[w, x, y, z]: [f32; 4]| Quat::from_xyzw(x, y, z, w).normalize();
        let dot = as_quat(quat).dot(as_quat(splats.quats[ix]));
        assert!(dot.abs() > 0.9999, "{dot}");
        let rest = &vertices[600 * 16 + 9 * at..][..9];
        for (place, byte) in rest.iter().enumerate() {
            let (channel, coefficient) = (place / 3, place % 3);
            let value = (f32::from(*byte) / 256.0 - 0.5) * 8.0;
            let wanted = splats.sh[12 * ix + 3 * (coefficient + 1) + channel];
            assert!(
                (value - wanted).abs() <= 0.0321 || wanted.abs() > 3.9,
                "{value} {wanted}"
            );
        }
    }
    assert!(is_found.iter().filter(|f| **f).count() > 590);
}

#[test]
fn a_glb_has_the_attributes_of_the_extension() {
    let splats = random_splats(30, 2, 9);
    let bytes = written(&splats, "map.glb");
    assert_eq!((&bytes[..4], u32_at(&bytes, 4)), (&b"glTF"[..], 2));
    assert_eq!(u32_at(&bytes, 8) as usize, bytes.len());
    let n_json = u32_at(&bytes, 12) as usize;
    let json: Value = serde_json::from_slice(&bytes[20..20 + n_json]).unwrap();
    let binary = &bytes[20 + n_json + 8..];
    assert_eq!(json["extensionsUsed"][0], "KHR_gaussian_splatting");
    let primitive = &json["meshes"][0]["primitives"][0];
    assert_eq!(
        primitive["extensions"]["KHR_gaussian_splatting"]["kernel"],
        "ellipse"
    );
    let attribute = |name: &str, ix: usize, width: usize| -> Vec<f32> {
        let accessor = &json["accessors"][primitive["attributes"][name].as_u64().unwrap() as usize];
        assert_eq!(accessor["count"], 30, "{name}");
        let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let at = view["byteOffset"].as_u64().unwrap() as usize + 4 * width * ix;
        (0..width).map(|k| f32_at(binary, at + 4 * k)).collect()
    };
    let turn = |[x, y, z]: [f32; 3]| [-x, -y, z];
    for ix in 0..30 {
        assert_eq!(attribute("POSITION", ix, 3), turn(splats.means[ix]));
        let xyzw = attribute("KHR_gaussian_splatting:ROTATION", ix, 4);
        let found = Quat::from_xyzw(xyzw[0], xyzw[1], xyzw[2], xyzw[3]);
        assert!((found.length() - 1.0).abs() < 1e-5);
        let [w, x, y, z] = splats.quats[ix];
        let own = Quat::from_xyzw(x, y, z, w).normalize();
        for axis in [Vec3::X, Vec3::Y, Vec3::Z] {
            let wanted = Vec3::from(turn((own * axis).to_array()));
            assert!((found * axis).distance(wanted) < 1e-4);
        }
        let scale = attribute("KHR_gaussian_splatting:SCALE", ix, 3);
        assert!((0..3).all(|k| (scale[k] / splats.log_scales[ix][k].exp() - 1.0).abs() < 1e-5));
        let opacity = attribute("KHR_gaussian_splatting:OPACITY", ix, 1)[0];
        assert!((opacity - sigmoid(splats.opacity_logits[ix])).abs() < 1e-6);
        let base = attribute("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0", ix, 3);
        assert_eq!(base, splats.sh[27 * ix..27 * ix + 3]);
        assert_eq!(
            attribute("KHR_gaussian_splatting:SH_DEGREE_2_COEF_4", ix, 3).len(),
            3
        );
    }
    let none = Splats::default();
    let refused = SplatFormat::Glb.write(&none, &mut Vec::new()).unwrap_err();
    assert!(refused.to_string().contains("no splats"), "{refused}");
}

#[test]
fn the_program_exports_every_format_and_scenes_and_reads_spz_back() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let ran = program(&[
        "replay",
        "synthetic:room?frames=8&width=96&height=72",
        "--out",
        out.to_str().unwrap(),
    ])
    .args([
        "--geometry",
        "ground_truth",
        "--steps",
        "30",
        "--backend",
        "cpu",
        "--holdout",
        "4",
    ])
    .output()
    .unwrap();
    assert!(ran.status.success(), "{}", last_line(&ran));
    let map = out.join("map.splatmap");
    let map = map.to_str().unwrap();
    let export = |arguments: &[&str]| {
        let output = program(&["export"]).args(arguments).output().unwrap();
        (output.status.success(), last_line(&output))
    };
    for name in ["a.spz", "a.glb", "a.splat", "a.compressed.ply"] {
        let (is_done, line) = export(&[map, &path(name)]);
        assert!(is_done, "{line}");
    }
    assert!(export(&[map, &path("b.spz"), "--spz-version", "4"]).0);
    let n = file::read(&out.join("map.ply")).unwrap().len();
    for spz in ["a.spz", "b.spz"] {
        assert!(export(&[&path(spz), &path("back.ply")]).0);
        assert_eq!(
            file::read(Path::new(&path("back.ply"))).unwrap().len(),
            n,
            "{spz}"
        );
    }
    for (arguments, word) in [
        (&[map, "a.obj"][..], ".glb"),
        (&[map, "a.spz", "--spz-version", "7"], "neither 3 nor 4"),
        (&[map, "scene/", "--layout", "blend"], "nerfstudio"),
        (&[&path("a.spz"), &path("scene/")], "splatmap"),
    ] {
        let (is_done, line) = export(arguments);
        assert!(!is_done && line.contains(word), "{arguments:?}: {line}");
    }
    let saved = checkpoint::read(Path::new(map)).unwrap();
    for layout in ["colmap", "nerfstudio"] {
        let scene = path(layout);
        let (is_done, line) = export(&[map, &scene, "--layout", layout]);
        assert!(is_done, "{line}");
        let found = Layout::find(Path::new(&scene)).unwrap();
        let views = found.views(640).unwrap();
        assert_eq!(views.len(), saved.views.len());
        for (view, saved_view) in views.iter().zip(&saved.views) {
            let id = saved_view.keyframe_id;
            let pose = saved
                .snapshot
                .poses
                .iter()
                .find(|p| p.keyframe_id == id)
                .unwrap();
            let (a, b) = (view.gt_from_cam, pose.world_from_cam);
            assert!(a.angle_to(&b) < 1e-6 && a.translation.distance(b.translation) < 1e-6);
            assert_eq!(
                view.is_held_out,
                layout == "nerfstudio" && saved_view.is_held_out
            );
        }
        assert!(found.points().unwrap().len() > 20, "{layout}");
        let (is_done, line) = export(&[map, &scene, "--layout", layout]);
        assert!(!is_done && line.contains("not empty"), "{line}");
    }
}
