//! `report.json` and `report.html`: the promised keys, and a page that is whole, safe and alone.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use serde_json::Value;
use splat_mapper::clock::Stamp;
use splat_mapper::config::Settings;
use splat_mapper::eval::comparisons::Comparison;
use splat_mapper::eval::html::{ReportInputs, write_html};
use splat_mapper::eval::image_metrics::psnr;
use splat_mapper::eval::report::{
    FrameCounts, KeyframeCounts, Latency, Quality, Report, Scale, Timing,
};
use splat_mapper::eval::trajectory::TimedPose;
use splat_mapper::frame::RgbImage;
use splat_mapper::map::snapshot::ScaleSource;
use splat_mapper::pose::{Rigid, Similarity};
use splat_mapper::splat::Rendering;

/// Scripts outside depend on these; a line may be added, none removed.
const KEYS: &str = "\
adapter
error
frames.dropped
frames.out_of_order
frames.received
frames.undecodable
geometry_note
keyframes.components
keyframes.registered
keyframes.selected
latency_ms.keyframe_to_pose_p50
latency_ms.keyframe_to_pose_p95
latency_ms.keyframe_to_snapshot_p50
latency_ms.keyframe_to_snapshot_p95
map_sha256
parameters.map.steps
peak_gpu_mib
peak_rss_mib
quality.holdout_every
quality.lpips_holdout
quality.psnr_holdout
quality.psnr_train
quality.ssim_holdout
scale.metres_per_unit
scale.source
scale.std
seed
source_fault
splats
steps
steps_per_s
timing_s.decode
timing_s.geometry
timing_s.optimise
timing_s.wall
version";

fn sample_report() -> Report {
    let mut settings = Settings::shipped();
    settings.merge_setting("map.steps=1200").unwrap();
    Report {
        version: "0.1.0".to_owned(),
        frames: FrameCounts {
            received: 50,
            dropped: 0,
            undecodable: 1,
            out_of_order: 0,
        },
        keyframes: KeyframeCounts {
            selected: 38,
            registered: 37,
            components: 1,
        },
        splats: 58_312,
        steps: 1200,
        adapter: "cpu (2 threads, avx2)".to_owned(),
        seed: 7,
        map_sha256: "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad".to_owned(),
        timing_s: Timing {
            wall: 148.2,
            decode: 1.9,
            geometry: 61.4,
            optimise: 96.0,
        },
        steps_per_s: Some(12.5),
        latency_ms: Latency::of(&[0.81, 0.9, 1.7], &[2.1, 2.4, 4.0]),
        peak_rss_mib: Some(731.4),
        peak_gpu_mib: None,
        quality: Quality {
            holdout_every: 8,
            psnr_train: Some(26.31),
            psnr_holdout: Some(23.87),
            ssim_holdout: Some(0.791),
            lpips_holdout: None,
        },
        scale: Scale::of(ScaleSource::UpToScale),
        source_fault: None,
        geometry_note: Some(
            "keyframe 21 shares too few features with its neighbours (motion blur)".to_owned(),
        ),
        error: None,
        parameters: settings
            .entries()
            .map(|(key, value)| (key.to_owned(), value.clone()))
            .collect(),
    }
}

fn keys_of(prefix: &str, value: &Value, keys: &mut Vec<String>) {
    match value {
        Value::Object(entries) => {
            for (name, value) in entries {
                let key = if prefix.is_empty() {
                    name.clone()
                } else {
                    format!("{prefix}.{name}")
                };
                keys_of(&key, value, keys);
            }
        }
        _ => keys.push(prefix.to_owned()),
    }
}

#[test]
fn report_json_has_exactly_the_promised_keys() {
    let report = Report {
        parameters: BTreeMap::from([("map.steps".to_owned(), Value::from(5))]),
        ..sample_report()
    };
    let mut keys = Vec::new();
    keys_of("", &serde_json::to_value(report).unwrap(), &mut keys);
    keys.sort();
    assert_eq!(keys.join("\n"), KEYS);
}

#[test]
fn a_report_survives_its_file_and_numbers_without_value_become_null() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report.json");
    let mut report = sample_report();
    report.write(&path).unwrap();
    assert_eq!(Report::read(&path).unwrap(), report);

    report.timing_s.decode = f64::NAN;
    report.quality.psnr_train = Some(f64::INFINITY);
    report.write(&path).unwrap();
    let json: Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    assert!(json["timing_s"]["decode"].is_null() && json["quality"]["psnr_train"].is_null());
    let read = Report::read(&path).unwrap();
    assert!(read.timing_s.decode.is_nan() && read.timing_s.wall == 148.2);
    assert_eq!(read.quality.psnr_train, None);
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        1,
        "no partial file stays"
    );
}

#[test]
fn a_report_of_an_older_or_newer_program_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report.json");
    let mut json = serde_json::to_value(sample_report()).unwrap();
    let object = json.as_object_mut().unwrap();
    for grown in [
        "version",
        "source_fault",
        "geometry_note",
        "error",
        "parameters",
    ] {
        object.remove(grown);
    }
    object.insert("from_the_future".to_owned(), Value::from(1));
    std::fs::write(&path, json.to_string()).unwrap();
    assert_eq!(Report::read(&path).unwrap().splats, 58_312);
    std::fs::write(&path, "{\"splats\": \"many\"}").unwrap();
    assert!(
        Report::read(&path)
            .unwrap_err()
            .to_string()
            .contains("report.json")
    );
}

#[test]
fn a_report_that_cannot_be_written_leaves_the_old_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report.json");
    std::fs::write(&path, "old").unwrap();
    // A folder in the way of the temporary file stands for a full disk.
    std::fs::create_dir(folder.path().join("report.json.partial")).unwrap();
    let message = sample_report().write(&path).unwrap_err().to_string();
    assert!(
        message.starts_with("cannot write the report") && message.ends_with("report.json"),
        "{message}"
    );
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "old");
}

/// A checkered hill under a sky, seen from a little higher with each `ix`; `soft` stands for the map's blur.
fn picture(width_px: u32, height_px: u32, ix: usize, soft: f64) -> Rendering {
    let (mut rgb, mut depth) = (Vec::new(), Vec::new());
    for row in 0..height_px {
        for col in 0..width_px {
            let (x, y) = (
                f64::from(col) / f64::from(width_px),
                f64::from(row) / f64::from(height_px),
            );
            let hill = 0.35 + 0.08 * (TAU * (x + 0.09 * ix as f64)).sin();
            if y < hill {
                rgb.extend([0.45 + 0.3 * y, 0.62 + 0.3 * y, 0.9].map(|v| v as f32));
                depth.push(0.0);
                continue;
            }
            let z = 0.6 / (y - hill + 0.12);
            let wave = ((x - 0.5) * z * 14.0).sin() * ((z + 0.2 * ix as f64) * 9.0).sin();
            let check = 0.5 + 0.5 * (wave / (0.02 + soft)).tanh();
            rgb.extend(
                [0.25 + 0.5 * check, 0.2 + 0.3 * check * y, 0.12 + 0.1 * y].map(|v| v as f32),
            );
            depth.push(z as f32);
        }
    }
    let alpha = depth
        .iter()
        .map(|z| if *z > 0.0 { 1.0 } else { 0.0 })
        .collect();
    Rendering {
        width_px,
        height_px,
        rgb,
        alpha,
        depth,
    }
}

fn comparison(keyframe_id: u32, width_px: u32, height_px: u32) -> Comparison {
    let sharp = picture(width_px, height_px, keyframe_id as usize, 0.0);
    let pixels = sharp
        .rgb
        .iter()
        .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
        .collect();
    let photo = RgbImage {
        width_px,
        height_px,
        pixels,
    };
    let rendering = picture(
        width_px,
        height_px,
        keyframe_id as usize,
        0.3 + 0.02 * f64::from(keyframe_id),
    );
    let psnr = psnr(&rendering.rgb, &photo);
    Comparison {
        keyframe_id,
        held_out: keyframe_id % 8 == 4,
        photo: Arc::new(photo),
        rendering,
        psnr,
    }
}

/// A walk round an object, as `map_from_cam`.
fn walk(n: usize, wobble: f64) -> Vec<TimedPose> {
    (0..n)
        .map(|ix| {
            let angle = 5.2 * ix as f64 / n as f64;
            let off = wobble * (7.0 * angle).sin();
            let place = DVec3::new(
                2.0 * angle.sin() + off,
                -0.3 * angle.cos() + off,
                3.0 - 3.0 * angle.cos(),
            );
            TimedPose {
                stamp: Stamp::from_secs(0.1 * ix as f64),
                pose: Rigid::new(DQuat::from_rotation_y(-angle), place),
            }
        })
        .collect()
}

/// Writes the page of a sample run. `cargo test` keeps nothing; to look at it set KEEP_REPORT to a file.
fn write_sample(report: &Report, title: &str, comparisons: &[Comparison], path: &Path) -> String {
    let keyframes = walk(37, 0.03);
    let turn = Similarity {
        scale: 0.4,
        rotation: DQuat::from_rotation_x(1.0),
        translation: DVec3::new(5.0, -2.0, 9.0),
    };
    let reference: Vec<TimedPose> = walk(37, 0.0)
        .iter()
        .map(|timed| TimedPose {
            pose: turn.transform_pose(&timed.pose),
            ..*timed
        })
        .collect();
    let noise = |step: u64| (step as f64 * 0.618).fract() - 0.5;
    let loss: Vec<(u64, f64)> = (0..120)
        .map(|ix| 10 * ix)
        .map(|step| {
            (
                step,
                0.04 + 0.22 * (-(step as f64) / 220.0).exp() * (1.0 + 0.3 * noise(step)),
            )
        })
        .collect();
    let psnr: Vec<(u64, f64)> = (0..25)
        .map(|ix| 50 * ix)
        .map(|step| {
            (
                step,
                25.0 - 12.0 * (-(step as f64) / 300.0).exp() + noise(step),
            )
        })
        .collect();
    let inputs = ReportInputs {
        title,
        report,
        comparisons,
        loss: &loss,
        psnr: &psnr,
        keyframes: &keyframes,
        trajectory: &walk(200, 0.02),
        reference: &reference,
    };
    write_html(&inputs, path).unwrap();
    if let Some(keep) = std::env::var_os("KEEP_REPORT") {
        std::fs::copy(path, keep).unwrap();
    }
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn the_page_is_whole_and_fetches_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let size = if std::env::var_os("KEEP_REPORT").is_some() {
        (360, 270)
    } else {
        (48, 36)
    };
    let all: Vec<Comparison> = (0..38).map(|id| comparison(id, size.0, size.1)).collect();
    let page = write_sample(
        &sample_report(),
        "fox, 50 frames",
        &all,
        &folder.path().join("report.html"),
    );
    for outside in [
        "http:", "https:", "//", "<script", "<link", "@import", "url(",
    ] {
        let found = page.find(outside).map(|at| {
            page[at.saturating_sub(40)..]
                .chars()
                .take(90)
                .collect::<String>()
        });
        // Base64 may hold two slashes in a row; nothing else may.
        assert!(
            found.is_none() || (outside == "//" && !outside_of_data(&page).contains("//")),
            "{outside}: {found:?}"
        );
    }
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 12 * 3);
    assert_eq!(page.matches("<svg").count(), 4);
    for text in [
        "fox, 50 frames",
        "23.87",
        "58,312",
        "every 8th keyframe",
        "held out",
        "training view",
        "reference, aligned",
        "map.steps",
    ] {
        assert!(page.contains(text), "{text}");
    }
    assert!(
        page.contains("1 of 38 keyframes have no pose") && page.contains("motion blur"),
        "faults are in sight"
    );
    assert!(!page.contains("NaN") && !page.contains("inf "));
}

fn outside_of_data(page: &str) -> String {
    page.split("data:image/jpeg;base64,")
        .map(|part| part.split_once('"').map_or(part, |(_, rest)| rest))
        .collect()
}

#[test]
fn embedded_pictures_decode_to_what_was_given() {
    use base64::Engine as _;

    let folder = tempfile::tempdir().unwrap();
    let shown = comparison(4, 700, 80);
    let page = write_sample(
        &sample_report(),
        "t",
        std::slice::from_ref(&shown),
        &folder.path().join("report.html"),
    );
    let data: Vec<&str> = page
        .split("data:image/jpeg;base64,")
        .skip(1)
        .map(|part| part.split_once('"').unwrap().0)
        .collect();
    let bytes = base64::engine::general_purpose::STANDARD
        .decode(data[0])
        .unwrap();
    let photo = image::load_from_memory(&bytes).unwrap().into_rgb8();
    assert_eq!(
        photo.dimensions(),
        (640, 73),
        "large pictures are made smaller"
    );
    let sky = photo.get_pixel(320, 2).0;
    let expected = &shown.photo.pixels[3 * (2 * 700 + 350)..][..3];
    assert!(
        sky.iter().zip(expected).all(|(a, b)| a.abs_diff(*b) < 12),
        "{sky:?} {expected:?}"
    );
}

#[test]
fn text_from_outside_is_escaped() {
    let folder = tempfile::tempdir().unwrap();
    let hostile = "<img src=x onerror=alert(1)>\"'&</style>";
    let mut report = sample_report();
    report.adapter = hostile.to_owned();
    report.version = hostile.to_owned();
    report.map_sha256 = hostile.to_owned();
    report.scale.source = hostile.to_owned();
    report.source_fault = Some(hostile.to_owned());
    report.geometry_note = Some(hostile.to_owned());
    report.error = Some(hostile.to_owned());
    report
        .parameters
        .insert(hostile.to_owned(), Value::from(hostile));
    let page = write_sample(&report, hostile, &[], &folder.path().join("report.html"));
    assert!(
        !page.contains("<img") && page.matches("</style>").count() == 1,
        "raw markup"
    );
    assert!(page.matches("&lt;img src=x").count() >= 9);
    assert!(page.contains("The run failed: ") && page.contains("The input ended early: "));
}

#[test]
fn a_run_that_made_nothing_still_has_a_page() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report.html");
    let mut report = Report {
        error: Some("no keyframe".to_owned()),
        ..Report::default()
    };
    report.timing_s.wall = f64::NAN;
    let nowhere = [TimedPose {
        stamp: Stamp::default(),
        pose: Rigid::new(DQuat::NAN, DVec3::NAN),
    }];
    for keyframes in [&[][..], &nowhere] {
        let inputs = ReportInputs {
            title: "",
            report: &report,
            comparisons: &[],
            loss: &[(0, f64::NAN)],
            psnr: &[],
            keyframes,
            trajectory: keyframes,
            reference: &nowhere,
        };
        write_html(&inputs, &path).unwrap();
        let page = std::fs::read_to_string(&path).unwrap();
        assert!(
            page.contains("The run failed: no keyframe") && !page.contains("NaN"),
            "{page}"
        );
    }
}
