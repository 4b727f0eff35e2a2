//! Depth of a camera beside the colour camera -> depth in the colour camera's pixels.

use glam::{DVec2, DVec3};

use crate::calibration::lens_of_camera_info;
use crate::ground_truth::Transforms;
use splat_msgs::ros::CameraInfo;
use splat_types::camera::CameraModel;
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

/// Calibrations whose numbers differ by less, in pixels, are of one camera: two never have the same.
const SAME_PX: f64 = 0.5;

/// How depth images lie to the colour images.
#[derive(Debug)]
pub enum Registration {
    /// In their pixels.
    Aligned,
    By(Box<DepthRegistration>),
    /// Nothing says how: a sentence with the way out.
    Unknown(String),
}

impl Registration {
    /// Depth in the colour camera's pixels; the reason where nothing says how it lies.
    pub fn apply(&mut self, depth: DepthMap) -> Result<DepthMap, String> {
        match self {
            Self::Aligned => Ok(depth),
            Self::By(registration) => Ok(registration.register(&depth)),
            Self::Unknown(reason) => Err(reason.clone()),
        }
    }
}

/// Brings depth into the view of the colour camera.
#[derive(Debug)]
pub struct DepthRegistration {
    depth_lens: CameraModel,
    colour_lens: CameraModel,
    colour_from_depth: Rigid,
    /// Rays through the pixels of depth images of a size, at z = 1; none where the lens shows nothing.
    rays: Option<Rays>,
}

#[derive(Debug)]
struct Rays {
    size: (u32, u32),
    in_depth: Vec<Option<DVec3>>,
}

/// A camera by the header of its images, and its calibration.
#[derive(Debug, Clone, Copy)]
pub struct Calibrated<'a> {
    pub frame_id: &'a str,
    pub info: Option<&'a CameraInfo>,
}

/// How depth lies to colour by both calibrations and the fixed transforms. Depth of the same frame, or with the same calibration, is
/// aligned; where there is no calibration of the depth camera it counts as aligned as well.
pub fn registration(
    colour: &Calibrated<'_>,
    depth: &Calibrated<'_>,
    transforms: &Transforms,
) -> Registration {
    let (Some(colour_info), Some(depth_info)) = (colour.info, depth.info) else {
        return Registration::Aligned;
    };
    if colour.frame_id == depth.frame_id || is_same(colour_info, depth_info) {
        return Registration::Aligned;
    }
    let lens = |info| lens_of_camera_info(info, false);
    let (Ok(colour_lens), Ok(depth_lens)) = (lens(colour_info), lens(depth_info)) else {
        return Registration::Aligned;
    };
    let Some(colour_from_depth) = transforms.between(colour.frame_id, depth.frame_id) else {
        return Registration::Unknown(format!(
            "depth images are of frame {:?}, colour images of {:?}, and no fixed transforms lead from one to the other: publish them on /tf_static, or depth that is aligned to colour",
            depth.frame_id, colour.frame_id
        ));
    };
    Registration::By(Box::new(DepthRegistration {
        depth_lens,
        colour_lens,
        colour_from_depth,
        rays: None,
    }))
}

fn is_same(a: &CameraInfo, b: &CameraInfo) -> bool {
    // Depth may be binned: as shares of the width.
    let share = |info: &CameraInfo| {
        let width = f64::from(info.width.max(1));
        [0, 2, 4, 5].map(|k| info.k[k] / width)
    };
    let limit = SAME_PX / f64::from(a.width.max(1));
    let pairs = share(a).into_iter().zip(share(b));
    pairs.into_iter().all(|(a, b)| (a - b).abs() < limit)
}

impl DepthRegistration {
    /// Depth as the colour camera would have measured it, with as many pixels across as the depth image has. Each depth covers the
    /// four pixels about it, and the nearest wins: what the colour camera cannot see stays behind what hides it.
    pub fn register(&mut self, depth: &DepthMap) -> DepthMap {
        let size = (depth.width_px, depth.height_px);
        if self.rays.as_ref().is_none_or(|rays| rays.size != size) {
            self.rays = Some(Rays {
                size,
                in_depth: rays(&self.depth_lens, size),
            });
        }
        let full = &self.colour_lens.intrinsics;
        let share = f64::from(size.0) / f64::from(full.width_px);
        let height = ((f64::from(full.height_px) * share).round() as u32).max(1);
        let lens = self.colour_lens.resized(size.0, height);
        let mut out = DepthMap::empty(size.0, height);
        let rays = self.rays.iter().flat_map(|rays| &rays.in_depth);
        for (ray, at) in rays.zip(0..) {
            let Some((z, _)) = ray.and(depth.verified(at)) else {
                continue;
            };
            let in_depth = ray.unwrap_or_default() * f64::from(z);
            let in_colour = self.colour_from_depth.transform_point(in_depth);
            let Some(pixel) = lens.project(in_colour) else {
                continue;
            };
            cover(&mut out, pixel, in_colour.z as f32);
        }
        out
    }
}

fn rays(lens: &CameraModel, (width, height): (u32, u32)) -> Vec<Option<DVec3>> {
    let lens = lens.resized(width, height);
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    pixels
        .map(|(x, y)| lens.ray_in_cam(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)))
        .map(|ray| ray.map(|ray| ray / ray.z))
        .collect()
}

/// Puts a depth into the four pixels whose centres are about a place, where it is the nearest.
fn cover(out: &mut DepthMap, place: DVec2, z: f32) {
    for (x, y) in [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)] {
        if let Some(at) = out.pixel_at(place + DVec2::new(x, y)) {
            let is_nearer = out.confidence[at] == 0.0 || z < out.depth[at];
            if is_nearer && z > 0.0 {
                (out.depth[at], out.confidence[at]) = (z, 1.0);
            }
        }
    }
}

#[cfg(test)]
mod tests;
