//! Cameras, points and the observations that tie them: what bundle adjustment moves, what stays, and what came of it.

use std::ops::Range;

use glam::{DMat3, DVec2, DVec3};

use crate::optim::bundle::reduced::LENS;
use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

#[derive(Debug, Clone)]
pub struct Camera {
    pub cam_from_world: Rigid,
    pub intrinsics: Intrinsics,
    /// The lens shows what a pinhole has at radius r of the plane z = 1 at `r (1 + radial r^2)`: OpenCV's k1.
    pub radial: f64,
    pub is_fixed: bool,
    /// px^-2, over a shift and a turn in the camera's axes: what else than the observations is known of the pose,
    /// which speaks for leaving it where it starts.
    pub hold: Option<[[f64; 6]; 6]>,
    /// This camera's focal length and radial coefficient are those that `Settings` may move.
    pub shares_lens: bool,
}

#[derive(Debug, Clone, Copy)]
pub struct Observation {
    pub camera_ix: u32,
    pub pixel: DVec2,
    /// What a sensor measured of the point's distance.
    pub depth: Option<MeasuredDepth>,
}

/// The distance of a point along the camera's axis, by a depth camera or a stereo pair.
///
/// The residual is `px_per_inverse (1/z - inverse)`: in inverse depth the noise of triangulating sensors is the same at every
/// distance, and the factor brings it to the pixels' noise, so that one loss serves both (the third coordinate of a stereo
/// observation in Mur-Artal and Tardos 2017, section III-B).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredDepth {
    /// 1 / (units of the world).
    pub inverse: f64,
    /// Pixels that an error of 1 in `inverse` counts as.
    pub px_per_inverse: f64,
}

impl MeasuredDepth {
    /// The residual in pixels of a point at `z` before the camera.
    pub fn residual_px(&self, z: f64) -> f64 {
        self.px_per_inverse * (1.0 / z - self.inverse)
    }
}

/// A motion between two cameras that something other than the images measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelativeMotion {
    pub first_ix: u32,
    pub second_ix: u32,
    /// In units of the world.
    pub first_from_second: Rigid,
    /// Standard deviations: along each axis in units of the world, about each axis in radians.
    pub std: [f64; 2],
}

/// Points are added with `add_point`, which keeps their observations side by side.
#[derive(Debug, Clone, Default)]
pub struct Problem {
    pub cameras: Vec<Camera>,
    pub points: Vec<DVec3>,
    pub(crate) observations: Vec<Observation>,
    /// By point: where its observations end.
    pub(crate) ends: Vec<usize>,
    /// Between cameras, by odometry.
    pub motions: Vec<RelativeMotion>,
}

impl Problem {
    pub fn add_point(&mut self, point: DVec3, seen: impl IntoIterator<Item = Observation>) {
        self.points.push(point);
        self.observations.extend(seen);
        self.ends.push(self.observations.len());
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Settings {
    pub max_steps: usize,
    /// Residual at which Cauchy's loss starts to bend.
    pub loss_px: f64,
    pub refine_focal: bool,
    pub refine_radial: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    pub cost_before: f64,
    pub cost_after: f64,
    pub n_steps: usize,
    /// Of the radial coefficient, where it was refined.
    pub radial: Option<RadialReport>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RadialReport {
    /// Standard deviation.
    pub std: f64,
    /// By what share the weighted squares of the errors would grow without it.
    pub gain: f64,
}

/// What moves.
#[derive(Debug, Clone)]
pub(crate) struct State {
    pub(crate) cameras: Vec<Camera>,
    pub(crate) points: Vec<DVec3>,
}

impl State {
    pub(crate) fn rotations(&self) -> Vec<DMat3> {
        let poses = self.cameras.iter().map(|c| &c.cam_from_world);
        poses.map(Rigid::rotation_matrix).collect()
    }
}

/// What stays.
#[derive(Debug)]
pub(crate) struct Flat<'a> {
    pub(crate) observations: &'a [Observation],
    pub(crate) ends: &'a [usize],
    pub(crate) motions: &'a [RelativeMotion],
    pub(crate) start: Vec<Camera>,
    pub(crate) loss_px: f64,
    pub(crate) moves: [bool; LENS],
}

impl Flat<'_> {
    pub(crate) fn moves_lens(&self) -> bool {
        self.moves.contains(&true)
    }

    pub(crate) fn seen(&self, points: Range<usize>) -> &[Observation] {
        let start = |ix: usize| ix.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.observations[start(points.start)..start(points.end)]
    }

    /// Ranges of points with about equally many observations.
    pub(crate) fn chunks(&self, n: usize) -> Vec<Range<usize>> {
        let bound = |i: usize| {
            let before = self.observations.len() * i / n;
            if i == n {
                self.ends.len()
            } else {
                self.ends.partition_point(|end| *end < before)
            }
        };
        (0..n).map(|i| bound(i)..bound(i + 1)).collect()
    }
}

/// Pixel of a point in the camera, and the plane z = 1 it went through; `None` behind the camera, or where the
/// radial polynomial has folded.
pub(crate) fn project(camera: &Camera, point_in_cam: DVec3) -> Option<(DVec2, DVec2, f64)> {
    if point_in_cam.z <= 1e-9 {
        return None;
    }
    let plane = point_in_cam.truncate() / point_in_cam.z;
    let bend = camera.radial * plane.length_squared();
    let i = &camera.intrinsics;
    let stretch = 1.0 + bend;
    (3.0 * bend > -1.0).then(|| {
        let pixel = DVec2::new(
            i.fx * stretch * plane.x + i.cx,
            i.fy * stretch * plane.y + i.cy,
        );
        (pixel, plane, stretch)
    })
}

/// How far a camera has moved from where it is held: shift, then turn.
pub(crate) fn strayed(camera: &Camera, start: &Camera) -> [f64; 6] {
    let motion = camera.cam_from_world * start.cam_from_world.inverse();
    let (shift, turn) = (motion.translation, motion.rotation.to_scaled_axis());
    [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z]
}

pub(crate) fn times(matrix: &[[f64; 6]; 6], v: &[f64; 6]) -> [f64; 6] {
    std::array::from_fn(|i| (0..6).map(|j| matrix[i][j] * v[j]).sum())
}
