//! The map's own frame -> the frames that robots know: map (z up, metres), odom, base (REP-103, REP-105).

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, Matrix6};

use splat_io::latest::Latest;
use splat_types::covariance::Covariance;
use splat_types::map_frame::MapFrame;
use splat_types::snapshot::KeyframePose;
use splat_types::time::Stamp;
use splat_types::tracking::{TrackState, TrackedFrame};
use splat_types::transform::{Rigid, Similarity};

/// A tracked frame on its way out.
#[derive(Debug, Clone)]
pub struct PoseEvent {
    pub tracked: TrackedFrame,
    /// What wheels say of the camera at that time.
    pub odom_from_cam: Option<Rigid>,
    /// They disagree with the camera.
    pub is_odometry_out: bool,
    /// What is wrong with the IMU.
    pub imu_fault: Option<&'static str>,
    /// Up in the axes of the camera, where an IMU shows it.
    pub up_in_cam: Option<DVec3>,
    pub base_from_cam: Option<Rigid>,
    /// How the map has moved under the camera since the frame before.
    pub moved: Option<Similarity>,
    /// Seconds from the frame's arrival to its pose.
    pub latency_secs: f64,
}

/// A robot's axes seen from a camera that looks ahead: x right, y down, z forward.
pub fn forward_camera() -> Rigid {
    let axes = DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X);
    Rigid::new(DQuat::from_mat3(&axes), DVec3::ZERO)
}

/// The map frame of a robot whose camera looks ahead and is where the map begins.
pub fn beginning_at(world_from_cam: Rigid) -> MapFrame {
    MapFrame {
        world_from_cam,
        map_from_camera: forward_camera(),
    }
}

/// Of a saved map: as it was saved, or beginning at its first keyframe.
pub fn saved_map_frame(saved: Option<MapFrame>, poses: &[KeyframePose]) -> MapFrame {
    let first = poses.iter().min_by_key(|pose| pose.keyframe_id);
    let first = first.map_or(Rigid::IDENTITY, |pose| pose.world_from_cam);
    saved.unwrap_or_else(|| beginning_at(first))
}

/// Where the splats' frame lies in the map frame: fixed by the first frame that was seen in both, or by the map that a run goes on from.
#[derive(Debug, Clone, Default)]
pub struct FrameTree {
    anchor: Option<MapFrame>,
    /// Metres of one unit of the splats; `None` while unknown, when both frames share one unit.
    pub metres_per_unit: Option<f64>,
}

impl FrameTree {
    pub fn is_anchored(&self) -> bool {
        self.anchor.is_some()
    }

    /// The map frame begins where `world_from_cam` says, for a camera that the splats see at `world_from_cam`.
    pub fn anchor(&mut self, world_from_cam: Rigid, map_from_cam: Rigid) {
        self.anchor = Some(MapFrame {
            world_from_cam,
            map_from_camera: map_from_cam,
        });
    }

    pub fn map_from_world(&self) -> Similarity {
        let scale = self.metres_per_unit.unwrap_or(1.0);
        let anchor = self.anchor.unwrap_or_else(|| beginning_at(Rigid::IDENTITY));
        anchor.map_from_world(scale)
    }
}

/// What a `FrameTree` is made of, for threads that share it; each cell has one writer.
#[derive(Debug, Default)]
pub struct FrameCells {
    /// Written once, by the thread that follows the tracker, unless a map brings its own.
    anchor: Latest<Option<MapFrame>>,
    /// Written with every snapshot that goes out.
    metres_per_unit: Latest<Option<f64>>,
}

impl FrameCells {
    /// The frames as they lie now.
    pub fn tree(&self) -> FrameTree {
        FrameTree {
            anchor: *self.anchor.get(),
            metres_per_unit: *self.metres_per_unit.get(),
        }
    }

    /// Takes over the anchor of a tree that its reader has anchored; the first one stays.
    pub fn keep_anchor(&self, tree: &FrameTree) {
        if tree.is_anchored() && self.anchor.get().is_none() {
            self.anchor.set(tree.anchor);
        }
    }

    /// `None` before the first frame with a pose.
    pub fn map_frame(&self) -> Option<MapFrame> {
        *self.anchor.get()
    }

    /// Of a map that a run goes on from; before frames come.
    pub fn set_map_frame(&self, frame: MapFrame) {
        self.anchor.set(Some(frame));
    }

    pub fn set_metres_per_unit(&self, metres: Option<f64>) {
        self.metres_per_unit.set(metres);
    }
}

/// Where a robot is, in the frames that it knows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RobotPose {
    pub stamp: Stamp,
    pub map_from_base: Rigid,
    /// Axes of the map frame: place (m), then turn (rad).
    pub covariance: Covariance,
    pub odom_from_base: Rigid,
    /// Whether odometry comes from elsewhere.
    pub is_odom_given: bool,
    /// Of the base in its own axes: m/s, rad/s; `None` after a gap.
    pub twist: Option<(DVec3, DVec3)>,
}

impl RobotPose {
    /// What a localiser broadcasts.
    pub fn map_from_odom(&self) -> Rigid {
        (self.map_from_base * self.odom_from_base.inverse()).renormalized()
    }
}

/// Tracked frames -> pose of the robot. Where no odometry comes in, the camera's own steps make one, which the map's
/// corrections do not move.
#[derive(Debug)]
pub struct Odometer {
    /// Of the parameters; `None`: as the frames say.
    mount: Option<Rigid>,
    odom_from_base: Rigid,
    /// The frame before: its stamp, and the camera among the splats.
    last: Option<(Stamp, Rigid)>,
}

impl Odometer {
    pub fn new(mount: Option<Rigid>) -> Self {
        Self {
            mount,
            odom_from_base: Rigid::IDENTITY,
            last: None,
        }
    }

    /// What the parameters say goes before it.
    pub fn mount_by_input(&mut self, base_from_cam: Rigid) {
        self.mount.get_or_insert(base_from_cam);
    }

    /// `None` while nothing is known of the camera's place.
    pub fn advance(&mut self, live: &PoseEvent, world: &mut FrameTree) -> Option<RobotPose> {
        let tracked = &live.tracked;
        let pose = tracked.pose.filter(|_| tracked.state != TrackState::Lost);
        let Some(pose) = pose else {
            self.last = None;
            return None;
        };
        let base_from_cam = self
            .mount
            .or(live.base_from_cam)
            .unwrap_or_else(forward_camera);
        let world_from_cam = pose.world_from_cam;
        if !world.is_anchored() {
            // The frame of odometry has an up of its own.
            let by_mount = || level(base_from_cam, live.up_in_cam);
            let map_from_cam = live.odom_from_cam.unwrap_or_else(by_mount);
            world.anchor(world_from_cam, map_from_cam);
        }
        let map_from_world = world.map_from_world();
        let map_from_cam = map_from_world.transform_pose(&world_from_cam);
        let cam_from_base = base_from_cam.inverse();
        let step = self.step(live, &world_from_cam, map_from_world.scale);
        let twist = step.map(|(step, secs)| {
            let step = base_from_cam * step * cam_from_base;
            (
                step.translation / secs,
                step.rotation.to_scaled_axis() / secs,
            )
        });
        if let Some((step, _)) = step {
            let step = base_from_cam * step * cam_from_base;
            self.odom_from_base = (self.odom_from_base * step).renormalized();
        }
        self.last = Some((tracked.stamp, world_from_cam));
        let given = live.odom_from_cam.map(|odom| odom * cam_from_base);
        Some(RobotPose {
            stamp: tracked.stamp,
            map_from_base: map_from_cam * cam_from_base,
            covariance: of_base(
                &pose.covariance,
                map_from_world.scale,
                &map_from_cam,
                &cam_from_base,
            ),
            odom_from_base: given.unwrap_or(self.odom_from_base),
            is_odom_given: given.is_some(),
            twist,
        })
    }

    /// From the camera before to this one in metres, and the seconds between; none across a jump.
    fn step(&self, live: &PoseEvent, world_from_cam: &Rigid, metres: f64) -> Option<(Rigid, f64)> {
        let (stamp, before) = self.last?;
        let secs = live.tracked.stamp.secs_since(stamp);
        if live.tracked.state == TrackState::Relocalised || secs <= 0.0 {
            return None;
        }
        let before = match &live.moved {
            Some(moved) => moved.transform_pose(&before),
            None => before,
        };
        let mut step = before.inverse() * *world_from_cam;
        step.translation *= metres;
        Some((step, secs))
    }
}

/// Turns a frame about its origin so that what the camera sees as up is its z axis.
fn level(frame_from_cam: Rigid, up_in_cam: Option<DVec3>) -> Rigid {
    let Some(up) = up_in_cam else {
        return frame_from_cam;
    };
    let up = (frame_from_cam.rotation * up).normalize();
    Rigid::new(DQuat::from_rotation_arc(up, DVec3::Z), DVec3::ZERO) * frame_from_cam
}

/// Covariance of a camera in its own axes and the splats' unit -> of the base in the axes of the map frame.
fn of_base(
    covariance: &Covariance,
    metres: f64,
    map_from_cam: &Rigid,
    cam_from_base: &Rigid,
) -> Covariance {
    let rotation = DMat3::from_quat(map_from_cam.rotation);
    let turn = Matrix3::from_fn(|i, j| rotation.col(j)[i]);
    // A turn of the camera swings the base about it.
    let arm = map_from_cam.rotation * cam_from_base.translation;
    let swing = Matrix3::new(0.0, arm.z, -arm.y, -arm.z, 0.0, arm.x, arm.y, -arm.x, 0.0);
    let mut by_cam = Matrix6::zeros();
    by_cam
        .fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&(turn * metres));
    by_cam
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&(swing * turn));
    by_cam.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
    let own = Matrix6::from_fn(|i, j| covariance[i][j]);
    let found = by_cam * own * by_cam.transpose();
    std::array::from_fn(|i| std::array::from_fn(|j| found[(i, j)]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_types::tracking::TrackedPose;

    fn frame(secs: f64, world_from_cam: Rigid) -> PoseEvent {
        let covariance = std::array::from_fn(|i| {
            std::array::from_fn(|j| if i == j { 1e-4 * (i + 1) as f64 } else { 0.0 })
        });
        PoseEvent {
            tracked: TrackedFrame {
                seq: 0,
                stamp: Stamp::from_secs(secs),
                state: TrackState::Tracking,
                reason: None,
                pose: Some(TrackedPose {
                    world_from_cam,
                    covariance,
                    is_predicted: false,
                }),
                n_inliers: 50,
            },
            odom_from_cam: None,
            is_odometry_out: false,
            imu_fault: None,
            up_in_cam: None,
            base_from_cam: None,
            moved: None,
            latency_secs: 0.0,
        }
    }

    fn close(a: &Rigid, b: &Rigid) -> bool {
        (a.translation - b.translation).length() < 1e-9 && a.angle_to(b) < 1e-9
    }

    #[test]
    fn an_imu_levels_the_map_of_a_camera_that_is_tilted() {
        let (mut world, mut odometer) = (FrameTree::default(), Odometer::new(None));
        let tilted = forward_camera() * Rigid::exp(DVec3::ZERO, DVec3::new(-0.4, 0.0, 0.1));
        let mut first = frame(0.0, Rigid::IDENTITY);
        first.up_in_cam = Some(tilted.rotation.inverse() * DVec3::Z);
        let at = odometer.advance(&first, &mut world).unwrap();
        let map_from_cam = at.map_from_base * forward_camera();
        let up = map_from_cam.rotation * first.up_in_cam.unwrap();
        assert!(up.distance(DVec3::Z) < 1e-9, "{up}");
        // It still looks along x, but for what it was tilted by.
        let ahead = map_from_cam.rotation * DVec3::Z;
        assert!(ahead.y.abs() < 0.05 && ahead.x > 0.9, "{ahead}");
    }

    #[test]
    fn a_camera_that_goes_forward_takes_its_robot_along_x() {
        let (mut world, mut odometer) = (FrameTree::default(), Odometer::new(None));
        world.metres_per_unit = Some(2.0);
        let start = Rigid::exp(DVec3::new(0.3, -0.2, 0.9), DVec3::new(0.1, 0.7, -0.2));
        let at = |z: f64| start * Rigid::new(DQuat::IDENTITY, DVec3::new(0.0, 0.0, z));
        let first = odometer.advance(&frame(0.0, at(0.0)), &mut world).unwrap();
        assert!(close(&first.map_from_base, &Rigid::IDENTITY) && first.twist.is_none());
        let next = odometer.advance(&frame(0.5, at(0.4)), &mut world).unwrap();
        let wanted = Rigid::new(DQuat::IDENTITY, DVec3::new(0.8, 0.0, 0.0));
        assert!(close(&next.map_from_base, &wanted));
        assert!(close(&next.map_from_odom(), &Rigid::IDENTITY));
        let (speed, turn) = next.twist.unwrap();
        assert!((speed - DVec3::X * 1.6).length() < 1e-9 && turn.length() < 1e-9);
    }

    #[test]
    fn a_correction_of_the_map_moves_map_to_odom_and_leaves_odometry_alone() {
        let (mut world, mut odometer) = (FrameTree::default(), Odometer::new(None));
        let at = |x: f64| Rigid::new(DQuat::IDENTITY, DVec3::new(x, 0.0, 0.0));
        odometer.advance(&frame(0.0, at(0.0)), &mut world).unwrap();
        let moved = Similarity {
            scale: 1.0,
            rotation: DQuat::from_rotation_y(0.3),
            translation: DVec3::new(0.5, 0.1, 0.0),
        };
        let mut second = frame(0.1, moved.transform_pose(&at(0.2)));
        second.moved = Some(moved);
        let found = odometer.advance(&second, &mut world).unwrap();
        // A camera's right is a robot's right: -y.
        assert!((found.odom_from_base.translation - DVec3::new(0.0, -0.2, 0.0)).length() < 1e-9);
        assert!(found.map_from_odom().translation.length() > 0.3);
    }

    #[test]
    fn with_odometry_the_map_begins_at_its_origin() {
        let (mut world, mut odometer) = (FrameTree::default(), Odometer::new(None));
        let odom =
            Rigid::exp(DVec3::new(4.0, 2.0, 0.3), DVec3::new(0.0, 0.1, 0.2)) * forward_camera();
        let mut live = frame(0.0, Rigid::IDENTITY);
        live.odom_from_cam = Some(odom);
        let found = odometer.advance(&live, &mut world).unwrap();
        assert!(found.is_odom_given && close(&found.map_from_odom(), &Rigid::IDENTITY));
        let wanted = odom * forward_camera().inverse();
        assert!(close(&found.map_from_base, &wanted));
    }

    #[test]
    fn covariance_of_the_base_is_that_of_many_shaken_cameras() {
        let mount = Rigid::new(forward_camera().rotation, DVec3::new(0.5, 0.1, 0.3));
        let cam = Rigid::exp(DVec3::new(0.2, 0.4, 0.1), DVec3::new(0.4, 0.2, -0.7));
        let live = frame(0.0, Rigid::IDENTITY);
        let own = live.tracked.pose.unwrap().covariance;
        let cam_from_base = mount.inverse();
        let found = of_base(&own, 1.5, &cam, &cam_from_base);
        // Central differences of the base's place and orientation by each of the camera's six.
        let shaken = |axis: usize, by: f64| {
            let mut v = [0.0; 6];
            v[axis] = by;
            let place = DVec3::new(v[0], v[1], v[2]) * 1.5;
            let turn = DQuat::from_scaled_axis(DVec3::new(v[3], v[4], v[5]));
            cam * Rigid::new(turn, place) * cam_from_base
        };
        let base = cam * cam_from_base;
        let mut wanted = Matrix6::<f64>::zeros();
        for (axis, row) in own.iter().enumerate() {
            let (a, b) = (shaken(axis, 1e-5), shaken(axis, -1e-5));
            let place = (a.translation - b.translation) / 2e-5;
            let turn = (a.rotation * b.rotation.inverse()).to_scaled_axis() / 2e-5;
            let d = nalgebra::Vector6::new(place.x, place.y, place.z, turn.x, turn.y, turn.z);
            wanted += d * d.transpose() * row[axis];
        }
        assert!(base.is_finite());
        for i in 0..6 {
            for j in 0..6 {
                assert!((found[i][j] - wanted[(i, j)]).abs() < 1e-9, "{i} {j}");
            }
        }
    }
}
