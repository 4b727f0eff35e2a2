//! `report.json`: the promised keys, written whole and read back.

use std::collections::BTreeMap;

use serde_json::Value;

use splat_mapper::eval::report_json::{
    FrameCounts, KeyframeCounts, Latency, LoadShedding, Quality, Report, Resumed, Timing,
    TrackingFigures,
};
use splat_mapper::params::settings::Settings;
use splat_slam::mapper::budgets::Budgets;
use splat_types::snapshot;

/// Scripts outside depend on these; a line may be added, none removed.
const KEYS: &str = "\
adapter
budgets.evicted_splats
budgets.growth_refused
budgets.keyframes_on_disk
budgets.max_gpu_mib
budgets.max_keyframes_in_ram
budgets.max_splats
budgets.peak_engine_mib
budgets.peak_keyframes_in_ram
budgets.peak_splats
budgets.pictures_lost
budgets.restored_splats
budgets.splats_on_disk
continued.asked
continued.found
continued.joined
continued.map_keyframes
engine_faults
error
frames.dropped
frames.out_of_order
frames.received
frames.undecodable
frames.without_depth
frames.without_imu
frames.without_second
geometry_note
keyframes.before
keyframes.components
keyframes.registered
keyframes.selected
latency_ms.frame_to_pose_p50
latency_ms.frame_to_pose_p95
latency_ms.keyframe_to_pose_p50
latency_ms.keyframe_to_pose_p95
latency_ms.keyframe_to_snapshot_p50
latency_ms.keyframe_to_snapshot_p95
load_shed.depth_s
load_shed.hurried_keyframes
load_shed.steps_s
load_shed.unsought_keyframes
map_sha256
parameters.train.steps
peak_gpu_mib
peak_rss_mib
quality.holdout_every
quality.lpips_holdout
quality.lpips_train
quality.psnr_holdout
quality.psnr_holdout_exposed
quality.psnr_holdout_half
quality.psnr_train
quality.ssim_holdout
quality.ssim_holdout_exposed
quality.ssim_holdout_half
quality.ssim_train
quality.views_holdout
quality.views_train
quality_at
scale.metres_per_unit
scale.source
scale.std
seed
source_fault
splats
steps
steps_per_s
submaps
timing_s.decode
timing_s.geometry
timing_s.optimise
timing_s.track
timing_s.wall
tracking.dropped
tracking.fitted
tracking.frames
tracking.interpolated
tracking.lost
tracking.posed
tracking.relocalised
tracking.tracked
tracking.work_ms_p50
tracking.work_ms_p95
version";

fn sample_quality() -> Quality {
    Quality {
        views_holdout: 3,
        views_train: 12,
        ssim_train: Some(0.9),
        lpips_train: None,
        holdout_every: 8,
        psnr_train: Some(26.31),
        psnr_holdout: Some(23.87),
        ssim_holdout: Some(0.791),
        psnr_holdout_half: Some(23.52),
        ssim_holdout_half: Some(0.783),
        psnr_holdout_exposed: Some(24.06),
        ssim_holdout_exposed: Some(0.786),
        lpips_holdout: None,
    }
}

pub(crate) fn sample_report() -> Report {
    let mut settings = Settings::shipped();
    settings.merge_setting("train.steps=1200").unwrap();
    Report {
        version: "0.1.0".to_owned(),
        frames: FrameCounts {
            received: 50,
            dropped: 0,
            undecodable: 1,
            out_of_order: 0,
            without_depth: 0,
            without_second: 0,
            without_imu: 0,
        },
        keyframes: KeyframeCounts {
            selected: 38,
            registered: 37,
            before: 40,
            submaps: 1,
        },
        submaps: Vec::new(),
        splats: 58_312,
        steps: 1200,
        adapter: "cpu (2 threads, avx2)".to_owned(),
        seed: 7,
        map_sha256: "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad".to_owned(),
        load_shed: LoadShedding {
            hurried_keyframes: 9,
            unsought_keyframes: 2,
            depth_s: 3.25,
            steps_s: 12.5,
        },
        timing_s: Timing {
            wall: 148.2,
            decode: 1.9,
            geometry: 61.4,
            optimise: 96.0,
            track: 2.6,
        },
        steps_per_s: Some(12.5),
        latency_ms: Latency::of(&[0.81, 0.9, 1.7], &[2.1, 2.4, 4.0], &[0.0125, 0.0125]),
        tracking: TrackingFigures {
            frames: 50,
            tracked: 47,
            ..TrackingFigures::default()
        },
        peak_rss_mib: Some(731.4),
        peak_gpu_mib: None,
        quality_at: Vec::new(),
        quality: sample_quality(),
        budgets: Budgets {
            max_splats: 60_000,
            evicted_splats: 12,
            ..Budgets::default()
        },
        resume_report: Some(Resumed {
            map_keyframes: 40,
            asked: 12,
            found: 9,
            joined: true,
        }),
        scale: snapshot::Scale::UP_TO_SCALE.into(),
        source_fault: None,
        geometry_note: Some(
            "keyframe 21 shares too few features with its neighbours (motion blur)".to_owned(),
        ),
        engine_faults: 1,
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
        parameters: BTreeMap::from([("train.steps".to_owned(), Value::from(5))]),
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
