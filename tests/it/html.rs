//! `report.html`: a page that is whole, safe and fetches nothing.

use std::f64::consts::TAU;
use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use serde_json::Value;

use crate::report::sample_report;
use splat_mapper::eval::report_json::Report;
use splat_mapper::eval::trajectory::TimedPose;
use splat_mapper::params::settings::defaults;
use splat_mapper::report::comparisons::Comparison;
use splat_mapper::report::html::{ReportInputs, write_html};
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, Similarity};

/// A checkered hill under a sky, seen from a little higher with each `ix`; `soft` stands for the map's blur.
fn test_image(width_px: u32, height_px: u32, ix: usize, soft: f64) -> Rendering {
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
    let sharp = test_image(width_px, height_px, keyframe_id as usize, 0.0);
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
    let rendering = test_image(
        width_px,
        height_px,
        keyframe_id as usize,
        0.3 + 0.02 * f64::from(keyframe_id),
    );
    let psnr = rendering.psnr(&photo);
    Comparison {
        keyframe_id,
        held_out: keyframe_id % 8 == 4,
        photo: Arc::new(photo),
        rendering,
        psnr,
    }
}

/// A walk round an object, as `world_from_cam`.
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

/// Writes the page of a sample run.
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
        defaults: &defaults(),
        comparisons,
        loss: &loss,
        psnr: &psnr,
        keyframes: &keyframes,
        trajectory: &walk(200, 0.02),
        reference: &reference,
        walk: None,
        top_view: None,
    };
    write_html(&inputs, path).unwrap();
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn the_page_is_whole_and_fetches_nothing() {
    let folder = tempfile::tempdir().unwrap();
    // `cargo test` keeps nothing; to look at a page, set KEEP_REPORT to a file name.
    let keep = std::env::var_os("KEEP_REPORT");
    let size = if keep.is_some() { (360, 270) } else { (48, 36) };
    let all: Vec<Comparison> = (0..38).map(|id| comparison(id, size.0, size.1)).collect();
    let page = write_sample(
        &sample_report(),
        "fox, 50 frames",
        &all,
        &folder.path().join("report.html"),
    );
    if let Some(keep) = keep {
        std::fs::write(keep, &page).unwrap();
    }
    let text_of_page = outside_of_data(&page);
    for outside in [
        "http:", "https:", "//", "<script", "<link", "@import", "url(",
    ] {
        assert!(!text_of_page.contains(outside), "{outside}");
    }
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 12 * 3);
    assert_eq!(page.matches("<svg").count(), 4);
    for text in [
        "fox, 50 frames",
        "23.87",
        "23.52 dB, 0.783",
        "24.06 dB, 0.786",
        "58,312",
        "every 8th keyframe",
        "held out",
        "training view",
        "reference, aligned",
        "train.steps",
    ] {
        assert!(page.contains(text), "{text}");
    }
    assert!(
        page.contains("1 of 38 keyframes have no pose") && page.contains("motion blur"),
        "faults are in view"
    );
    assert!(!text_of_page.contains("NaN") && !text_of_page.contains("inf "));
}

/// The page without its embedded images: base64 may hold any letters and two slashes in a row.
fn outside_of_data(page: &str) -> String {
    page.split("data:image/jpeg;base64,")
        .map(|part| part.split_once('"').map_or(part, |(_, rest)| rest))
        .collect()
}

#[test]
fn embedded_images_decode_to_what_was_given() {
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
        "large images are made smaller"
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
            defaults: &defaults(),
            comparisons: &[],
            loss: &[(0, f64::NAN)],
            psnr: &[],
            keyframes,
            trajectory: keyframes,
            reference: &nowhere,
            walk: None,
            top_view: None,
        };
        write_html(&inputs, &path).unwrap();
        let page = std::fs::read_to_string(&path).unwrap();
        assert!(
            page.contains("The run failed: no keyframe") && !page.contains("NaN"),
            "{page}"
        );
    }
}
