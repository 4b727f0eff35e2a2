//! Snapshot -> what planners and rviz read without knowing of splats: path, cloud, camera frusta.

use glam::DVec3;

use crate::error::PublishError;
use crate::params::PublishParams;
use crate::transport::{Delivery, Sample, Topic};
use splat_msgs::ros::standard::{ColorRgba, Marker, MarkerArray, Path, PointCloud2, PointField};
use splat_msgs::ros::{Header, PoseStamped, Vector3};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::snapshot::Snapshot;
use splat_types::splats::splats::SH_C0;
use splat_types::time::Stamp;
use splat_types::transform::Similarity;

pub static PATH: Topic = Topic::of::<Path>("path", Delivery::Latched { depth: 1 });
pub static CLOUD: Topic = Topic::of::<PointCloud2>("cloud", Delivery::Latched { depth: 1 });
pub static KEYFRAME_CLOUD: Topic = Topic::of::<PointCloud2>("keyframe_cloud", Delivery::Newest);
pub static FRUSTA: Topic = Topic::of::<MarkerArray>("frusta", Delivery::Latched { depth: 1 });

/// All of them.
pub static TOPICS: [&Topic; 4] = [&PATH, &CLOUD, &KEYFRAME_CLOUD, &FRUSTA];

/// Poses of a path in one message; beyond it every n-th keyframe.
const MAX_POSES: usize = 5000;
/// Cameras shown by markers.
const MAX_FRUSTA: usize = 1000;
/// Points of one keyframe.
const MAX_KEYFRAME_POINTS: usize = 20_000;
/// Splats that are less than half there are haze, not surface.
const MIN_LOGIT: f32 = 0.0;
/// x y z rgb confidence.
const POINT_BYTES: usize = 20;
/// Depth of a frustum as a share of the cameras' spread.
const FRUSTUM_SHARE: f64 = 0.05;

/// A keyframe with its verified depth, as costmaps take it: seen from where the camera stood.
#[derive(Debug, Clone)]
pub struct KeyframeDepth {
    pub stamp: Stamp,
    pub image: std::sync::Arc<RgbImage>,
    /// Of the image.
    pub intrinsics: Intrinsics,
    /// Unit of the splats.
    pub depth: std::sync::Arc<DepthMap>,
}

/// Hands out what goes out with every snapshot, one message after the other; `KEYFRAME_CLOUD` goes with keyframes.
pub(crate) fn of_snapshot(
    snapshot: &Snapshot,
    map_from_world: &Similarity,
    params: &PublishParams,
    send: &dyn Fn(&Sample) -> Result<(), PublishError>,
) -> Result<(), PublishError> {
    let stamp = snapshot.stamp;
    send(&Sample::of(
        &PATH,
        stamp,
        &path(snapshot, map_from_world, params),
    )?)?;
    send(&Sample::of(
        &CLOUD,
        stamp,
        &cloud(snapshot, map_from_world, params),
    )?)?;
    send(&Sample::of(
        &FRUSTA,
        stamp,
        &frusta(snapshot, map_from_world, params),
    )?)
}

/// Refined cameras in the map frame, oldest first.
pub fn path(snapshot: &Snapshot, map_from_world: &Similarity, params: &PublishParams) -> Path {
    let every = snapshot.poses.len().div_ceil(MAX_POSES).max(1);
    let poses = snapshot
        .poses
        .iter()
        .rev()
        .step_by(every)
        .map(|pose| PoseStamped {
            header: Header::new(pose.stamp, &params.map_frame),
            pose: map_from_world.transform_pose(&pose.world_from_cam).into(),
        });
    let mut poses: Vec<PoseStamped> = poses.collect();
    poses.reverse();
    Path {
        header: Header::new(snapshot.stamp, &params.map_frame),
        poses,
    }
}

/// Centres of solid splats in the map frame.
pub fn cloud(
    snapshot: &Snapshot,
    map_from_world: &Similarity,
    params: &PublishParams,
) -> PointCloud2 {
    let splats = &snapshot.splats;
    let solid: Vec<usize> = (0..splats.len())
        .filter(|i| splats.opacity_logits[*i] > MIN_LOGIT)
        .collect();
    let every = solid.len().div_ceil(params.cloud_points.max(1)).max(1);
    let stride = splats.sh_stride();
    let points = solid.iter().step_by(every).map(|&i| {
        let mean = splats.means[i].map(f64::from);
        let point = map_from_world.transform_point(DVec3::from_array(mean));
        let sh = &splats.sh[i * stride..i * stride + 3];
        let rgb = [0, 1, 2].map(|c| (255.0 * (0.5 + SH_C0 * sh[c])).clamp(0.0, 255.0) as u8);
        (point, rgb, 1.0 / (1.0 + (-splats.opacity_logits[i]).exp()))
    });
    cloud_of(Header::new(snapshot.stamp, &params.map_frame), points)
}

/// Verified depth of one keyframe in the camera's own frame: metres where they are known.
pub fn keyframe_cloud(seen: &KeyframeDepth, metres: f64, camera_frame: &str) -> PointCloud2 {
    let depth = &seen.depth;
    let (w, h) = (depth.width_px as usize, depth.height_px as usize);
    let known: Vec<usize> = (0..w * h)
        .filter(|i| depth.confidence[*i] > 0.0 && depth.depth[*i] > 0.0)
        .collect();
    let every = known.len().div_ceil(MAX_KEYFRAME_POINTS).max(1);
    let (image, k) = (&seen.image, &seen.intrinsics);
    let points = known.iter().step_by(every).map(|&i| {
        // Shares of the image are the same at every size.
        let u = ((i % w) as f64 + 0.5) / w as f64;
        let v = ((i / w) as f64 + 0.5) / h as f64;
        let z = f64::from(depth.depth[i]) * metres;
        let x = (u * f64::from(k.width_px) - k.cx) / k.fx * z;
        let y = (v * f64::from(k.height_px) - k.cy) / k.fy * z;
        let column = ((u * f64::from(image.width_px)) as usize).min(image.width_px as usize - 1);
        let row = ((v * f64::from(image.height_px)) as usize).min(image.height_px as usize - 1);
        let pixel = 3 * (row * image.width_px as usize + column);
        let rgb = [0, 1, 2].map(|c| image.pixels[pixel + c]);
        (DVec3::new(x, y, z), rgb, depth.confidence[i])
    });
    cloud_of(Header::new(seen.stamp, camera_frame), points)
}

fn cloud_of(header: Header, points: impl Iterator<Item = (DVec3, [u8; 3], f32)>) -> PointCloud2 {
    let names = ["x", "y", "z", "rgb", "confidence"];
    let fields = names.iter().enumerate().map(|(i, name)| PointField {
        name: (*name).to_owned(),
        offset: 4 * i as u32,
        datatype: PointField::FLOAT32,
        count: 1,
    });
    let mut data = Vec::new();
    for (point, [r, g, b], confidence) in points {
        for value in [point.x, point.y, point.z] {
            data.extend_from_slice(&(value as f32).to_le_bytes());
        }
        // As PCL packs a colour into one float: 0x00rrggbb, little endian.
        data.extend_from_slice(&[b, g, r, 0]);
        data.extend_from_slice(&confidence.to_le_bytes());
    }
    PointCloud2 {
        header,
        height: 1,
        width: (data.len() / POINT_BYTES) as u32,
        fields: fields.collect(),
        is_bigendian: false,
        point_step: POINT_BYTES as u32,
        row_step: data.len() as u32,
        data,
        is_dense: true,
    }
}

/// Lines of the cameras' views.
pub fn frusta(
    snapshot: &Snapshot,
    map_from_world: &Similarity,
    params: &PublishParams,
) -> MarkerArray {
    let every = snapshot.poses.len().div_ceil(MAX_FRUSTA).max(1);
    let places: Vec<DVec3> = snapshot
        .poses
        .iter()
        .map(|pose| map_from_world.transform_point(pose.world_from_cam.translation))
        .collect();
    let middle = places.iter().sum::<DVec3>() / places.len().max(1) as f64;
    let spread = places
        .iter()
        .map(|p| p.distance(middle))
        .fold(0.0, f64::max);
    let depth = if spread > 0.0 {
        FRUSTUM_SHARE * spread
    } else {
        FRUSTUM_SHARE
    };
    let mut points = Vec::new();
    for pose in snapshot.poses.iter().step_by(every) {
        let map_from_cam = map_from_world.transform_pose(&pose.world_from_cam);
        let k = &pose.intrinsics;
        let (right, low) = (f64::from(k.width_px), f64::from(k.height_px));
        let corners = [(0.0, 0.0), (right, 0.0), (right, low), (0.0, low)].map(|(u, v)| {
            let ray = DVec3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0);
            Vector3::from(map_from_cam.transform_point(ray * depth))
        });
        let tip = Vector3::from(map_from_cam.translation);
        for i in 0..4 {
            points.extend([tip, corners[i], corners[i], corners[(i + 1) % 4]]);
        }
    }
    let marker = Marker {
        header: Header::new(snapshot.stamp, &params.map_frame),
        ns: "keyframes".to_owned(),
        kind: Marker::LINE_LIST,
        scale: Vector3 {
            x: depth * 0.05,
            ..Vector3::default()
        },
        color: ColorRgba {
            r: 0.1,
            g: 0.6,
            b: 1.0,
            a: 1.0,
        },
        points,
        ..Marker::default()
    };
    MarkerArray {
        markers: vec![marker],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    #[test]
    fn a_keyframe_s_points_project_to_the_pixels_that_they_came_from() {
        let intrinsics = Intrinsics {
            width_px: 8,
            height_px: 4,
            fx: 6.0,
            fy: 5.0,
            cx: 4.5,
            cy: 1.8,
        };
        let image = RgbImage {
            width_px: 8,
            height_px: 4,
            pixels: (0..96).collect(),
        };
        let mut depth = DepthMap {
            width_px: 4,
            height_px: 2,
            depth: (1..=8).map(|v| v as f32).collect(),
            confidence: vec![1.0; 8],
        };
        depth.confidence[3] = 0.0;
        let seen = KeyframeDepth {
            stamp: Stamp::from_secs(3.0),
            image: Arc::new(image),
            intrinsics,
            depth: Arc::new(depth),
        };
        let cloud = keyframe_cloud(&seen, 2.0, "camera_optical");
        assert_eq!((cloud.width, cloud.row_step), (7, 140));
        let float = |at: usize| {
            f64::from(f32::from_le_bytes(
                cloud.data[at..at + 4].try_into().expect("four"),
            ))
        };
        // The last point: depth pixel (3, 1), whose middle is at (7, 3) of the image.
        let at = 6 * POINT_BYTES;
        assert_eq!(float(at + 8), 16.0);
        let pixel = intrinsics.project(DVec3::new(float(at), float(at + 4), float(at + 8)));
        let pixel = pixel.expect("in front");
        assert!((pixel.x - 7.0).abs() < 1e-5 && (pixel.y - 3.0).abs() < 1e-5);
        let first = 3 * (3 * 8 + 7);
        assert_eq!(cloud.data[at + 12..at + 15], [first + 2, first + 1, first]);
    }
}
