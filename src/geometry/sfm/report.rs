//! The scene -> what changed since it was last told: new views, moved poses, why shots are missing.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use super::scene::{NONE, Scene};
use super::starting::{Start, parallax_deg};
use crate::camera::{Intrinsics, Lens};
use crate::geometry::two_view::median;
use crate::geometry::uncertainty::pose_covariance;
use crate::geometry::{Health, Revision};
use crate::pose::Rigid;

/// Exact words of the final error for a camera at rest; other modules and users look for them.
pub const NO_PARALLAX: &str = "no parallax was seen between keyframes";
/// A pose that moved less needs no telling: 0.05 px at 500 px focal length, and as much of the median depth.
const MOVED: f64 = 1e-4;
/// Landmarks of a shot that tell by how much what it sees has grown, at least and at most, and growth that is worth telling.
const MIN_DEPTHS: usize = 8;
const MAX_DEPTHS: usize = 64;
const RESIZED: f64 = 2e-3;

/// A landmark in a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    pub point_in_batch: DVec3,
    /// The same number for the same point in all views.
    pub landmark: u32,
    /// In the keyframe's picture, straightened where its lens bends.
    pub pixel: DVec2,
}

/// A keyframe that sees the same landmarks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    pub keyframe_id: u32,
    pub n_shared: u32,
    /// Median angle between the two rays to a shared landmark.
    pub angle_deg: f64,
}

/// A placed keyframe without dense depth.
#[derive(Debug, Clone)]
pub struct SparseView {
    pub keyframe_id: u32,
    pub component: u32,
    /// At the size of the keyframe's picture.
    pub intrinsics: Intrinsics,
    /// As in `View`.
    pub lens: Option<Lens>,
    pub batch_from_cam: Rigid,
    pub health: Health,
    pub landmarks: Vec<Sighting>,
    /// Most useful first: many shared landmarks, seen at an angle of some degrees.
    pub neighbours: Vec<Neighbour>,
}

#[derive(Debug, Clone, Default)]
pub struct SparseBatch {
    pub batch_id: u32,
    pub views: Vec<SparseView>,
    /// Views given earlier that moved, or whose focal length did.
    pub revised: Vec<Revision>,
    /// As in `GeometryBatch`.
    pub is_loop: bool,
    pub note: Option<String>,
}

/// What has been told of each keyframe.
#[derive(Debug, Default)]
pub(super) struct Told {
    cameras: BTreeMap<usize, Revision>,
    /// Some of the landmarks that each saw then, and their distance along its axis.
    depths: BTreeMap<usize, Vec<(u32, f64)>>,
}

impl Told {
    /// Views of shots placed since last time and of `again`, and poses that moved.
    pub(super) fn changes(&mut self, scene: &Scene, again: &[usize]) -> SparseBatch {
        let mut out = SparseBatch::default();
        for (shot_ix, shot) in scene.shots.iter().enumerate() {
            let Some(placed) = &shot.placed else { continue };
            let keyframe_id = shot.keyframe.id;
            let Some(intrinsics) = scene.intrinsics_of(keyframe_id) else {
                continue;
            };
            let here = Revision {
                keyframe_id,
                component: placed.component,
                intrinsics,
                batch_from_cam: placed.cam_from_map.inverse(),
                depth_factor: self.depth_factor(scene, shot_ix),
            };
            let before = self.cameras.insert(shot_ix, here);
            if before.is_none() || again.contains(&shot_ix) {
                out.views.extend(view(scene, shot_ix));
                self.depths.insert(shot_ix, depths(scene, shot_ix));
            }
            if let Some(before) = before {
                let (old, new) = (before.batch_from_cam, here.batch_from_cam);
                let moved = before.component != here.component
                    || old.angle_to(&new) > MOVED
                    || old.translation.distance(new.translation) > MOVED
                    || (before.intrinsics.fx / intrinsics.fx - 1.0).abs() > MOVED
                    || (here.depth_factor - 1.0).abs() > RESIZED;
                if moved {
                    out.revised.push(here);
                    self.depths.insert(shot_ix, depths(scene, shot_ix));
                } else {
                    // Small moves add up: compare with what was told.
                    self.cameras.insert(shot_ix, before);
                }
            }
        }
        out
    }
}

impl Told {
    /// How much farther a shot sees the same landmarks than when it was told; 1 where that is within their noise.
    fn depth_factor(&self, scene: &Scene, shot_ix: usize) -> f64 {
        let Some(placed) = &scene.shots[shot_ix].placed else {
            return 1.0;
        };
        let told = self.depths.get(&shot_ix).map_or(&[][..], Vec::as_slice);
        let log = |&(landmark, then): &(u32, f64)| {
            let landmark = &scene.landmarks[landmark as usize];
            let is_seen = landmark.seen.iter().any(|at| at.0 as usize == shot_ix);
            let now = placed.cam_from_map.transform_point(landmark.point).z;
            (is_seen && now > 0.0 && then > 0.0).then(|| (now / then).ln())
        };
        let mut logs: Vec<f64> = told.iter().filter_map(log).collect();
        let is_enough = logs.len() >= MIN_DEPTHS;
        let factor = median(&mut logs).filter(|_| is_enough).unwrap_or(0.0).exp();
        if (factor - 1.0).abs() > RESIZED {
            factor
        } else {
            1.0
        }
    }
}

/// Landmarks of a shot and their distance, evenly picked.
fn depths(scene: &Scene, shot_ix: usize) -> Vec<(u32, f64)> {
    let shot = &scene.shots[shot_ix];
    let Some(placed) = &shot.placed else {
        return Vec::new();
    };
    let seen: Vec<u32> = shot
        .landmark_of
        .iter()
        .copied()
        .filter(|l| *l != NONE)
        .collect();
    let stride = seen.len().div_ceil(MAX_DEPTHS).max(1);
    let z = |l: u32| {
        placed
            .cam_from_map
            .transform_point(scene.landmarks[l as usize].point)
            .z
    };
    seen.into_iter()
        .step_by(stride)
        .map(|l| (l, z(l)))
        .collect()
}

/// One sentence on what is missing; `None` when all is placed in one frame.
pub(super) fn note(scene: &Scene, start: Option<Start>) -> Option<String> {
    let waiting: Vec<u32> = scene
        .shots
        .iter()
        .filter(|s| s.placed.is_none())
        .map(|s| s.keyframe.id)
        .collect();
    if waiting.len() == scene.shots.len() {
        let why = match start {
            Some(Start::NoMatches) => ": their pictures share too few distinct points",
            Some(Start::Unstable) => " that a scene could be built on",
            _ => "",
        };
        return Some(format!("{NO_PARALLAX}{why}"));
    }
    let n_components = scene
        .components
        .iter()
        .filter(|c| !c.shots.is_empty())
        .count();
    if waiting.is_empty() {
        return (n_components > 1).then(|| {
            format!("the keyframes form {n_components} parts that share too few landmarks")
        });
    }
    let shown: Vec<String> = waiting.iter().take(10).map(u32::to_string).collect();
    let more = if waiting.len() > 10 { ", ..." } else { "" };
    Some(format!(
        "{} of {} keyframes wait for landmarks that agree: {}{more}",
        waiting.len(),
        scene.shots.len(),
        shown.join(", ")
    ))
}

fn view(scene: &Scene, shot_ix: usize) -> Option<SparseView> {
    let shot = &scene.shots[shot_ix];
    let placed = shot.placed.as_ref()?;
    let intrinsics = scene.intrinsics_of(shot.keyframe.id)?;
    // Two pinholes of one camera that differ in size, and where the picture was straightened in their view.
    let to_picture = DVec2::new(intrinsics.fx / shot.lens.fx, intrinsics.fy / shot.lens.fy);
    let centre = DVec2::new(shot.lens.cx, shot.lens.cy);
    let in_picture =
        |pixel: DVec2| (pixel - centre) * to_picture + DVec2::new(intrinsics.cx, intrinsics.cy);
    let mut landmarks = Vec::new();
    let (mut errors, mut sights) = (Vec::new(), Vec::new());
    for (feature, &landmark) in shot
        .landmark_of
        .iter()
        .enumerate()
        .filter(|(_, l)| **l != NONE)
    {
        let at = (shot_ix as u32, feature as u32);
        let point_in_batch = scene.landmarks[landmark as usize].point;
        errors.extend(scene.sight(at).map(|s| s.error_px(point_in_batch)));
        sights.push((point_in_batch, scene.pixel(at)));
        landmarks.push(Sighting {
            point_in_batch,
            landmark,
            pixel: in_picture(scene.pixel(at)),
        });
    }
    let health = Health {
        n_inliers: landmarks.len() as u32,
        parallax_deg: parallax_deg(scene, shot_ix),
        reprojection_px: median(&mut errors).unwrap_or(0.0),
        covariance: pose_covariance(&placed.cam_from_map, &shot.lens, &sights),
    };
    Some(SparseView {
        keyframe_id: shot.keyframe.id,
        component: placed.component,
        intrinsics,
        lens: scene.straight.of(shot).map(|s| s.0),
        batch_from_cam: placed.cam_from_map.inverse(),
        health,
        landmarks,
        neighbours: neighbours(scene, shot_ix),
    })
}

fn neighbours(scene: &Scene, shot_ix: usize) -> Vec<Neighbour> {
    let Some(own) = scene.centre(shot_ix) else {
        return Vec::new();
    };
    let mut angles: BTreeMap<u32, Vec<f64>> = BTreeMap::new();
    for &landmark in scene.shots[shot_ix]
        .landmark_of
        .iter()
        .filter(|l| **l != NONE)
    {
        let landmark = &scene.landmarks[landmark as usize];
        for &(other, _) in landmark.seen.iter().filter(|s| s.0 as usize != shot_ix) {
            let Some(centre) = scene.centre(other as usize) else {
                continue;
            };
            let (a, b) = (own - landmark.point, centre - landmark.point);
            angles
                .entry(other)
                .or_default()
                .push(a.cross(b).length().atan2(a.dot(b)).to_degrees());
        }
    }
    let neighbour = |(other, mut angles): (u32, Vec<f64>)| Neighbour {
        keyframe_id: scene.shots[other as usize].keyframe.id,
        n_shared: angles.len() as u32,
        angle_deg: median(&mut angles).unwrap_or(0.0),
    };
    // Matching wants an angle of about 6 degrees (GEOMETRY.md 3): less tells no depth, more changes the picture.
    let worth = |n: &Neighbour| {
        let off = (n.angle_deg.max(0.01) / 6.0).ln();
        f64::from(n.n_shared) * (-0.5 * off * off).exp()
    };
    let mut found: Vec<Neighbour> = angles.into_iter().map(neighbour).collect();
    found.sort_by(|a, b| {
        worth(b)
            .total_cmp(&worth(a))
            .then(a.keyframe_id.cmp(&b.keyframe_id))
    });
    found
}
