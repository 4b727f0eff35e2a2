//! Paths of planners on their way in, for those who draw them.

use std::sync::Arc;

use glam::DVec3;

use splat_msgs::ros;
use splat_msgs::ros::standard::Path;

/// Of longer ones every n-th point is kept.
const MAX_POINTS: usize = 2000;
/// Larger messages are none of a planner.
const MAX_BYTES: usize = 8 << 20;

/// Where a planner means to go.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    pub frame_id: String,
    /// Metres.
    pub points: Vec<DVec3>,
}

/// Takes plans as they come, on the thread of a transport: it must not wait.
pub type PlanSink = Arc<dyn Fn(Plan) + Send + Sync>;

impl Plan {
    /// A `nav_msgs/Path` as CDR; `None` where it is none, or has a point that is not finite.
    pub fn read(payload: &[u8]) -> Option<Self> {
        if payload.len() > MAX_BYTES {
            return None;
        }
        let path: Path = ros::decode(payload).ok()?;
        let place = |at: &ros::Vector3| DVec3::new(at.x, at.y, at.z);
        let all = path.poses.iter().map(|pose| place(&pose.pose.position));
        let points: Vec<DVec3> = all.collect();
        let every = points.len().div_ceil(MAX_POINTS).max(1);
        let mut kept: Vec<DVec3> = points.iter().step_by(every).copied().collect();
        if let Some(last) = points.last().filter(|last| kept.last() != Some(last)) {
            kept.push(*last);
        }
        let is_sound = kept.iter().all(|p| p.is_finite());
        is_sound.then_some(Self {
            frame_id: path.header.frame_id,
            points: kept,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_msgs::map_messages::payload;

    use splat_msgs::ros::{Header, Pose, PoseStamped};

    fn path(points: impl Iterator<Item = [f64; 3]>) -> Vec<u8> {
        let poses = points.map(|[x, y, z]| PoseStamped {
            pose: Pose {
                position: ros::Vector3 { x, y, z },
                ..Pose::default()
            },
            ..PoseStamped::default()
        });
        let header = Header {
            frame_id: "map".to_owned(),
            ..Header::default()
        };
        let path = Path {
            header,
            poses: poses.collect(),
        };
        payload(&path).unwrap()
    }

    #[test]
    fn a_path_is_read_and_a_long_one_reduced_to_its_end() {
        let plan = Plan::read(&path([[1.0, 2.0, 0.0], [1.5, 2.0, 0.0]].into_iter())).unwrap();
        assert_eq!(plan.frame_id, "map");
        assert_eq!(plan.points[1], DVec3::new(1.5, 2.0, 0.0));
        let long = (0..7001).map(|i| [f64::from(i), 0.0, 0.0]);
        let plan = Plan::read(&path(long)).unwrap();
        assert!(plan.points.len() <= MAX_POINTS + 1);
        assert_eq!(plan.points.last(), Some(&DVec3::new(7000.0, 0.0, 0.0)));
        assert_eq!(Plan::read(&path([].into_iter())).unwrap().points, []);
    }

    #[test]
    fn what_is_no_path_is_left_out() {
        assert_eq!(Plan::read(&[0, 1, 0, 0, 7]), None);
        assert_eq!(Plan::read(&path([[f64::NAN, 0.0, 0.0]].into_iter())), None);
        let mut lie = path([[1.0, 2.0, 0.0]].into_iter());
        let n = lie.len();
        lie.truncate(n - 9);
        assert_eq!(Plan::read(&lie), None);
    }
}
