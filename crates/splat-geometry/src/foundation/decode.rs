//! Numbers of a network -> cameras and depth maps, with a reason for every frame that has none.

use glam::{DQuat, DVec3};

use crate::foundation::sidecar::PoseKind;
use splat_types::transform::Rigid;

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

/// Depths that differ by less, all over a window, are no scene but a network that says nothing.
const MIN_SPREAD: f32 = 1e-3;
/// Pixels whose confidence is less than this share of the median are not used (VGGT-Long).
const MIN_TRUST: f32 = 0.1;
/// Pixels of a window that its quantiles are taken from.
const MAX_SAMPLES: usize = 100_000;

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

/// A camera in the frame of its window, with focal lengths in pixels of the network's image; its principal point
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

impl Answer {
    /// Whether nine tenths of the depths of these frames are the same.
    pub fn is_flat(&self, frames: &[usize]) -> bool {
        let depths = self.samples(frames, &self.depth);
        let at = |share: usize| depths.get(depths.len().saturating_sub(1) * share / 20);
        at(1)
            .zip(at(19))
            .is_none_or(|(near, far)| far / near < 1.0 + MIN_SPREAD)
    }

    /// Of all pixels of these frames; confidences of one window share one scale.
    pub fn median_confidence(&self, frames: &[usize]) -> f32 {
        let all = self.samples(frames, &self.depth_conf);
        all.get(all.len() / 2).copied().unwrap_or(1.0)
    }

    /// Evenly spread and sorted.
    fn samples(&self, frames: &[usize], of: &[f32]) -> Vec<f32> {
        let n = self.width * self.height;
        let stride = (frames.len() * n).div_ceil(MAX_SAMPLES).max(1);
        let all = frames
            .iter()
            .flat_map(|frame| &of[frame * n..(frame + 1) * n]);
        let mut samples: Vec<f32> = all.step_by(stride).copied().collect();
        samples.sort_by(f32::total_cmp);
        samples
    }
}

/// A model's confidence, from 1 up without end -> ours, from 0 to 1: the share of the median of the window, of which
/// more counts no more. A model that is equally sure everywhere is trusted everywhere.
pub fn trust(confidence: f32, median: f32) -> f32 {
    let share = (confidence - 1.0) / (median - 1.0);
    if median <= 1.0 {
        return 1.0;
    }
    if share < MIN_TRUST {
        0.0
    } else {
        share.min(1.0)
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Two frames of 2x1 pixels.
    fn answer(second: [f32; 9]) -> Answer {
        let first = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 2.0, 1.0, 1.2];
        Answer {
            n_frames: 2,
            width: 2,
            height: 1,
            pose_enc: [first, second].concat(),
            depth: vec![1.0, 2.0, 3.0, 4.0],
            depth_conf: vec![1.0, 2.0, 3.0, 5.0],
        }
    }

    const SECOND: [f32; 9] = [2.0, 2.0, 3.0, 0.0, 0.0, 3.0, 3.0, 1.0, 1.2];

    #[test]
    fn poses_are_given_from_the_first_frame_either_way_round() {
        // A quarter turn about z; the quaternion needs no unit length.
        let cam_from_window = Rigid::new(
            DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2),
            DVec3::new(2.0, 2.0, 3.0),
        );
        let first = Rigid::new(DQuat::IDENTITY, DVec3::new(1.0, 2.0, 3.0));
        let cases = [
            (PoseKind::W2c, first * cam_from_window.inverse()),
            (PoseKind::C2w, first.inverse() * cam_from_window),
        ];
        for (kind, expected) in cases {
            let cameras = answer(SECOND).cameras(kind);
            let pose = |i: usize| cameras[i].unwrap().window_from_cam;
            assert_eq!(pose(0), Rigid::IDENTITY);
            assert!(pose(1).translation.distance(expected.translation) < 1e-12);
            assert!(pose(1).angle_to(&expected) < 1e-7);
            let camera = cameras[1].unwrap();
            assert!((camera.fy - 0.5 / 0.5f64.tan()).abs() < 1e-7);
            assert!((camera.fx - 1.0 / 0.6f64.tan()).abs() < 1e-7);
        }
    }

    #[test]
    fn numbers_that_are_no_camera_are_named() {
        for (at, value, expected) in [
            (0, f32::NAN, Fault::PoseNotFinite),
            (8, f32::INFINITY, Fault::PoseNotFinite),
            (1, 1e20, Fault::TooFar),
            (7, 0.0, Fault::FieldOfView),
            (8, 3.1, Fault::FieldOfView),
            (8, -1.0, Fault::FieldOfView),
        ] {
            let mut second = SECOND;
            second[at] = value;
            let cameras = answer(second).cameras(PoseKind::W2c);
            assert_eq!(cameras[1], Err(expected));
            assert!(cameras[0].is_ok());
        }
        let mut second = SECOND;
        second[3..7].fill(0.0);
        let cameras = answer(second).cameras(PoseKind::W2c);
        assert_eq!(cameras[1], Err(Fault::QuaternionZero));
    }

    #[test]
    fn depth_and_confidence_that_are_none_are_named() {
        for (depth, confidence, expected) in [
            (1.0, 1.0, None),
            (0.0, 1.0, Some(Fault::Depth)),
            (f32::NAN, 1.0, Some(Fault::Depth)),
            (f32::INFINITY, 1.0, Some(Fault::Depth)),
            (1e10, 1.0, Some(Fault::TooFar)),
            (1.0, 0.5, Some(Fault::Confidence)),
            (1.0, f32::NAN, Some(Fault::Confidence)),
            (1.0, f32::INFINITY, Some(Fault::Confidence)),
        ] {
            let mut answer = answer(SECOND);
            (answer.depth[3], answer.depth_conf[3]) = (depth, confidence);
            assert_eq!((answer.fault_of(0), answer.fault_of(1)), (None, expected));
        }
    }

    #[test]
    fn trust_is_the_share_of_the_median() {
        let answer = answer(SECOND);
        assert_eq!(answer.median_confidence(&[0, 1]), 3.0);
        let trusts = [1.0, 1.1, 2.0, 3.0, 50.0].map(|c| trust(c, 3.0));
        assert_eq!(trusts, [0.0, 0.0, 0.5, 1.0, 1.0]);
        assert_eq!(trust(1.0, 1.0), 1.0);
    }

    #[test]
    fn depth_that_is_the_same_everywhere_is_flat() {
        let mut answer = answer(SECOND);
        assert!(!answer.is_flat(&[0, 1]));
        answer.depth = vec![2.0, 2.0, 2.0005, 2.0];
        assert!(answer.is_flat(&[0, 1]) && answer.is_flat(&[]));
    }
}
