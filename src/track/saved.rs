//! Landmarks of keyframes <-> bytes in a map file, so that a later run finds its place in the map.
//!
//! CDR, little endian. Bytes may come from anywhere: what is no landmark is refused, and nothing is sized by a number in
//! them.

use std::sync::{Arc, Weak};

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::Tracker;
use super::landmarks::{Held, Landmark};
use super::seen::{Camera, Seen, THUMBNAIL_LEN};
use crate::camera::{Distortion, Intrinsics, Lens};
use crate::clock::Stamp;
use crate::config::track::TrackParams;
use crate::pose::Rigid;
use crate::ros;

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
    /// One where the picture is no pinhole's.
    lens: Vec<Bent>,
    /// Quaternion w x y z, translation.
    map_from_cam: [f64; 7],
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
struct Bent {
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

impl Tracker {
    /// What a later run needs to find its place.
    pub fn saved(&self) -> Result<Vec<u8>, String> {
        let keyframes = self.landmarks.held.values().map(Keyframe::of).collect();
        ros::to_cdr(&Saved { keyframes }).map_err(|e| e.to_string())
    }

    /// A tracker in a map that was saved; it begins without any idea of where it is.
    pub fn in_saved(bytes: &[u8], params: &TrackParams) -> Result<Self, String> {
        let saved: Saved = ros::from_cdr(bytes).map_err(|e| e.to_string())?;
        if saved.keyframes.len() > MAX_KEYFRAMES {
            return Err(format!("landmarks of {} keyframes", saved.keyframes.len()));
        }
        let mut tracker = Self::new(params);
        for (ix, keyframe) in saved.keyframes.into_iter().enumerate() {
            let id = keyframe.id;
            let held = keyframe
                .held(ix as u64)
                .ok_or_else(|| format!("landmarks of keyframe {id} are none"))?;
            tracker.keyframes.insert(id, (held.map_from_cam, held.unit));
            tracker.landmarks.held.insert(id, held);
        }
        Ok(tracker)
    }

    /// Keyframes that can be recognised.
    pub fn n_keyframes(&self) -> usize {
        self.landmarks.held.len()
    }
}

impl Keyframe {
    fn of(held: &Held) -> Self {
        let (q, t) = (held.map_from_cam.rotation, held.map_from_cam.translation);
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
            lens: held.camera.lens.iter().map(Bent::of).collect(),
            map_from_cam: [q.w, q.x, q.y, q.z, t.x, t.y, t.z],
            covariance: held.covariance.map_or_else(Vec::new, Vec::from),
            thumbnail: seen.thumbnail.clone(),
            landmarks: held.landmarks.iter().map(point).collect(),
        }
    }

    /// `None` where a number is none or a length is wrong. `ix` among the keyframes.
    fn held(self, ix: u64) -> Option<Held> {
        let [w, x, y, z, tx, ty, tz] = self.map_from_cam;
        let map_from_cam = Rigid::new(DQuat::from_xyzw(x, y, z, w), DVec3::new(tx, ty, tz));
        let is_pose =
            map_from_cam.is_finite() && (map_from_cam.rotation.length() - 1.0).abs() < 1e-6;
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
            Some(bent) => Some(bent.lens()?),
            None => None,
        };
        let stated = match self.stated.first() {
            Some(pinhole) => Some(pinhole.intrinsics()?),
            None => None,
        };
        let seen = Seen {
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
        Some(Held {
            id: self.id,
            seen: Arc::new(seen),
            map_from_cam,
            camera: Camera {
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

impl Bent {
    fn of(lens: &Lens) -> Self {
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

    fn lens(&self) -> Option<Lens> {
        let k = self.coefficients.as_slice();
        let distortion = match self.kind {
            0 => Distortion::None,
            1 => Distortion::PlumbBob(k.try_into().ok()?),
            2 => Distortion::Rational(k.try_into().ok()?),
            3 => Distortion::Equidistant(k.try_into().ok()?),
            _ => return None,
        };
        let lens = Lens {
            intrinsics: self.pinhole.intrinsics()?,
            distortion,
        };
        distortion.is_finite().then_some(lens)
    }
}
