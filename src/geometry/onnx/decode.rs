//! Numbers of a network -> cameras and depth maps, with a reason for every frame that has none.

use glam::{DQuat, DVec3};

use crate::geometry::onnx::sidecar::PoseKind;
use crate::pose::Rigid;

/// Numbers of a pose: t x y z, q x y z w, vertical and horizontal field of view.
pub const POSE_LENGTH: usize = 9;
/// Shorter quaternions point nowhere.
const MIN_QUATERNION: f64 = 1e-6;
/// No pinhole sees further.
const MAX_FOV_RAD: f64 = 3.0;
/// Models answer in scenes of about one unit. Beyond this their squares leave f32.
const MAX_LENGTH: f64 = 1e9;
/// Rounding of `1 + exp(x)` in half precision.
const MIN_CONFIDENCE: f32 = 0.999;

/// What came out of the network for one window, frame after frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    pub n_frames: usize,
    pub width: usize,
    pub height: usize,
    pub pose_enc: Vec<f32>,
    pub depth: Vec<f32>,
    pub depth_conf: Vec<f32>,
}

/// Why a frame has no camera or no depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    PoseNotFinite,
    QuaternionZero,
    FieldOfView,
    TooFar,
    Depth,
    Confidence,
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::PoseNotFinite => "a pose that is no number",
            Self::QuaternionZero => "a rotation of length 0",
            Self::FieldOfView => "a field of view outside 0 to 3 rad",
            Self::TooFar => "a length beyond 1e9",
            Self::Depth => "depth that is no number above 0",
            Self::Confidence => "confidence that is no number from 1 up",
        })
    }
}

/// A camera in the frame of its window, with focal lengths in pixels of the network's picture; its principal point
/// is the middle of that.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModelCamera {
    pub window_from_cam: Rigid,
    pub fx: f64,
    pub fy: f64,
}

impl Answer {
    pub fn depth_of(&self, frame: usize) -> &[f32] {
        let n = self.width * self.height;
        &self.depth[frame * n..(frame + 1) * n]
    }

    pub fn confidence_of(&self, frame: usize) -> &[f32] {
        let n = self.width * self.height;
        &self.depth_conf[frame * n..(frame + 1) * n]
    }

    /// Cameras in the frame of the first one that is whole, which models leave only near the identity.
    pub fn cameras(&self, kind: PoseKind) -> Vec<Result<ModelCamera, Fault>> {
        let encoded = self.pose_enc.chunks_exact(POSE_LENGTH);
        let mut cameras: Vec<_> = encoded
            .take(self.n_frames)
            .map(|numbers| camera(numbers, kind, (self.width, self.height)))
            .collect();
        let first = cameras.iter().flatten().next().map(|c| c.window_from_cam);
        let window_from_given = first.map_or(Rigid::IDENTITY, |pose| pose.inverse());
        let mut is_first = true;
        for camera in cameras.iter_mut().flatten() {
            // The inverse times itself is the identity but for rounding.
            camera.window_from_cam = if std::mem::take(&mut is_first) {
                Rigid::IDENTITY
            } else {
                (window_from_given * camera.window_from_cam).renormalized()
            };
        }
        cameras
    }

    /// What is wrong with the depth and confidence of a frame.
    pub fn fault_of(&self, frame: usize) -> Option<Fault> {
        let is_depth = |d: &f32| d.is_finite() && *d > 0.0;
        if !self.depth_of(frame).iter().all(is_depth) {
            return Some(Fault::Depth);
        }
        if self
            .depth_of(frame)
            .iter()
            .any(|d| f64::from(*d) > MAX_LENGTH)
        {
            return Some(Fault::TooFar);
        }
        let is_confidence = |c: &f32| c.is_finite() && *c >= MIN_CONFIDENCE;
        let confidences = self.confidence_of(frame);
        (!confidences.iter().all(is_confidence)).then_some(Fault::Confidence)
    }
}

fn camera(
    numbers: &[f32],
    kind: PoseKind,
    (width, height): (usize, usize),
) -> Result<ModelCamera, Fault> {
    let at = |i: usize| f64::from(numbers[i]);
    if !numbers.iter().all(|v| v.is_finite()) {
        return Err(Fault::PoseNotFinite);
    }
    let translation = DVec3::new(at(0), at(1), at(2));
    let rotation = DQuat::from_xyzw(at(3), at(4), at(5), at(6));
    if rotation.length() < MIN_QUATERNION {
        return Err(Fault::QuaternionZero);
    }
    let (fov_h, fov_w) = (at(7), at(8));
    let is_fov = |fov: f64| fov > 0.0 && fov < MAX_FOV_RAD;
    if !is_fov(fov_h) || !is_fov(fov_w) {
        return Err(Fault::FieldOfView);
    }
    if translation.length() > MAX_LENGTH {
        return Err(Fault::TooFar);
    }
    let given = Rigid::new(rotation.normalize(), translation);
    Ok(ModelCamera {
        window_from_cam: match kind {
            PoseKind::W2c => given.inverse(),
            PoseKind::C2w => given,
        },
        fx: 0.5 * width as f64 / (0.5 * fov_w).tan(),
        fy: 0.5 * height as f64 / (0.5 * fov_h).tan(),
    })
}
