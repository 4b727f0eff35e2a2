//! Metres of a map that knows none, by odometry, depth images, a measured distance.

use std::path::Path;

use splat_io::params::SourceParams;
use splat_mapper::node::open_source::open;
use splat_mapper::params::settings::Settings;
use splat_synth::record::write_recording;
use splat_synth::settings::{SceneKind, SynthSettings};
use splat_types::snapshot::{Scale, ScaleSource};

/// Asked for, with odometry of 1 % noise.
const MAX_SCALE_ERROR: f64 = 0.02;

fn take() -> SynthSettings {
    SynthSettings {
        n_frames: 48,
        width_px: 320,
        height_px: 240,
        speed: 2.0,
        odometry: Some(0.01),
        ..SynthSettings::of(SceneKind::Room)
    }
}

/// (what a replay reports of scale, metres of one unit by the true poses).
fn replayed(bag: &Path, out: &Path, sets: &[&str]) -> (serde_json::Value, f64) {
    let run = |args: &[&str]| {
        let output = crate::localise::run(args);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{args:?}: {said}");
        String::from_utf8(output.stdout).unwrap()
    };
    let (bag, out) = (bag.to_str().unwrap(), out.to_str().unwrap());
    let mut args = vec![
        "replay",
        bag,
        "--out",
        out,
        "--geometry",
        "sfm",
        "--steps",
        "1",
    ];
    sets.iter().for_each(|set| args.extend(["--set", set]));
    run(&args);
    let report = std::fs::read_to_string(format!("{out}/report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let tum = Path::new(bag).with_extension("tum");
    let evaluation = run(&["eval", out, "--reference", tum.to_str().unwrap(), "--json"]);
    let evaluation: serde_json::Value = serde_json::from_str(&evaluation).unwrap();
    (
        report["scale"].clone(),
        evaluation["aligned_scale"].as_f64().unwrap(),
    )
}

#[test]
fn a_recording_with_odometry_or_depth_has_a_map_in_metres() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("wheels.mcap");
    write_recording(&take(), &bag).unwrap();
    let frames = {
        let mut source = open(bag.to_str().unwrap(), &source_params(), 0).unwrap();
        std::iter::from_fn(|| source.next()).collect::<Vec<_>>()
    };
    assert_eq!(frames.len(), 48);
    for pair in frames.windows(2) {
        let step = |of: fn(&splat_types::frame::Frame) -> splat_types::transform::Rigid| {
            (of(&pair[0]).inverse() * of(&pair[1])).translation.length()
        };
        let (wheels, exact) = (step(|f| f.odometry.unwrap()), step(|f| f.truth.unwrap()));
        assert!((wheels - exact).abs() < 0.1 * exact, "{wheels} {exact}");
    }
    for (known, source) in [
        ("odometry", "odometry"),
        ("depth", "depth"),
        ("off", "up_to_scale"),
    ] {
        let out = folder.path().join(known);
        let (scale, exact) = replayed(&bag, &out, &[&format!("scale.source={known}")]);
        assert_eq!(scale["source"], source);
        let Some(metres) = scale["metres_per_unit"].as_f64() else {
            assert_eq!(known, "off");
            continue;
        };
        let (off, std) = ((metres / exact - 1.0).abs(), scale["std"].as_f64().unwrap());
        eprintln!("{known}: {metres:.4} +- {std:.4} m a unit, {exact:.4} by the true poses");
        assert!(off < MAX_SCALE_ERROR, "{known}: {metres} for {exact}");
        assert!(
            std > 0.0 && off < 4.0 * std / metres,
            "{known}: {off} {std}"
        );
    }
    // The distance between the first and a later keyframe, measured.
    let out = folder.path().join("baseline");
    let metres =
        (frames[20].truth.unwrap().translation - frames[0].truth.unwrap().translation).length();
    let sets = [
        "scale.source=baseline",
        &format!("scale.baseline={metres}"),
        "scale.baseline_to=2",
    ];
    let (scale, exact) = replayed(&bag, &out, &sets);
    assert_eq!(scale["source"], "baseline");
    let found = scale["metres_per_unit"].as_f64().unwrap();
    assert!((found / exact - 1.0).abs() < 0.1, "{found} for {exact}");
}

fn source_params() -> SourceParams {
    Settings::shipped().params().unwrap().source
}

#[test]
fn scale_survives_files_and_messages_or_is_refused() {
    let scale = Scale {
        source: ScaleSource::Odometry,
        metres_per_unit: Some(1.25),
        std: Some(0.01),
    };
    for kept in [scale, Scale::GIVEN, Scale::UP_TO_SCALE] {
        assert_eq!(Scale::of_numbers(kept.to_numbers()), Some(kept));
    }
    for bad in [
        (8, 1.0, 0.0),
        (2, f64::NAN, 0.0),
        (2, -1.0, 0.0),
        (2, 1.0, f64::INFINITY),
    ] {
        assert_eq!(Scale::of_numbers(bad), None);
    }
}
