//! Landmarks of keyframes <-> bytes in a map file, so that a later run finds its place in the map.
//!
//! CDR, little endian. Bytes may come from anywhere: what is no landmark is refused, and nothing is sized by a number in
//! them.

use std::sync::{Arc, Weak};

use byteorder::LittleEndian;
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::track::landmarks::{Landmark, Landmarks, StoredKeyframe};
use crate::track::observation::{Observation, THUMBNAIL_LEN};
use crate::working_camera::WorkingCamera;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// More than any map has.
const MAX_KEYFRAMES: usize = 1_000_000;
const MAX_LANDMARKS: usize = 100_000;

#[derive(Debug, Serialize, Deserialize)]
struct Saved {
    keyframes: Vec<Keyframe>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Keyframe {
    id: u32,
    nanos: i64,
    frame_px: [u32; 2],
    working_px: [u32; 2],
    /// One where the source stated it.
    stated: Vec<Pinhole>,
    pinhole: Pinhole,
    /// One where the image is no pinhole's.
    lens: Vec<SavedCameraModel>,
    /// Quaternion w x y z, translation.
    world_from_cam: [f64; 7],
    /// 6 rows where the pose's covariance is known.
    covariance: Vec<[f64; 6]>,
    thumbnail: Vec<f32>,
    landmarks: Vec<Point>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Pinhole {
    size_px: [u32; 2],
    focal: [f64; 2],
    centre: [f64; 2],
}

#[derive(Debug, Serialize, Deserialize)]
struct SavedCameraModel {
    pinhole: Pinhole,
    /// 0 none, 1 plumb_bob, 2 rational, 3 equidistant.
    kind: u8,
    coefficients: Vec<f64>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Point {
    in_cam: [f64; 3],
    bits: [u64; 4],
    level: f32,
}

/// What a later run needs to find its place.
pub(crate) fn landmark_bytes(landmarks: &Landmarks) -> Result<Vec<u8>, String> {
    let keyframes = landmarks.held.values().map(Keyframe::of).collect();
    cdr_encoding::to_vec::<Saved, LittleEndian>(&Saved { keyframes }).map_err(|e| e.to_string())
}

/// Keyframes as a map file has them.
pub(crate) fn parse_landmarks(bytes: &[u8]) -> Result<Vec<StoredKeyframe>, String> {
    // Lists grow as their content is read, never by a number that only claims it.
    let (saved, _) = cdr_encoding::from_bytes::<Saved, LittleEndian>(bytes)
        .map_err(|e| format!("landmarks do not decode: {e}"))?;
    if saved.keyframes.len() > MAX_KEYFRAMES {
        return Err(format!("landmarks of {} keyframes", saved.keyframes.len()));
    }
    let keyframe = |(ix, keyframe): (usize, Keyframe)| {
        let id = keyframe.id;
        keyframe
            .held(ix as u64)
            .ok_or_else(|| format!("landmarks of keyframe {id} are none"))
    };
    saved
        .keyframes
        .into_iter()
        .enumerate()
        .map(keyframe)
        .collect()
}

impl Keyframe {
    fn of(held: &StoredKeyframe) -> Self {
        let (q, t) = (
            held.world_from_cam.rotation,
            held.world_from_cam.translation,
        );
        let seen = &held.seen;
        let point = |landmark: &Landmark| Point {
            in_cam: landmark.point_in_cam.to_array(),
            bits: landmark.bits,
            level: landmark.level,
        };
        Self {
            id: held.id,
            nanos: seen.stamp.nanos,
            frame_px: seen.frame_px.into(),
            working_px: seen.working_px.into(),
            stated: seen.intrinsics.iter().map(Pinhole::of).collect(),
            pinhole: Pinhole::of(&held.camera.pinhole),
            lens: held.camera.lens.iter().map(SavedCameraModel::of).collect(),
            world_from_cam: [q.w, q.x, q.y, q.z, t.x, t.y, t.z],
            covariance: held.covariance.map_or_else(Vec::new, Vec::from),
            thumbnail: seen.thumbnail.clone(),
            landmarks: held.landmarks.iter().map(point).collect(),
        }
    }

    /// `None` where a number is none or a length is wrong. `ix` among the keyframes.
    fn held(self, ix: u64) -> Option<StoredKeyframe> {
        let [w, x, y, z, tx, ty, tz] = self.world_from_cam;
        let world_from_cam = Rigid::new(DQuat::from_xyzw(x, y, z, w), DVec3::new(tx, ty, tz));
        let is_pose =
            world_from_cam.is_finite() && (world_from_cam.rotation.length() - 1.0).abs() < 1e-6;
        let is_thumbnail = self.thumbnail.is_empty() || self.thumbnail.len() == THUMBNAIL_LEN;
        let fits = is_pose
            && is_thumbnail
            && self.thumbnail.iter().all(|v| v.is_finite())
            && self.landmarks.len() <= MAX_LANDMARKS
            && self.frame_px.iter().chain(&self.working_px).all(|n| *n > 0);
        let covariance = match <[[f64; 6]; 6]>::try_from(self.covariance) {
            Ok(rows) => Some(rows).filter(|rows| rows.as_flattened().iter().all(|v| v.is_finite())),
            Err(_) => None,
        };
        let landmarks: Option<Vec<Landmark>> = self.landmarks.iter().map(Point::landmark).collect();
        let lens = match self.lens.first() {
            Some(distorted) => Some(distorted.lens()?),
            None => None,
        };
        let stated = match self.stated.first() {
            Some(pinhole) => Some(pinhole.intrinsics()?),
            None => None,
        };
        let seen = Observation {
            // Frames of a later run are none of these.
            seq: u64::MAX - ix,
            stamp: Stamp::from_nanos(self.nanos),
            intrinsics: stated,
            frame_px: self.frame_px.into(),
            working_px: self.working_px.into(),
            pixels: Vec::new(),
            levels: Vec::new(),
            bits: Vec::new(),
            thumbnail: self.thumbnail,
        };
        let landmarks = landmarks.filter(|_| fits)?;
        Some(StoredKeyframe {
            id: self.id,
            seen: Arc::new(seen),
            world_from_cam,
            camera: WorkingCamera {
                pinhole: self.pinhole.intrinsics()?,
                lens,
            },
            covariance,
            depths: landmarks
                .iter()
                .enumerate()
                .map(|(i, l)| (i as u32, l.point_in_cam.z as f32))
                .collect(),
            landmarks,
            unit: 1.0,
            depth: Weak::new(),
        })
    }
}

impl Point {
    fn landmark(&self) -> Option<Landmark> {
        let point_in_cam = DVec3::from_array(self.in_cam);
        let is_sound = point_in_cam.is_finite()
            && point_in_cam.z > 0.0
            && self.level.is_finite()
            && self.level > 0.0;
        is_sound.then_some(Landmark {
            point_in_cam,
            bits: self.bits,
            level: self.level,
        })
    }
}

impl Pinhole {
    fn of(i: &Intrinsics) -> Self {
        Self {
            size_px: [i.width_px, i.height_px],
            focal: [i.fx, i.fy],
            centre: [i.cx, i.cy],
        }
    }

    fn intrinsics(&self) -> Option<Intrinsics> {
        let i = Intrinsics {
            width_px: self.size_px[0],
            height_px: self.size_px[1],
            fx: self.focal[0],
            fy: self.focal[1],
            cx: self.centre[0],
            cy: self.centre[1],
        };
        i.is_plausible().then_some(i)
    }
}

impl SavedCameraModel {
    fn of(lens: &CameraModel) -> Self {
        let (kind, coefficients) = match lens.distortion {
            Distortion::None => (0, Vec::new()),
            Distortion::PlumbBob(k) => (1, k.to_vec()),
            Distortion::Rational(k) => (2, k.to_vec()),
            Distortion::Equidistant(k) => (3, k.to_vec()),
        };
        Self {
            pinhole: Pinhole::of(&lens.intrinsics),
            kind,
            coefficients,
        }
    }

    fn lens(&self) -> Option<CameraModel> {
        let k = self.coefficients.as_slice();
        let distortion = match self.kind {
            0 => Distortion::None,
            1 => Distortion::PlumbBob(k.try_into().ok()?),
            2 => Distortion::Rational(k.try_into().ok()?),
            3 => Distortion::Equidistant(k.try_into().ok()?),
            _ => return None,
        };
        let lens = CameraModel {
            intrinsics: self.pinhole.intrinsics()?,
            distortion,
        };
        distortion.is_finite().then_some(lens)
    }
}
