//! A folder of pictures -> frames.
//!
//! With `images.txt` (lines `seconds path`), `intrinsics.json` and `poses_tum.txt` where they are; without a list,
//! the JPEG and PNG files in natural order of their names, with made-up stamps 0.1 s apart.

use std::path::{Component, Path, PathBuf};

use crate::camera::Lens;
use crate::clock::Stamp;
use crate::config::SourceParams;
use crate::frame::Frame;
use crate::source::calibration::lens_of_json;
use crate::source::intake::{Extras, Intake};
use crate::source::truth::{Track, half_interval, stamp_of_decimal, track_of_tum};
use crate::source::{Source, SourceCounts, SourceError, natural_order, read_small};

/// Gap between the made-up stamps of pictures without a list.
const MADE_UP_GAP_NANOS: i64 = 100_000_000;
/// Lists and trajectories: a million lines.
const MAX_TEXT_BYTES: u64 = 128 << 20;
/// One picture file.
const MAX_PICTURE_BYTES: u64 = 256 << 20;
const MAX_PICTURES: usize = 1_000_000;

#[derive(Debug)]
struct Entry {
    stamp: Stamp,
    path: PathBuf,
}

#[derive(Debug)]
pub struct ImagesSource {
    entries: std::vec::IntoIter<Entry>,
    truth: Track,
    truth_within_nanos: i64,
    max_frames: u64,
    intake: Intake,
}

impl ImagesSource {
    pub fn open(folder: &Path, params: &SourceParams) -> Result<Self, SourceError> {
        let fail = |reason: String, way_out| SourceError::Open {
            what: "folder of pictures",
            reason,
            way_out,
            path: folder.to_owned(),
        };
        let list = folder.join("images.txt");
        let entries = if list.exists() {
            let text = read_text(&list)
                .map_err(|reason| fail(reason, "make images.txt a readable text file"))?;
            entries_of_list(folder, &text)
        } else {
            entries_of_folder(folder)
                .map_err(|reason| fail(reason, "name a folder with JPEG or PNG files"))?
        };
        if entries.is_empty() {
            return Err(fail(
                "no pictures".to_owned(),
                "put JPEG or PNG files in it, or lines `seconds path` in images.txt",
            ));
        }
        if !entries.iter().any(|entry| entry.path.is_file()) {
            let reason = format!(
                "none of the {} pictures that images.txt lists is there",
                entries.len()
            );
            return Err(fail(
                reason,
                "copy them beside images.txt, or name the recording instead",
            ));
        }
        let stamps: Vec<Stamp> = entries.iter().take(1000).map(|entry| entry.stamp).collect();
        Ok(Self {
            entries: entries.into_iter(),
            truth: truth_of(folder),
            truth_within_nanos: half_interval(&stamps),
            max_frames: params.max_frames,
            intake: Intake::new(params, lens_of(folder)),
        })
    }

    fn frame_of(&mut self, entry: &Entry) -> Option<Frame> {
        let arrival = self.intake.arrive(entry.stamp)?;
        let bytes = read_small(&entry.path, MAX_PICTURE_BYTES);
        match bytes.and_then(|bytes| super::decode::compressed(&bytes).map_err(|e| e.to_string())) {
            Ok(picture) => {
                let truth = self.truth.nearest(entry.stamp, self.truth_within_nanos);
                self.intake.frame(
                    arrival,
                    picture,
                    Extras {
                        truth,
                        truth_depth: None,
                    },
                )
            }
            Err(reason) => {
                self.intake
                    .undecodable(arrival.seq, &format!("{reason}: {}", entry.path.display()));
                None
            }
        }
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
}

/// Whether a folder looks like one of pictures.
pub(super) fn has_pictures(folder: &Path) -> bool {
    folder.join("images.txt").is_file()
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
        if entries.len() >= MAX_PICTURES {
            tracing::warn!(
                "only the first {MAX_PICTURES} lines of images.txt are read: {}",
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
    stays_inside.then_some(Entry {
        stamp: stamp_of_decimal(stamp)?,
        path: folder.join(path),
    })
}

fn entries_of_folder(folder: &Path) -> Result<Vec<Entry>, String> {
    let is_picture = |path: &PathBuf| {
        let extension = path
            .extension()
            .map(|extension| extension.to_string_lossy().to_ascii_lowercase());
        matches!(extension.as_deref(), Some("jpg" | "jpeg" | "png"))
    };
    let found = std::fs::read_dir(folder).map_err(|e| e.to_string())?;
    let mut paths: Vec<PathBuf> = found
        .flatten()
        .map(|entry| entry.path())
        .filter(is_picture)
        .take(MAX_PICTURES)
        .collect();
    paths.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
    let with_stamp = |(ix, path)| Entry {
        stamp: Stamp::from_nanos(ix as i64 * MADE_UP_GAP_NANOS),
        path,
    };
    Ok(paths.into_iter().enumerate().map(with_stamp).collect())
}

fn lens_of(folder: &Path) -> Option<Lens> {
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
