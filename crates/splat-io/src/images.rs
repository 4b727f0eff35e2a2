//! A folder of images -> frames.
//!
//! With `images.txt` (lines `seconds path`), `intrinsics.json` and `poses_tum.txt` where they are; without a list,
//! the JPEG and PNG files in natural order of their names, with synthetic stamps 0.1 s apart. Scenes of other programs
//! (`scene_formats`) are folders, too: their images come with poses and lenses.

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64Mcg;

use crate::calibration::lens_of_json;
use crate::error::SourceError;
use crate::frame_source::{MetricInput, Source, SourceCounts};
use crate::ground_truth::{Track, half_interval, stamp_of_decimal, track_of_tum};
use crate::intake::{Extras, Intake};
use crate::params::SourceParams;
use crate::scene_formats::scene::{DEFAULT_GAP_NANOS, Layout, SceneView, is_named};
use crate::small_file::{natural_order, read_small};
use splat_types::camera::CameraModel;
use splat_types::depth::DepthMap;
use splat_types::frame::Frame;
use splat_types::sparse_point::SparsePoint;
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, extent};

/// Lists and trajectories: a million lines.
const MAX_TEXT_BYTES: u64 = 128 << 20;
/// One image file.
const MAX_IMAGE_BYTES: u64 = 256 << 20;
/// Added to the seed for the choice of images.
const PICK_STREAM: u64 = 0x5eed_71cc;
const MAX_IMAGES: usize = 1_000_000;

#[derive(Debug)]
struct Entry {
    stamp: Stamp,
    path: PathBuf,
    truth: Option<Rigid>,
    /// Its own, where the images differ.
    lens: Option<CameraModel>,
    /// 16-bit PNG, millimetres.
    depth: Option<PathBuf>,
    is_held_out: bool,
}

impl Entry {
    /// Of which nothing but the image is known.
    fn bare(stamp: Stamp, path: PathBuf) -> Self {
        Self {
            stamp,
            path,
            truth: None,
            lens: None,
            depth: None,
            is_held_out: false,
        }
    }

    fn name(&self) -> &str {
        let name = self.path.file_name().and_then(|name| name.to_str());
        name.unwrap_or_default()
    }
}

#[derive(Debug)]
pub struct ImagesSource {
    entries: std::vec::IntoIter<Entry>,
    truth_extent: Option<f64>,
    /// Of a scene of another program.
    layout: Option<Layout>,
    max_frames: u64,
    intake: Intake,
}

impl ImagesSource {
    /// A folder, or the transforms.json of a scene.
    pub fn open(folder: &Path, params: &SourceParams, seed: u64) -> Result<Self, SourceError> {
        if let Some(layout) = scene_layout(folder) {
            return Self::of_scene(folder, &layout, params, seed);
        }
        let fail = |reason: String, way_out| SourceError::Open {
            what: "folder of images",
            reason,
            way_out,
            path: folder.to_owned(),
        };
        let list = folder.join("images.txt");
        let mut entries = if list.exists() {
            let text = read_text(&list)
                .map_err(|reason| fail(reason, "make images.txt a readable text file"))?;
            entries_of_list(folder, &text)
        } else {
            entries_of_folder(folder)
                .map_err(|reason| fail(reason, "name a folder with JPEG or PNG files"))?
        };
        entries.retain(|entry| {
            let name = entry.name();
            params.include_prefixes.is_empty() || is_named(name, &params.include_prefixes)
        });
        if entries.is_empty() {
            return Err(fail(
                "no images".to_owned(),
                "put JPEG or PNG files in it, or lines `seconds path` in images.txt",
            ));
        }
        if !entries.iter().any(|entry| entry.path.is_file()) {
            let reason = format!(
                "none of the {} images that images.txt lists is there",
                entries.len()
            );
            return Err(fail(
                reason,
                "copy them beside images.txt, or name the recording instead",
            ));
        }
        let stamps: Vec<Stamp> = entries.iter().take(1000).map(|entry| entry.stamp).collect();
        let (track, within_nanos) = (truth_of(folder), half_interval(&stamps));
        let mut entries = picked(entries, params.subsample, seed);
        for entry in &mut entries {
            entry.is_held_out = is_named(entry.name(), &params.holdout_prefixes);
            entry.truth = track.nearest(entry.stamp, within_nanos);
        }
        Ok(Self {
            entries: entries.into_iter(),
            truth_extent: track.extent(),
            layout: None,
            max_frames: params.max_frames,
            intake: Intake::new(params, lens_of(folder)),
        })
    }

    /// Paths of the images that are still to come, in their order; some may be missing.
    pub fn files(&self) -> Vec<PathBuf> {
        let entries = self.entries.as_slice().iter();
        entries.map(|entry| entry.path.clone()).collect()
    }

    fn of_scene(
        path: &Path,
        layout: &Layout,
        params: &SourceParams,
        seed: u64,
    ) -> Result<Self, SourceError> {
        let views = layout.views(params.max_side)?;
        let centres: Vec<_> = views.iter().map(|v| v.gt_from_cam.translation).collect();
        let n_listed = views.len();
        let entries: Vec<Entry> = views
            .into_iter()
            .filter(|view| {
                params.include_prefixes.is_empty() || is_named(&view.name, &params.include_prefixes)
            })
            .map(|view| entry_of_view(view, params))
            .collect();
        let entries = picked(entries, params.subsample, seed);
        let n_there = entries.iter().filter(|entry| entry.path.is_file()).count();
        let n_held_out = entries.iter().filter(|entry| entry.is_held_out).count();
        tracing::info!(
            "{} of {n_listed} views of the scene, {n_held_out} of them held out: {}",
            entries.len(),
            path.display()
        );
        if n_there < entries.len() {
            let n_missing = entries.len() - n_there;
            tracing::warn!(
                "{n_missing} images of the scene are missing: {}",
                path.display()
            );
        }
        if n_there == 0 {
            return Err(SourceError::Open {
                what: "scene",
                reason: format!("none of its {} images is there", entries.len()),
                way_out: "put them into images beside it, or check source.include_prefixes",
                path: path.to_owned(),
            });
        }
        Ok(Self {
            entries: entries.into_iter(),
            truth_extent: Some(extent(&centres)),
            layout: Some(layout.clone()),
            max_frames: params.max_frames,
            intake: Intake::new(params, None),
        })
    }

    fn frame_of(&mut self, entry: &Entry) -> Option<Frame> {
        let arrival = self.intake.arrive(entry.stamp)?;
        let bytes = read_small(&entry.path, MAX_IMAGE_BYTES);
        match bytes
            .and_then(|bytes| splat_image::codec::compressed(&bytes).map_err(|e| e.to_string()))
        {
            Ok(image) => {
                let extras = Extras {
                    truth: entry.truth,
                    sensor_depth: self.depth_of(entry),
                    lens: entry.lens,
                    is_held_out: entry.is_held_out,
                    ..Extras::default()
                };
                self.intake.frame(arrival, image, extras)
            }
            Err(reason) => {
                self.intake
                    .undecodable(arrival.seq, &format!("{reason}: {}", entry.path.display()));
                None
            }
        }
    }

    fn depth_of(&mut self, entry: &Entry) -> Option<DepthMap> {
        let path = entry.depth.as_ref()?;
        let bytes = read_small(path, MAX_IMAGE_BYTES);
        let depth = bytes
            .and_then(|bytes| splat_image::codec::depth_png(&bytes).map_err(|e| e.to_string()));
        let warn = |reason: &String| {
            let text = format!("depth images are left out: {reason}: {}", path.display());
            self.intake.warn_once("depth", &text);
        };
        depth.inspect_err(warn).ok()
    }
}

/// So many of the entries, drawn by the seed, in their order; 0 keeps all.
fn picked(mut entries: Vec<Entry>, n: usize, seed: u64) -> Vec<Entry> {
    if n > 0 && n < entries.len() {
        let mut rng = Pcg64Mcg::seed_from_u64(seed ^ PICK_STREAM);
        let mut order: Vec<usize> = (0..entries.len()).collect();
        order.shuffle(&mut rng);
        let chosen: BTreeSet<usize> = order.into_iter().take(n).collect();
        let mut ix = 0;
        entries.retain(|_| {
            ix += 1;
            chosen.contains(&(ix - 1))
        });
    }
    entries
}

/// `None`: a folder of our own kind, which its list reports from a COLMAP text model.
fn scene_layout(path: &Path) -> Option<Layout> {
    let layout = Layout::find(path)?;
    let is_own = path.join("images.txt").is_file();
    let is_model = matches!(&layout, Layout::Colmap { model, .. } if model == path);
    (!is_own || is_model).then_some(layout)
}

fn entry_of_view(view: SceneView, params: &SourceParams) -> Entry {
    Entry {
        is_held_out: view.is_held_out || is_named(&view.name, &params.holdout_prefixes),
        stamp: view.stamp,
        path: view.image,
        truth: Some(view.gt_from_cam),
        lens: view.lens,
        depth: view.depth,
    }
}

impl Source for ImagesSource {
    fn next(&mut self) -> Option<Frame> {
        while !self.intake.is_full() {
            let entry = self.entries.next()?;
            if let Some(frame) = self.frame_of(&entry) {
                return Some(frame);
            }
        }
        None
    }

    fn counts(&self) -> SourceCounts {
        self.intake.counts()
    }

    fn len_hint(&self) -> Option<u64> {
        let left = self.entries.len() as u64;
        let counts = self.intake.counts();
        let frames_out = counts.received - counts.undecodable - counts.out_of_order;
        Some(if self.max_frames == 0 {
            left
        } else {
            left.min(self.max_frames.saturating_sub(frames_out))
        })
    }

    fn n_photos(&self) -> Option<u64> {
        self.len_hint()
    }

    fn metric_input(&self) -> MetricInput {
        let mut entries = self.entries.as_slice().iter();
        if entries.any(|entry| entry.depth.is_some()) {
            MetricInput::Depth
        } else {
            MetricInput::None
        }
    }

    fn truth_extent(&self) -> Option<f64> {
        self.truth_extent
    }

    fn sparse_points(&self) -> Result<Vec<SparsePoint>, SourceError> {
        self.layout.as_ref().map_or(Ok(Vec::new()), Layout::points)
    }
}

/// Whether a folder looks like one of images.
pub fn has_images(folder: &Path) -> bool {
    folder.join("images.txt").is_file()
        || scene_layout(folder).is_some()
        || entries_of_folder(folder).is_ok_and(|entries| !entries.is_empty())
}

fn read_text(path: &Path) -> Result<String, String> {
    read_small(path, MAX_TEXT_BYTES).map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
}

fn entries_of_list(folder: &Path, text: &str) -> Vec<Entry> {
    let mut entries = Vec::new();
    let mut n_bad = 0;
    for line in text
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty() && !line.starts_with('#'))
    {
        let entry = entry_of_line(folder, line);
        n_bad += usize::from(entry.is_none());
        entries.extend(entry);
        if entries.len() >= MAX_IMAGES {
            tracing::warn!(
                "only the first {MAX_IMAGES} lines of images.txt are read: {}",
                folder.display()
            );
            break;
        }
    }
    if n_bad > 0 {
        tracing::warn!(
            "{n_bad} lines of images.txt are not `seconds path-inside-the-folder`: {}",
            folder.display()
        );
    }
    entries
}

fn entry_of_line(folder: &Path, line: &str) -> Option<Entry> {
    let (stamp, name) = line.split_once(char::is_whitespace)?;
    let path = Path::new(name.trim());
    // A list from elsewhere must not make us read whatever else lies on the disk.
    let stays_inside = path
        .components()
        .all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    let stamp = stamp_of_decimal(stamp)?;
    stays_inside.then(|| Entry::bare(stamp, folder.join(path)))
}

fn entries_of_folder(folder: &Path) -> Result<Vec<Entry>, String> {
    let is_image = |path: &PathBuf| {
        let extension = path
            .extension()
            .map(|extension| extension.to_string_lossy().to_ascii_lowercase());
        matches!(extension.as_deref(), Some("jpg" | "jpeg" | "png"))
    };
    let found = std::fs::read_dir(folder).map_err(|e| e.to_string())?;
    let mut paths: Vec<PathBuf> = found
        .flatten()
        .map(|entry| entry.path())
        .filter(is_image)
        .take(MAX_IMAGES)
        .collect();
    paths.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
    let with_stamp =
        |(ix, path)| Entry::bare(Stamp::from_nanos(ix as i64 * DEFAULT_GAP_NANOS), path);
    Ok(paths.into_iter().enumerate().map(with_stamp).collect())
}

fn lens_of(folder: &Path) -> Option<CameraModel> {
    let path = folder.join("intrinsics.json");
    if !path.exists() {
        tracing::info!(
            "no intrinsics.json: the camera counts as uncalibrated: {}",
            folder.display()
        );
        return None;
    }
    let lens = read_text(&path).and_then(|text| lens_of_json(&text));
    lens.inspect_err(|found| {
        tracing::warn!(
            "camera counts as uncalibrated, found {found}: {}",
            path.display()
        );
    })
    .ok()
}

fn truth_of(folder: &Path) -> Track {
    let path = folder.join("poses_tum.txt");
    if !path.exists() {
        return Track::default();
    }
    let (track, n_bad) = match read_text(&path) {
        Ok(text) => track_of_tum(&text),
        Err(reason) => {
            tracing::warn!("no ground truth, {reason}: {}", path.display());
            return Track::default();
        }
    };
    if n_bad > 0 || track.is_empty() {
        tracing::warn!(
            "{n_bad} lines are not `t tx ty tz qx qy qz qw`: {}",
            path.display()
        );
    }
    track
}
