//! The service `render_view`: its question -> a camera in the splat frame, a rendering -> its reply.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::odometry::FrameCells;
use splat_msgs::ros::{CameraInfo, Header, Image, Pose};
use splat_types::camera::Intrinsics;
use splat_types::rendering::Rendering;
use splat_types::transform::Rigid;

const MAX_SIDE_PX: u32 = 2048;

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RenderViewRequest {
    pub header: Header,
    pub pose: Pose,
    pub camera: CameraInfo,
    pub with_depth: bool,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RenderViewResponse {
    pub success: bool,
    pub message: String,
    pub image: Image,
    pub depth: Image,
}

/// The frames that a pose may be given in.
#[derive(Debug, Clone)]
pub struct Frames {
    /// Name of the map frame: z up, metres where known.
    pub map: String,
    /// Name of the splats' own frame.
    pub splats: String,
    /// How they lie to each other.
    pub cells: Arc<FrameCells>,
}

/// A camera to render from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AskedView {
    /// In the splat frame and its unit.
    pub world_from_cam: Rigid,
    pub intrinsics: Intrinsics,
    /// Units of the client's frame in one unit of the splat frame.
    scale: f64,
    with_depth: bool,
}

impl Frames {
    /// Refuses frames that are not known, poses that are none and sizes out of bounds.
    pub fn view(&self, asked: &RenderViewRequest) -> Result<AskedView, String> {
        let intrinsics = intrinsics_of(&asked.camera)?;
        let pose = asked
            .pose
            .to_rigid()
            .ok_or("the pose is not finite, or its quaternion has no length")?;
        let frame = asked.header.frame_id.as_str();
        let (world_from_cam, scale) = if frame.is_empty() || frame == self.splats {
            (pose, 1.0)
        } else if frame == self.map {
            let map_from_world = self.cells.tree().map_from_world();
            (
                map_from_world.inverse().transform_pose(&pose),
                map_from_world.scale,
            )
        } else {
            return Err(format!(
                "frame_id {frame:?} is not known; expected {:?} (map), {:?} (splats) or empty (splats)",
                self.map, self.splats
            ));
        };
        Ok(AskedView {
            world_from_cam,
            intrinsics,
            scale,
            with_depth: asked.with_depth,
        })
    }
}

fn intrinsics_of(camera: &CameraInfo) -> Result<Intrinsics, String> {
    let intrinsics = Intrinsics {
        width_px: camera.width,
        height_px: camera.height,
        fx: camera.k[0],
        fy: camera.k[4],
        // Outside, pixel centres are at integers.
        cx: camera.k[2] + 0.5,
        cy: camera.k[5] + 0.5,
    };
    let sides = [camera.width, camera.height];
    if sides.iter().any(|side| !(1..=MAX_SIDE_PX).contains(side)) {
        return Err(format!(
            "an image of {}x{} px, expected 1 to {MAX_SIDE_PX} a side",
            camera.width, camera.height
        ));
    }
    if !intrinsics.is_plausible() {
        return Err(format!("camera.k = {:?} is no camera's", camera.k));
    }
    Ok(intrinsics)
}

impl AskedView {
    /// 8-bit colour; depth in the unit of the client's frame.
    pub fn response(&self, rendering: &Rendering) -> RenderViewResponse {
        let image = |encoding: &str, step: u32, data: Vec<u8>| Image {
            header: Header::default(),
            height: rendering.height_px,
            width: rendering.width_px,
            encoding: encoding.to_owned(),
            is_bigendian: 0,
            step,
            data,
        };
        let bytes = rendering
            .rgb
            .iter()
            .map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8);
        let depth = |(depth, alpha): (&f32, &f32)| {
            let is_seen = *alpha > 0.5;
            let depth = (f64::from(*depth) * self.scale) as f32;
            (if is_seen { depth } else { f32::NAN }).to_le_bytes()
        };
        RenderViewResponse {
            success: true,
            message: String::new(),
            image: image("rgb8", 3 * rendering.width_px, bytes.collect()),
            depth: if self.with_depth {
                let depths = rendering.depth.iter().zip(&rendering.alpha).flat_map(depth);
                image("32FC1", 4 * rendering.width_px, depths.collect())
            } else {
                Image::default()
            },
        }
    }
}

impl RenderViewResponse {
    pub fn refused(message: String) -> Self {
        Self {
            message,
            ..Self::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn frames() -> Frames {
        let cells = FrameCells::default();
        cells.set_metres_per_unit(Some(2.0));
        let mut world = cells.tree();
        let world_from_cam = Rigid::exp(DVec3::new(0.3, -0.2, 0.9), DVec3::new(0.1, 0.7, -0.2));
        let map_from_cam = Rigid::exp(DVec3::new(4.0, 2.0, 0.3), DVec3::new(0.0, 0.1, 0.2));
        world.anchor(world_from_cam, map_from_cam);
        cells.keep_anchor(&world);
        Frames {
            map: "map".to_owned(),
            splats: "splat_map".to_owned(),
            cells: Arc::new(cells),
        }
    }

    fn asked(frame: &str, pose: Rigid) -> RenderViewRequest {
        let mut asked = RenderViewRequest {
            pose: pose.into(),
            with_depth: true,
            ..RenderViewRequest::default()
        };
        asked.header.frame_id = frame.to_owned();
        (asked.camera.width, asked.camera.height) = (2, 1);
        asked.camera.k = [2.0, 0.0, 0.5, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0];
        asked
    }

    fn pose() -> Rigid {
        Rigid::new(DQuat::from_rotation_y(0.4), DVec3::new(1.0, -0.5, 2.0))
    }

    #[test]
    fn a_pose_without_a_frame_is_in_the_frame_of_the_splats() {
        let found = frames().view(&asked("", pose())).unwrap();
        assert_eq!(found, frames().view(&asked("splat_map", pose())).unwrap());
        let off = found
            .world_from_cam
            .translation
            .distance(pose().translation);
        assert!(off < 1e-12 && found.world_from_cam.angle_to(&pose()) < 1e-9);
    }

    #[test]
    fn the_same_camera_in_map_and_splat_frame_renders_from_the_same_place() {
        let frames = frames();
        let map_from_world = frames.cells.tree().map_from_world();
        let in_map = map_from_world.transform_pose(&pose());
        let found = frames.view(&asked("map", in_map)).unwrap().world_from_cam;
        assert!(found.translation.distance(pose().translation) < 1e-9);
        assert!(found.angle_to(&pose()) < 1e-9);
    }

    #[test]
    fn depth_is_in_the_unit_of_the_frame_that_was_named() {
        let rendering = Rendering {
            width_px: 2,
            height_px: 1,
            rgb: vec![0.0; 6],
            alpha: vec![1.0, 0.2],
            depth: vec![3.0, 3.0],
        };
        for (frame, expected) in [("splat_map", 3.0), ("map", 6.0)] {
            let view = frames().view(&asked(frame, pose())).unwrap();
            let depth = view.response(&rendering).depth.data;
            let depths: Vec<f32> = depth
                .as_chunks::<4>()
                .0
                .iter()
                .map(|b| f32::from_le_bytes(*b))
                .collect();
            assert!((depths[0] - expected).abs() < 1e-6, "{frame}: {depths:?}");
            assert!(depths[1].is_nan());
        }
    }

    #[test]
    fn an_unknown_frame_is_refused_by_the_names_of_the_known_ones() {
        let reason = frames().view(&asked("odom", pose())).unwrap_err();
        for name in ["\"odom\"", "\"map\"", "\"splat_map\""] {
            assert!(reason.contains(name), "{reason}");
        }
    }
}
