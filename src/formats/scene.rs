//! A map with its images -> a scene of COLMAP or nerfstudio, for those who train elsewhere: images, refined poses, a cloud of points.
//!
//! A map keeps at most `map.save_images_mib` of images, at the size that it was trained on, undistorted; its other keyframes are left out.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::formats::axes;
use splat_io::scene_formats::written::{self, WrittenView};
use splat_slam::mapper::map_file::checkpoint::Checkpoint;
use splat_types::camera::{CameraModel, Distortion};
use splat_types::snapshot::KeyframePose;
use splat_types::sparse_point::SparsePoint;
use splat_types::splats::splats::Splats;

/// The cloud starts the training of another program: more points than this only cost time there.
const MAX_POINTS: usize = 100_000;
/// Splats that are more transparent are no surface.
const MIN_OPACITY: f32 = 0.5;

/// How the scene lies on the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SceneLayout {
    /// `images/` and the text files of `sparse/0`.
    Colmap,
    /// `images/`, `transforms.json` and `sparse_pc.ply`; held-out keyframes are in `test_filenames`.
    Nerfstudio,
}

impl SceneLayout {
    /// By the name that a user gives.
    pub const NAMES: [(&'static str, Self); 2] =
        [("colmap", Self::Colmap), ("nerfstudio", Self::Nerfstudio)];
}

#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    #[error(
        "the map holds no images of keyframes: map again with map.save_images_mib above 0, or name a .splatmap and not a .ply"
    )]
    NoImages,
    #[error("the folder is not empty; name another one: {}", path.display())]
    NotEmpty { path: PathBuf },
    #[error("the image of keyframe {keyframe_id} cannot be read: {reason}")]
    Image { keyframe_id: u32, reason: String },
    #[error("cannot write the scene: {reason}: {}", path.display())]
    Write { reason: String, path: PathBuf },
}

/// Writes the scene into `out`, a folder that is new or empty -> the number of images.
pub fn write(map: &Checkpoint, layout: SceneLayout, out: &Path) -> Result<usize, SceneError> {
    let fault = |path: &Path| {
        let path = path.to_owned();
        move |e: io::Error| SceneError::Write {
            reason: e.to_string(),
            path,
        }
    };
    if map.views.is_empty() {
        return Err(SceneError::NoImages);
    }
    let images = out.join("images");
    fs::create_dir_all(out).map_err(fault(out))?;
    if fs::read_dir(out).map_err(fault(out))?.next().is_some() {
        return Err(SceneError::NotEmpty {
            path: out.to_owned(),
        });
    }
    fs::create_dir_all(&images).map_err(fault(&images))?;
    let poses = map.snapshot.poses.iter();
    let poses: BTreeMap<u32, &KeyframePose> = poses.map(|pose| (pose.keyframe_id, pose)).collect();
    let mut views = Vec::new();
    for view in &map.views {
        let Some(pose) = poses.get(&view.keyframe_id) else {
            continue;
        };
        let jpeg = view.jpeg().map_err(|e| SceneError::Image {
            keyframe_id: view.keyframe_id,
            reason: e.to_string(),
        })?;
        let file = format!("keyframe_{:06}.jpg", view.keyframe_id);
        let path = images.join(&file);
        fs::write(&path, jpeg).map_err(fault(&path))?;
        views.push(WrittenView {
            name: match layout {
                SceneLayout::Colmap => file,
                SceneLayout::Nerfstudio => format!("images/{file}"),
            },
            world_from_cam: pose.world_from_cam,
            lens: CameraModel {
                intrinsics: pose.intrinsics,
                distortion: Distortion::None,
            },
            is_held_out: view.is_held_out,
        });
    }
    let points = cloud(&map.snapshot.splats, &views);
    let files = match layout {
        SceneLayout::Colmap => written::colmap(&views, &points),
        SceneLayout::Nerfstudio => written::nerfstudio(&views, &points),
    };
    for (name, text) in files {
        let path = out.join(name);
        let written = fs::create_dir_all(path.parent().unwrap_or(out));
        let written = written.and_then(|()| fs::write(&path, text));
        written.map_err(fault(&path))?;
    }
    Ok(views.len())
}

/// Centres of opaque splats, each with the view that is nearest to it: COLMAP wants one.
fn cloud(splats: &Splats, views: &[WrittenView]) -> Vec<(SparsePoint, usize)> {
    let opaque = axes::finite(splats).into_iter();
    let opaque: Vec<usize> = opaque
        .filter(|ix| axes::opacity(splats.opacity_logits[*ix]) >= MIN_OPACITY)
        .collect();
    let every = opaque.len().div_ceil(MAX_POINTS).max(1);
    let nearest = |place: DVec3| {
        let distance = |view: &WrittenView| view.world_from_cam.translation.distance(place);
        let all = views.iter().enumerate();
        all.min_by(|(_, a), (_, b)| distance(a).total_cmp(&distance(b)))
            .map(|(ix, _)| ix)
    };
    let point = |ix: &usize| {
        let place = DVec3::from(splats.means[*ix].map(f64::from));
        let byte = |share: f32| (255.0 * share).round().clamp(0.0, 255.0) as u8;
        let found = SparsePoint {
            position_in_gt: place,
            rgb: axes::base_colour(splats, *ix).map(byte),
            error_px: 1.0,
            n_images: 1,
        };
        Some((found, nearest(place)?))
    };
    opaque.iter().step_by(every).filter_map(point).collect()
}
