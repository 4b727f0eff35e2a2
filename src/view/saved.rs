//! Saved maps -> what a viewer shows.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::bail;

use crate::formats::file;
use splat_slam::mapper::keyframes::image_codec::SavedView;
use splat_slam::mapper::map_file::checkpoint;
use splat_types::snapshot::{Scale, Snapshot};
use splat_types::splats::splats::Splats;
use splat_types::time::Stamp;
use splat_view::hub::Hub;
use splat_view::view_map::Published;

/// Splats of a chunk of a map that has no keyframes.
const CHUNK_SPLATS: usize = 8192;

/// A map with the images of its keyframes, as far as it has them.
#[derive(Debug)]
pub struct SavedMap {
    pub snapshot: Snapshot,
    pub views: Vec<SavedView>,
}

/// A `.splatmap`, a run directory with one, or a `.ply` or `.spz` of any program.
pub fn read(path: &Path) -> anyhow::Result<SavedMap> {
    let path = if path.is_dir() {
        path.join("map.splatmap")
    } else {
        path.to_owned()
    };
    match path.extension().and_then(|ending| ending.to_str()) {
        Some("splatmap") => {
            let saved = checkpoint::read(&path)?;
            Ok(SavedMap {
                snapshot: saved.snapshot,
                views: saved.views,
            })
        }
        Some("ply" | "spz") => Ok(SavedMap {
            snapshot: of_splats(file::read(&path)?),
            views: Vec::new(),
        }),
        _ => bail!(
            "a map is a .splatmap, .ply or .spz file, or the directory of a run: {}",
            path.display()
        ),
    }
}

impl SavedMap {
    /// Puts it where viewers see it.
    pub fn show(self, hub: &Hub) {
        let stamps = self
            .snapshot
            .poses
            .iter()
            .map(|pose| (pose.keyframe_id, pose.stamp));
        let stamps: std::collections::BTreeMap<u32, Stamp> = stamps.collect();
        for view in &self.views {
            let stamp = stamps.get(&view.keyframe_id);
            let Some((stamp, jpeg)) = stamp.zip(view.jpeg().ok()) else {
                continue;
            };
            hub.thumbnail(*stamp, jpeg);
        }
        hub.publish(Published::at_first_keyframe(Arc::new(self.snapshot)));
    }
}

/// Splats without keyframes hang on places instead: halved along the longest side until there are few of them.
fn of_splats(mut splats: Splats) -> Snapshot {
    let mut anchors = vec![0; splats.len()];
    let mut n_chunks = 0;
    let mut parts = vec![(0..splats.len()).collect::<Vec<usize>>()];
    while let Some(mut part) = parts.pop() {
        if part.len() <= CHUNK_SPLATS {
            part.iter().for_each(|ix| anchors[*ix] = n_chunks);
            n_chunks += 1;
            continue;
        }
        let axis = longest_axis(&splats, &part);
        let half = part.len() / 2;
        part.select_nth_unstable_by(half, |a, b| {
            splats.means[*a][axis].total_cmp(&splats.means[*b][axis])
        });
        let upper = part.split_off(half);
        parts.extend([part, upper]);
    }
    splats.anchors = anchors;
    Snapshot {
        map_id: [0; 16],
        epoch: 0,
        revision: 1,
        stamp: Stamp::default(),
        scale: Scale::UP_TO_SCALE,
        poses: Vec::new(),
        splat_ids: Arc::new((0..splats.len() as u32).collect()),
        splats: Arc::new(splats),
    }
}

fn longest_axis(splats: &Splats, part: &[usize]) -> usize {
    let width = |axis: usize| {
        let values = part.iter().map(|ix| splats.means[*ix][axis]);
        let (low, high) = values.fold((f32::MAX, f32::MIN), |(a, b), v| (a.min(v), b.max(v)));
        high - low
    };
    (0..3)
        .max_by(|a, b| width(*a).total_cmp(&width(*b)))
        .unwrap_or(0)
}

/// Where a run's map lies.
pub fn is_saved(path: &str) -> bool {
    let path = PathBuf::from(path);
    let ending = path.extension().and_then(|ending| ending.to_str());
    path.is_dir() || matches!(ending, Some("splatmap" | "ply" | "spz"))
}
