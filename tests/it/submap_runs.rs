//! Whole replays in which tracking is lost between two places: what becomes of the submaps, in the run directory.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use rayon::prelude::*;
use serde_json::Value;

use splat_mapper::eval::trajectory::read_tum;
use splat_msgs::map_messages::SplatManifest;
use splat_msgs::ros;
use splat_slam::mapper::map_file::checkpoint;
use splat_synth::settings::SynthSettings;
use splat_synth::take::Take;
use splat_types::splats::ply;

const SIZE: &str = "width=192&height=144";

/// Frames of scenes one behind the other, as a folder of images of a calibrated camera.
fn film(folder: &Path, scenes: &[(&str, std::ops::Range<u32>)]) {
    let mut n = 0;
    for (scene, frames) in scenes {
        let settings = SynthSettings::parse(&format!("{scene}&{SIZE}")).unwrap();
        let lens = settings.lens().intrinsics;
        let take = Take::new(settings).unwrap();
        frames.clone().into_par_iter().for_each(|ix| {
            let image = take.image(ix);
            let path = folder.join(format!("{:04}.png", n + ix - frames.start));
            image::RgbImage::from_raw(image.width_px, image.height_px, image.pixels)
                .unwrap()
                .save(path)
                .unwrap();
        });
        n += frames.len() as u32;
        let json = serde_json::json!({
            "width": lens.width_px, "height": lens.height_px,
            "fx": lens.fx, "fy": lens.fy, "cx": lens.cx - 0.5, "cy": lens.cy - 0.5,
        });
        std::fs::write(folder.join("intrinsics.json"), json.to_string()).unwrap();
    }
}

fn replay(images: &Path, out: &Path, steps: &str) -> Output {
    let input = format!("images:{}", images.display());
    Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["replay", &input, "--out", out.to_str().unwrap()])
        .args(["--geometry", "sfm", "--backend", "cpu", "--steps", steps])
        .args(["--set", "select.every_frame=true"])
        .args(["--set", "sfm.max_features=800"])
        .args(["--set", "train.seeds_per_keyframe=600"])
        .args(["--set", "map.snapshot_secs=0.05", "--set"])
        .arg(format!("publish.record={}", sent(out).display()))
        .output()
        .unwrap()
}

/// All that was published, beside the run directory.
fn sent(out: &Path) -> PathBuf {
    out.with_extension("mcap")
}

/// Splats of each manifest of a submap that was published.
fn published_splats(out: &Path) -> Vec<u32> {
    let bytes = std::fs::read(sent(out)).unwrap();
    let messages = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(Result::unwrap);
    let manifests = messages.filter(|m| m.channel.topic == "/splat_mapper/submaps/manifest");
    let manifest = |m: mcap::Message<'_>| ros::decode::<SplatManifest>(&m.data).unwrap();
    manifests.map(|m| manifest(m).n_splats).collect()
}

fn report(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap()
}

fn submap_files(out: &Path) -> Vec<String> {
    let names = std::fs::read_dir(out).unwrap();
    let names = names.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut files: Vec<String> = names.filter(|name| name.starts_with("submap_")).collect();
    files.sort();
    files
}

#[test]
fn two_places_without_a_way_between_are_two_maps_in_the_run_directory() {
    let folder = tempfile::tempdir().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    std::fs::create_dir(&images).unwrap();
    let places = [
        ("room?frames=72&speed=2", 0..22),
        ("facade?frames=72&speed=2", 0..14),
    ];
    film(&images, &places);
    let output = replay(&images, &out, "300");
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let report = report(&out);
    eprintln!("{} {}", report["keyframes"], report["submaps"]);
    let submaps = report["submaps"].as_array().unwrap();
    assert_eq!(submaps.len(), 2, "{submaps:?}");
    let (map, other) = (&submaps[0], &submaps[1]);
    assert!(map["active"] == true && map["file"] == "map.ply", "{map}");
    assert!(
        map["keyframes"].as_u64().unwrap() >= 18,
        "the largest is the map: {map}"
    );
    assert_eq!(map["splats"], report["splats"]);
    assert!(
        other["active"] == false && other["keyframes"].as_u64().unwrap() >= 8,
        "{other}"
    );
    let file = format!("submap_{}.ply", other["id"]);
    assert_eq!(other["file"].as_str(), Some(&file[..]));
    assert_eq!(submap_files(&out), [&file[..]]);
    let splats = ply::read(&out.join(&file)).unwrap();
    assert_eq!(splats.len() as u64, other["splats"].as_u64().unwrap());
    assert!(splats.len() > 1000, "{}", splats.len());
    let published = published_splats(&out);
    assert_eq!(
        published.last(),
        Some(&(splats.len() as u32)),
        "{published:?}"
    );
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains(&file) && page.contains("in a frame of its own"));
    // Poses in another frame are in no trajectory: no frame of the second place has one.
    for name in ["keyframes.tum", "trajectory.tum", "trajectory_live.tum"] {
        let poses = read_tum(&out.join(name)).unwrap();
        let first = read_tum(&out.join("keyframes.tum")).unwrap()[0].stamp;
        let last = poses
            .iter()
            .map(|p| p.stamp.secs_since(first))
            .fold(0.0, f64::max);
        assert!(!poses.is_empty() && last < 2.2, "{name}: {last} s");
    }
}

#[test]
fn a_loop_joins_two_places_and_one_map_has_the_splats_of_both() {
    let folder = tempfile::tempdir().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    std::fs::create_dir(&images).unwrap();
    // A lap round the block from which a stretch is missing; it ends where it began.
    let lap = "corridor?frames=240&speed=1.12";
    film(&images, &[(lap, 0..20), (lap, 50..118)]);
    let output = replay(&images, &out, "600");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    assert!(said.contains("is parked until they join"), "{said}");
    let report = report(&out);
    eprintln!(
        "{} {} {}",
        report["keyframes"], report["submaps"], report["quality"]
    );
    let submaps = report["submaps"].as_array().unwrap();
    assert_eq!(submaps.len(), 1, "{submaps:?}");
    assert!(submap_files(&out).is_empty());
    // Published while it was parked, and taken back since.
    let published = published_splats(&out);
    assert!(published.first().is_some_and(|n| *n > 500), "{published:?}");
    assert_eq!(published.last(), Some(&0), "{published:?}");
    let poses = read_tum(&out.join("keyframes.tum")).unwrap();
    assert!(poses.len() >= 80, "{}", poses.len());
    let map = checkpoint::read(&out.join("map.splatmap")).unwrap();
    let anchors = map.snapshot.splats.anchors.iter();
    let (first, second): (Vec<u32>, Vec<u32>) = anchors.partition(|anchor| **anchor < 20);
    assert!(
        first.len() > 500 && second.len() > 2000,
        "{} {}",
        first.len(),
        second.len()
    );
}
