//! Poses and sparse points of a scene's images by COLMAP, for the row that starts from them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;

use anyhow::{Context, bail};

use crate::eval::error::write_atomically;
use crate::eval::images::png;
use crate::node::open_source;
use splat_io::images::{ImagesSource, has_images};
use splat_io::params::SourceParams;
use splat_io::scene_formats::scene::Layout;
use splat_types::time::Stopwatch;

/// More images than this are matched in their order, as those of a video, instead of each with each: that takes the square of their
/// number.
const MAX_EXHAUSTIVE: usize = 100;

/// A scene that COLMAP made, or found in `work` from an earlier comparison.
#[derive(Debug)]
pub struct ColmapScene {
    pub folder: PathBuf,
    /// That extraction, matching and mapping took.
    pub secs: f64,
    /// File names of images that are held out: every n-th of the source, as `select.holdout_frames` counts them, whether or not
    /// COLMAP registers all images.
    pub held_out: Vec<String>,
}

/// Runs COLMAP over the images that the other rows have: `images` of them drawn by the seed, 0 = all.
pub fn colmap(
    scene: &Path,
    work: &Path,
    (images, seed, holdout): (usize, u64, u32),
    say: &mut dyn FnMut(&str),
) -> anyhow::Result<ColmapScene> {
    let params = SourceParams {
        subsample: images,
        ..SourceParams::default()
    };
    fs::create_dir_all(work)?;
    let there = work.join("images");
    let wanted = format!("{} images={images} seed={seed}\n", scene.display());
    let (record, done) = (work.join("input.txt"), work.join("seconds.txt"));
    if fs::read_to_string(&record).ok() != Some(wanted.clone()) {
        // Of other images, or written by half.
        for folder in [&there, &work.join("sparse")] {
            fs::remove_dir_all(folder).ok();
        }
        fs::remove_file(&done).ok();
        say("gathering the images for COLMAP");
        gather(scene, &there, &params, seed)?;
        write_atomically("the input of COLMAP", wanted.as_bytes(), &record)?;
    }
    let mut names: Vec<String> = fs::read_dir(&there)?
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .collect();
    names.sort_unstable();
    let secs = fs::read_to_string(&done)
        .ok()
        .and_then(|text| text.trim().parse().ok());
    let secs = match secs {
        Some(secs) => secs,
        None => {
            let watch = Stopwatch::start();
            reconstruct(work, names.len(), say)?;
            let secs = watch.secs();
            write_atomically("the time of COLMAP", format!("{secs}\n").as_bytes(), &done)?;
            secs
        }
    };
    Ok(ColmapScene {
        folder: work.to_owned(),
        secs,
        held_out: names
            .into_iter()
            .filter(|name| is_held_out(name, holdout))
            .collect(),
    })
}

/// By the number that an image has in the source, which is its name here.
fn is_held_out(name: &str, every: u32) -> bool {
    let seq = name.split('.').next().and_then(|seq| seq.parse().ok());
    let every = u64::from(every);
    seq.is_some_and(|seq: u64| every > 0 && seq % every == every / 2)
}

/// The images of a scene, named by their numbers in the source: files as they are, frames of a recording as PNG.
fn gather(scene: &Path, to: &Path, params: &SourceParams, seed: u64) -> anyhow::Result<()> {
    fs::create_dir_all(to)?;
    let is_folder = Layout::find(scene).is_some() || (scene.is_dir() && has_images(scene));
    if is_folder && let Ok(source) = ImagesSource::open(scene, params, seed) {
        return link_files(&source.files(), to);
    }
    let mut source = open_source::open(&scene.to_string_lossy(), params, seed)?;
    while let Some(frame) = source.next() {
        let image = Arc::unwrap_or_clone(frame.image);
        fs::write(to.join(format!("{:06}.png", frame.seq)), png(&image)?)?;
    }
    Ok(())
}

/// Without a copy where the disk can do that. Files that are missing keep their number.
fn link_files(files: &[PathBuf], to: &Path) -> anyhow::Result<()> {
    for (ix, file) in files.iter().enumerate() {
        let kind = file.extension().and_then(|e| e.to_str()).unwrap_or("jpg");
        let there = to.join(format!("{ix:06}.{kind}"));
        if !file.is_file() || there.exists() {
            continue;
        }
        if fs::hard_link(file, &there).is_err() {
            fs::copy(file, &there)
                .with_context(|| format!("cannot copy {} for COLMAP", file.display()))?;
        }
    }
    Ok(())
}

fn reconstruct(work: &Path, n_images: usize, say: &mut dyn FnMut(&str)) -> anyhow::Result<()> {
    let (database, sparse) = (work.join("database.db"), work.join("sparse"));
    // What an interrupted try left is no start.
    fs::remove_file(&database).ok();
    fs::create_dir_all(&sparse)?;
    let path = |path: &Path| path.display().to_string();
    let (database, images) = (path(&database), path(&work.join("images")));
    let matcher = if n_images <= MAX_EXHAUSTIVE {
        "exhaustive_matcher"
    } else {
        "sequential_matcher"
    };
    let on_cpu_for_one_camera: &[&str] = &[
        "--ImageReader.single_camera",
        "1",
        "--SiftExtraction.use_gpu",
        "0",
    ];
    let of_images = ["--image_path", &images];
    let to = path(&sparse);
    let stages: [(&str, Vec<&str>); 3] = [
        (
            "feature_extractor",
            [&of_images, on_cpu_for_one_camera].concat(),
        ),
        (matcher, vec!["--SiftMatching.use_gpu", "0"]),
        (
            "mapper",
            [&of_images, ["--output_path", &to].as_slice()].concat(),
        ),
    ];
    for (stage, arguments) in stages {
        say(&format!("colmap {stage}"));
        let log = work.join(format!("{stage}.log"));
        let file = fs::File::create(&log)?;
        let status = Command::new("colmap")
            .args([stage, "--database_path", &database])
            .args(arguments)
            .env("QT_QPA_PLATFORM", "offscreen")
            .stdin(Stdio::null())
            .stdout(file.try_clone()?)
            .stderr(file)
            .status()
            .context("colmap cannot be started; install it (apt install colmap) or leave the row colmap_3dgs out")?;
        if !status.success() {
            bail!("colmap {stage}: {}", last_line(&log));
        }
    }
    if !sparse.join("0").is_dir() {
        bail!(
            "COLMAP found no model of these images: {}",
            work.join("mapper.log").display()
        );
    }
    Ok(())
}

/// Of a log, what was said last.
pub fn last_line(log: &Path) -> String {
    let text = fs::read_to_string(log).unwrap_or_default();
    let line = text.lines().rev().find(|line| !line.trim().is_empty());
    line.map_or_else(
        || format!("it ended without a word: {}", log.display()),
        ToOwned::to_owned,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_held_out_by_their_number_in_the_source() {
        let held_out = |every| {
            (0..30)
                .filter(|seq| is_held_out(&format!("{seq:06}.png"), every))
                .collect::<Vec<u32>>()
        };
        assert_eq!(held_out(10), [5, 15, 25]);
        assert!(held_out(0).is_empty());
        assert!(!is_held_out("notes.txt", 10));
    }
}
