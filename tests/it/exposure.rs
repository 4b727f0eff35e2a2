//! Held-out views whose exposure is not that of the map: figures with the exposure that half of each image asks for.

use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::scene_formats::matrix;
use splat_synth::settings::{SceneKind, SynthSettings};
use splat_synth::take::Take;

/// What every second image keeps of its colours.
const DARKENED: f64 = 0.55;
/// The map has about the mean of both, so that either kind is off by a fifth and more of its colours: 19 dB as rendered, 29 dB
/// exposed.
const MARGIN_DB: f64 = 6.0;

/// A walk through the room as a nerfstudio scene with depth, with every second image as it is and the others darkened.
fn write_scene(folder: &Path, n_frames: u32) {
    let settings = SynthSettings {
        n_frames,
        width_px: 160,
        height_px: 120,
        ..SynthSettings::of(SceneKind::Room)
    };
    let take = Take::new(settings).unwrap();
    let lens = take.settings().lens().intrinsics;
    let mut frames = String::new();
    for ix in 0..n_frames {
        let shown = take.image(ix);
        let kept = if ix % 2 == 0 { 1.0 } else { DARKENED };
        let pixels = shown.pixels.iter();
        let pixels = pixels.map(|value| (f64::from(*value) * kept).round() as u8);
        let image = image::RgbImage::from_vec(lens.width_px, lens.height_px, pixels.collect());
        image
            .unwrap()
            .save(folder.join(format!("{ix:03}.png")))
            .unwrap();
        let depth = take.depth(ix, &lens).depth;
        let millimetres = depth.iter().map(|metres| (1000.0 * metres).round() as u16);
        let depth: image::ImageBuffer<image::Luma<u16>, Vec<u16>> =
            image::ImageBuffer::from_vec(lens.width_px, lens.height_px, millimetres.collect())
                .unwrap();
        depth
            .save(folder.join(format!("depth_{ix:03}.png")))
            .unwrap();
        let comma = if ix == 0 { "" } else { "," };
        write!(
            frames,
            r#"{comma}{{"file_path": "{ix:03}.png", "depth_file_path": "depth_{ix:03}.png", "transform_matrix": {}}}"#,
            matrix(&take.pose(ix))
        )
        .unwrap();
    }
    let text = format!(
        r#"{{"w": {}, "h": {}, "fl_x": {}, "fl_y": {}, "cx": {}, "cy": {}, "frames": [{frames}]}}"#,
        lens.width_px, lens.height_px, lens.fx, lens.fy, lens.cx, lens.cy
    );
    std::fs::write(folder.join("transforms.json"), text).unwrap();
}

#[test]
fn images_that_are_darkened_by_turns_are_judged_with_an_exposure_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    write_scene(folder.path(), 24);
    let out = folder.path().join("run");
    let output = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["replay", folder.path().to_str().unwrap()])
        .args(["--out", out.to_str().unwrap()])
        .args(["--geometry", "ground_truth", "--steps", "300"])
        // An odd number, so that held-out views are of both kinds.
        .args(["--holdout", "5", "--set", "select.every_frame=true"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let report = std::fs::read(out.join("report.json")).unwrap();
    let report: Value = serde_json::from_slice(&report).unwrap();
    let figure = |key: &str| report["quality"][key].as_f64().unwrap();
    let (plain, exposed) = (figure("psnr_holdout_half"), figure("psnr_holdout_exposed"));
    eprintln!("{plain:.2} dB as rendered, {exposed:.2} dB exposed");
    assert!(exposed > plain + MARGIN_DB, "{}", report["quality"]);
    let (plain, exposed) = (figure("ssim_holdout_half"), figure("ssim_holdout_exposed"));
    assert!(exposed > plain, "{}", report["quality"]);
}
