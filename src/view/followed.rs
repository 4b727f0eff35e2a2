//! Messages of a mapper elsewhere, or of a recording of them -> what a viewer shows.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::view::followed_grid::FollowedGrid;
use splat_msgs::client::follower::{Followed, Follower};
use splat_msgs::correction_message::MapCorrectionMsg;
use splat_msgs::map_messages::{KeyframeArray, SplatManifest};
use splat_msgs::ros::navigation::{OccupancyGrid, OccupancyGridUpdate};
use splat_msgs::ros::standard::PoseWithCovarianceStamped;
use splat_msgs::ros::{self, TfMessage};
use splat_msgs::status_message::MapperStatus;
use splat_msgs::type_hash::dds_type_name;
use splat_ros::odometry::forward_camera;
use splat_ros::params::PublishParams;
use splat_ros::plan::Plan;
use splat_types::snapshot::KeyframePose;
use splat_types::tracking::{TrackState, TrackedFrame, TrackedPose};
use splat_types::transform::{Rigid, Similarity, parse_transform};
use splat_view::hub::Hub;
use splat_view::plan_frames::PlanFrames;
use splat_view::view_map::Published;

/// Of a map that is followed.
const MAX_MAP_BYTES: usize = 4 << 30;

/// The state of one mapper, as its messages say.
#[derive(Debug)]
pub struct FollowedMap {
    hub: Arc<Hub>,
    follower: Follower,
    splat_frame: String,
    map_frame: String,
    map_from_world: Similarity,
    base_from_cam: Rigid,
    /// Newer than those of the follower, which come with whole maps alone.
    poses: BTreeMap<u32, KeyframePose>,
    map_id: [u8; 16],
    state: TrackState,
    grid: FollowedGrid,
    plan_frames: PlanFrames,
    newest_pose: Option<PoseWithCovarianceStamped>,
}

impl FollowedMap {
    pub fn new(hub: Arc<Hub>, params: &PublishParams) -> Self {
        Self {
            hub,
            follower: Follower::new(MAX_MAP_BYTES),
            splat_frame: params.splat_frame.clone(),
            map_frame: params.map_frame.clone(),
            map_from_world: Similarity {
                rotation: forward_camera().rotation,
                ..Similarity::IDENTITY
            },
            base_from_cam: parse_transform(&params.base_from_camera).unwrap_or(forward_camera()),
            poses: BTreeMap::new(),
            map_id: [0; 16],
            state: TrackState::Initialising,
            grid: FollowedGrid::new(&params.map_frame),
            plan_frames: PlanFrames::new(&params.map_frame),
            newest_pose: None,
        }
    }

    pub fn has_map(&self) -> bool {
        self.follower.held().is_some()
    }

    /// Another run of the mapper begins.
    pub fn restart(&mut self) {
        self.follower = Follower::new(MAX_MAP_BYTES);
        self.poses.clear();
    }

    /// Takes a message in -> whether the whole map must be asked for, since a part was missed. What cannot be read is left out.
    pub fn take(&mut self, dds_type: &str, payload: &[u8]) -> bool {
        let is = |name: String| dds_type == name;
        if is(dds_type_name::<TfMessage>()) {
            self.take_transforms(payload);
        } else if is(dds_type_name::<PoseWithCovarianceStamped>()) {
            self.take_pose(payload);
        } else if is(dds_type_name::<MapperStatus>()) {
            self.take_status(payload);
        } else if is(dds_type_name::<OccupancyGrid>()) {
            if let Ok(grid) = ros::decode(payload) {
                self.grid.take(&grid);
                self.grid.show(&self.hub, &mut self.plan_frames);
            }
        } else if is(dds_type_name::<OccupancyGridUpdate>()) {
            if let Ok(update) = ros::decode(payload) {
                self.grid.update(&update);
                self.grid.show(&self.hub, &mut self.plan_frames);
            }
        } else if is(dds_type_name::<MapCorrectionMsg>()) {
            if let Some(correction) = ros::decode::<MapCorrectionMsg>(payload)
                .ok()
                .and_then(|m| m.to_correction())
            {
                self.hub.correction(&correction);
            }
        } else {
            if is(dds_type_name::<SplatManifest>())
                && let Ok(manifest) = ros::decode::<SplatManifest>(payload)
            {
                manifest.header.frame_id.clone_into(&mut self.splat_frame);
            }
            if is(dds_type_name::<KeyframeArray>()) {
                self.take_keyframes(payload);
            }
            match self.follower.add_payload(dds_type, payload) {
                Followed::Nothing => {}
                Followed::Advanced => self.show(),
                Followed::Missed => return true,
            }
        }
        false
    }

    /// Where a planner means to go.
    pub fn take_plan(&mut self, payload: &[u8]) {
        let plan = Plan::read(payload);
        if let Some(points) = plan.and_then(|plan| self.plan_frames.in_map(&plan)) {
            self.hub.plan(&points);
        }
    }

    fn show(&mut self) {
        let Some(held) = self.follower.held() else {
            return;
        };
        let mut snapshot = held.clone();
        if snapshot.map_id == self.map_id {
            // Later ones take the place of earlier ones.
            let poses = snapshot.poses.iter().chain(self.poses.values());
            let all: BTreeMap<u32, KeyframePose> =
                poses.map(|pose| (pose.keyframe_id, *pose)).collect();
            snapshot.poses = all.into_values().collect();
        }
        self.map_from_world.scale = snapshot.scale.metres_per_unit.unwrap_or(1.0);
        self.hub.publish(Published {
            snapshot: Arc::new(snapshot),
            map_from_world: self.map_from_world,
        });
        self.show_newest_pose();
    }

    /// Where the splats lie, and their unit, may come behind the pose.
    fn show_newest_pose(&self) {
        if let Some(pose) = &self.newest_pose {
            self.show_pose(pose);
        }
    }

    fn take_keyframes(&mut self, payload: &[u8]) {
        let Ok(array) = ros::decode::<KeyframeArray>(payload) else {
            return;
        };
        if array.map_id != self.map_id {
            self.poses.clear();
            self.map_id = array.map_id;
        }
        let poses = array
            .keyframes
            .iter()
            .filter_map(|message| message.to_pose());
        self.poses
            .extend(poses.map(|pose| (pose.keyframe_id, pose)));
    }

    fn take_transforms(&mut self, payload: &[u8]) {
        let Ok(message) = ros::decode::<TfMessage>(payload) else {
            return;
        };
        self.grid.take_transforms(&message);
        let of_splats = message.transforms.iter().find(|link| {
            link.child_frame_id == self.splat_frame && link.header.frame_id == self.map_frame
        });
        if let Some(found) = of_splats.and_then(|link| link.transform.to_rigid()) {
            self.map_from_world.rotation = found.rotation;
            let is_new = self.map_from_world.translation != found.translation;
            self.map_from_world.translation = found.translation;
            if is_new {
                self.show_newest_pose();
            }
        }
    }

    /// The robot in the map frame -> the camera among the splats.
    fn take_pose(&mut self, payload: &[u8]) {
        if let Ok(message) = ros::decode::<PoseWithCovarianceStamped>(payload) {
            self.show_pose(&message);
            self.newest_pose = Some(message);
        }
    }

    fn show_pose(&self, message: &PoseWithCovarianceStamped) {
        let Some(map_from_base) = message.pose.pose.to_rigid() else {
            return;
        };
        let cam_in_map = map_from_base * self.base_from_cam;
        let world_from_map = self.map_from_world.inverse();
        let pose = TrackedPose {
            world_from_cam: Rigid::new(
                world_from_map.rotation * cam_in_map.rotation,
                world_from_map.transform_point(cam_in_map.translation),
            ),
            covariance: self.covariance_of(message, &cam_in_map),
            is_predicted: false,
        };
        self.hub.frame(&TrackedFrame {
            seq: 0,
            stamp: message.header.stamp.into(),
            state: self.state,
            reason: None,
            pose: Some(pose),
            n_inliers: 0,
        });
    }

    /// From the axes of the map frame, metres, to those of the camera and the unit of the splats; the robot's lever to its camera is left aside.
    fn covariance_of(
        &self,
        message: &PoseWithCovarianceStamped,
        cam_in_map: &Rigid,
    ) -> splat_types::covariance::Covariance {
        let (upper, lower) = (
            &message.pose.covariance.upper,
            &message.pose.covariance.lower,
        );
        let at = |i: usize, j: usize| {
            if i < 3 {
                upper[6 * i + j]
            } else {
                lower[6 * (i - 3) + j]
            }
        };
        let turn = glam::DMat3::from_quat(cam_in_map.rotation.inverse());
        let unit = 1.0 / self.map_from_world.scale;
        let mut found = [[0.0; 6]; 6];
        for (first, scale) in [(0, unit * unit), (3, 1.0)] {
            let block = glam::DMat3::from_cols_array_2d(&std::array::from_fn(|j| {
                std::array::from_fn(|i| at(first + i, first + j))
            }));
            let turned = turn * block * turn.transpose() * scale;
            for i in 0..3 {
                for j in 0..3 {
                    found[first + i][first + j] = turned.col(j)[i];
                }
            }
        }
        found
    }

    fn take_status(&mut self, payload: &[u8]) {
        let Ok(status) = ros::decode::<MapperStatus>(payload) else {
            return;
        };
        self.state = match status.state {
            0 => TrackState::Initialising,
            2 => TrackState::Lost,
            3 => TrackState::Relocalised,
            _ => TrackState::Tracking,
        };
        self.hub.status(&status);
    }
}
