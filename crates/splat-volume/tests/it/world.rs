//! Boxes in a room, and what a camera sees of them.

use glam::{DQuat, DVec2, DVec3, IVec2};
use std::collections::BTreeMap;

use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::transform::Similarity;

pub(crate) const CAMERA: Intrinsics = Intrinsics {
    width_px: 160,
    height_px: 120,
    fx: 110.0,
    fy: 110.0,
    cx: 80.0,
    cy: 60.0,
};

/// Inner side of the room from the origin to `size`, solid boxes within. Metres, z up.
pub(crate) struct World {
    size: DVec3,
    boxes: Vec<(DVec3, DVec3)>,
}

/// A camera at `eye` that looks along `yaw` about z, `pitch` upwards.
pub(crate) fn forward(eye: DVec3, yaw: f64, pitch: f64, metres: f64) -> Similarity {
    // Optical axes: x right, y down, z ahead.
    let optical = DQuat::from_mat3(&glam::DMat3::from_cols(
        DVec3::NEG_Y,
        DVec3::NEG_Z,
        DVec3::X,
    ));
    Similarity {
        scale: metres,
        rotation: DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(-pitch) * optical,
        translation: eye,
    }
}

impl World {
    /// Six by five metres, a crate, a post of 6 cm, a low box and one that hangs.
    pub(crate) fn room() -> Self {
        let mut world = Self {
            size: DVec3::new(6.0, 5.0, 2.5),
            boxes: Vec::new(),
        };
        world.add_box(DVec3::new(0.52, 0.43, 0.0), DVec3::new(1.02, 0.93, 0.61));
        world.add_box(DVec3::new(5.02, 3.53, 0.0), DVec3::new(5.08, 3.59, 1.2));
        world.add_box(DVec3::new(2.81, 4.22, 0.0), DVec3::new(3.23, 4.61, 0.33));
        world.add_box(DVec3::new(4.6, 0.4, 1.72), DVec3::new(5.4, 1.2, 2.1));
        world
    }

    /// 14 m long and 1.8 m wide, empty.
    pub(crate) fn corridor() -> Self {
        Self {
            size: DVec3::new(14.0, 1.8, 2.5),
            boxes: Vec::new(),
        }
    }

    pub(crate) fn size(&self) -> DVec2 {
        self.size.truncate()
    }

    pub(crate) fn add_box(&mut self, low: DVec3, high: DVec3) {
        self.boxes.push((low, high));
    }

    /// Metres to the nearest surface, negative within what is solid.
    pub(crate) fn distance(&self, p: DVec3) -> f64 {
        let wall = p.min_element().min((self.size - p).min_element());
        let solid = |(low, high): &(DVec3, DVec3)| {
            let q = (p - (*low + *high) / 2.0).abs() - (*high - *low) / 2.0;
            q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
        };
        self.boxes.iter().map(solid).fold(wall, f64::min)
    }

    /// Shares of `along` until the ray ends; 1 or more: nothing is in the way.
    pub(crate) fn ray(&self, eye: DVec3, along: DVec3) -> f64 {
        let inverse = along.recip();
        let far = |low: DVec3, high: DVec3| {
            let (a, b) = ((low - eye) * inverse, (high - eye) * inverse);
            (a.min(b).max_element(), a.max(b).min_element())
        };
        let (_, mut end) = far(DVec3::ZERO, self.size);
        for (low, high) in &self.boxes {
            let (enter, leave) = far(*low, *high);
            if enter <= leave && enter > 0.0 {
                end = end.min(enter);
            }
        }
        end
    }

    /// Units of the map.
    pub(crate) fn depth(&self, pose: &Similarity) -> DepthMap {
        let (w, h) = (CAMERA.width_px, CAMERA.height_px);
        let depth: Vec<f32> = (0..w * h)
            .map(|at| {
                let pixel = DVec2::new(f64::from(at % w) + 0.5, f64::from(at / w) + 0.5);
                let along = pose.rotation * CAMERA.ray_in_cam(pixel);
                (self.ray(pose.translation, along) / pose.scale) as f32
            })
            .collect();
        DepthMap {
            width_px: w,
            height_px: h,
            confidence: vec![1.0; depth.len()],
            depth,
        }
    }

    /// Metres in the plane to what stands between 0.1 and 1.5 m; at most 2.
    pub(crate) fn clearance(&self, p: DVec2) -> f64 {
        let wall = p.min_element().min((self.size() - p).min_element());
        let standing = self
            .boxes
            .iter()
            .filter(|(low, high)| low.z < 1.5 && high.z > 0.15);
        let solid = standing.map(|(low, high)| {
            let (low, high) = (low.truncate(), high.truncate());
            let q = (p - (low + high) / 2.0).abs() - (high - low) / 2.0;
            q.max(DVec2::ZERO).length() + q.max_element().min(0.0)
        });
        solid.fold(wall, f64::min).min(2.0)
    }

    /// Whether something that stands is nearer than `radius`.
    pub(crate) fn is_obstructed(&self, p: DVec2, radius: f64) -> bool {
        self.clearance(p) < radius
    }

    /// Cells of 5 cm whose standing surface two cameras or more have seen within `range`, at nine degrees or more.
    pub(crate) fn seen_obstacles(&self, poses: &[Similarity], range: f64) -> Vec<IVec2> {
        let mut seen: BTreeMap<[i32; 2], u32> = BTreeMap::new();
        for pose in poses {
            let mut own = std::collections::BTreeSet::new();
            let (w, h) = (CAMERA.width_px, CAMERA.height_px);
            for at in 0..w * h {
                let pixel = DVec2::new(f64::from(at % w) + 0.5, f64::from(at / w) + 0.5);
                let along = pose.rotation * CAMERA.ray_in_cam(pixel);
                let z = self.ray(pose.translation, along);
                let hit = pose.translation + along * z;
                // Sine of the angle between ray and surface: nobody sees along a surface.
                let sine = self.distance(hit - along.normalize() * 0.01) / 0.01;
                if z < range && sine > 0.15 && hit.z > 0.2 && hit.z < 1.45 {
                    own.insert((hit.truncate() / 0.05).floor().as_ivec2().to_array());
                }
            }
            for cell in own {
                *seen.entry(cell).or_default() += 1;
            }
        }
        let twice = seen.into_iter().filter(|(_, n)| *n >= 2);
        twice.map(|(cell, _)| IVec2::from_array(cell)).collect()
    }
}
