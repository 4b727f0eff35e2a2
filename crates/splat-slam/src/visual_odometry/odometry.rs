//! Visual odometry: every frame -> its pose in the frame of a segment, how sure it is, and why there is none.

use std::collections::BTreeMap;

use glam::{DQuat, DVec2};

use crate::select::motion::grey_of_size;
use crate::select::optical_flow::Pyramid;
use crate::visual_odometry::feature_tracks::FeatureTracks;
use crate::visual_odometry::local_map::LocalMap;
use crate::visual_odometry::two_view_start::{NoStart, start};
use crate::working_camera::WorkingCamera;
use splat_types::covariance::Covariance;
use splat_types::frame::Frame;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Pixels of the image that corners are followed on: 640x480, and a wide image of a car's camera, are not shrunk.
pub(crate) const MAX_PX: usize = 500_000;
/// A segment ends when no frame has had a pose for so long.
const MAX_LOST_SECS: f64 = 0.5;
/// While a segment is to begin, its first image is replaced when so few of its corners are left.
const MIN_LEFT: f64 = 0.2;
/// Frames between attempts to begin.
const START_EVERY: u64 = 2;
/// Points have errors in common, which residuals don't show: variances are so many times larger.
const DESIGN_EFFECT: f64 = 4.0;
/// A motion is carried on over so many times the time that it was measured over, at most.
const MAX_AHEAD: f64 = 2.0;

/// What odometry found for a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryPose {
    /// Poses of different segments have nothing in common.
    pub segment: u32,
    pub odometry_from_cam: Rigid,
    /// Of the camera in its own axes, in odometry's unit.
    pub covariance: Covariance,
    pub n_inliers: usize,
}

/// How odometry stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OdometryState {
    /// No calibration of the camera is known.
    NoCamera,
    /// The image shows too few corners.
    Blank,
    /// The camera has not moved aside yet, or has only turned.
    NoParallax,
    /// The frame has a pose.
    Tracking,
    /// No pose was found; the segment ends soon.
    Lost,
}

/// What odometry says of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryFrame {
    pub seq: u64,
    pub stamp: Stamp,
    pub state: OdometryState,
    pub pose: Option<OdometryPose>,
    /// Corners that are followed.
    pub n_tracked: usize,
}

#[derive(Debug)]
enum Stage {
    /// The corners of the first image.
    Starting {
        first: BTreeMap<u32, DVec2>,
    },
    Running(Box<Running>),
}

#[derive(Debug)]
struct Running {
    map: LocalMap,
    /// The last two poses.
    last: (Stamp, Rigid),
    before: Option<(Stamp, Rigid)>,
}

/// Frames in order of time, poses out. Knows no threads; equal frames give equal poses.
#[derive(Debug)]
pub struct VisualOdometry {
    tracks: FeatureTracks,
    camera: Option<WorkingCamera>,
    stage: Stage,
    segment: u32,
    n_frames: u64,
}

impl Default for VisualOdometry {
    fn default() -> Self {
        Self {
            tracks: FeatureTracks::default(),
            camera: None,
            stage: Stage::Starting {
                first: BTreeMap::new(),
            },
            segment: 0,
            n_frames: 0,
        }
    }
}

impl VisualOdometry {
    /// The newest image and its halvings.
    pub(crate) fn newest_image(&self) -> Option<&Pyramid> {
        self.tracks.newest_image()
    }

    /// `camera`: that of the frame, for images of any size; a frame without one was taken by the last one.
    pub fn push(&mut self, frame: &Frame, camera: Option<&WorkingCamera>) -> OdometryFrame {
        self.push_turned(frame, camera, |_| None)
    }

    /// The same where something has measured the turn since a frame before, `earlier_from_later`.
    pub fn push_turned(
        &mut self,
        frame: &Frame,
        camera: Option<&WorkingCamera>,
        turn_since: impl Fn(Stamp) -> Option<DQuat>,
    ) -> OdometryFrame {
        let grey = grey_of_size(&frame.image, MAX_PX);
        let size = (grey.width as u32, grey.height as u32);
        self.n_frames += 1;
        self.update_camera(camera, size);
        let found = match self.camera {
            None => Err(OdometryState::NoCamera),
            Some(camera) => {
                let expected = self.prediction(frame.stamp, &turn_since);
                let running = match &self.stage {
                    Stage::Running(running) => Some(running),
                    Stage::Starting { .. } => None,
                };
                let depth = running.map_or(1.0, |running| running.map.median_depth());
                self.tracks.follow(grey, |track| {
                    let (running, now) = running.zip(expected.as_ref())?;
                    let (map, before) = (&running.map, &running.last.1);
                    let at = map.expected(track.id, now).or_else(|| {
                        let pixel = DVec2::from(track.pixel.map(f64::from));
                        map.expected_at(camera.undistorted(pixel), depth, [before, now])
                    });
                    Some(camera.distorted(at?)?.as_vec2().to_array())
                });
                self.pose(frame.stamp, expected, &camera)
            }
        };
        OdometryFrame {
            seq: frame.seq,
            stamp: frame.stamp,
            state: *found.as_ref().err().unwrap_or(&OdometryState::Tracking),
            pose: found.ok(),
            n_tracked: self.tracks.tracks.len(),
        }
    }

    /// A segment keeps the camera that it began with.
    fn update_camera(&mut self, camera: Option<&WorkingCamera>, (width, height): (u32, u32)) {
        let is_other_size = self.camera.is_some_and(|camera| {
            (camera.pinhole.width_px, camera.pinhole.height_px) != (width, height)
        });
        if is_other_size {
            self.restart();
            self.camera = None;
        }
        if matches!(self.stage, Stage::Running(_)) {
            return;
        }
        if let Some(camera) = camera.filter(|camera| camera.pinhole.is_plausible()) {
            self.camera = Some(camera.resized((width, height)));
        }
    }

    /// Where the camera is if it goes on as it went, or turns as was measured.
    fn prediction(
        &self,
        stamp: Stamp,
        turn_since: impl Fn(Stamp) -> Option<DQuat>,
    ) -> Option<Rigid> {
        let Stage::Running(running) = &self.stage else {
            return None;
        };
        let (at, pose) = running.last;
        let on = running.before.map_or(pose, |(at_before, before)| {
            let step = at.secs_since(at_before).max(1e-6);
            let share = (stamp.secs_since(at) / step).clamp(0.0, MAX_AHEAD);
            before.between(&pose, 1.0 + share)
        });
        let Some(turn) = turn_since(at) else {
            return Some(on);
        };
        Some(turned_by(&on, &pose, turn))
    }

    /// The frame whose corners were followed last.
    fn pose(
        &mut self,
        stamp: Stamp,
        expected: Option<Rigid>,
        camera: &WorkingCamera,
    ) -> Result<OdometryPose, OdometryState> {
        let seen: Vec<(u32, DVec2)> = self.seen(camera).collect();
        match &mut self.stage {
            Stage::Starting { first } => {
                let both = |(id, at): &(u32, DVec2)| Some((*id, *first.get(id)?, *at));
                let shared: Vec<(u32, DVec2, DVec2)> = seen.iter().filter_map(both).collect();
                if (shared.len() as f64) < MIN_LEFT * first.len() as f64 || first.is_empty() {
                    return Err(self.begin(camera));
                }
                if !self.n_frames.is_multiple_of(START_EVERY) {
                    return Err(OdometryState::NoParallax);
                }
                match start(&shared, &camera.pinhole, self.n_frames) {
                    Ok(found) => {
                        let second = seen.iter().copied().collect();
                        let pixels = [std::mem::take(first), second];
                        let map = LocalMap::new(camera.pinhole, found, pixels);
                        Ok(self.run(stamp, map))
                    }
                    Err(NoStart::NoParallax) => Err(OdometryState::NoParallax),
                    Err(NoStart::Lost) => Err(self.begin(camera)),
                }
            }
            Stage::Running(_) => self.locate(stamp, &expected.unwrap_or(Rigid::IDENTITY), &seen),
        }
    }

    /// Corners of the newest image: (number, where a pinhole shows it).
    fn seen(&self, camera: &WorkingCamera) -> impl Iterator<Item = (u32, DVec2)> {
        let pixel = |p: [f32; 2]| camera.undistorted(DVec2::from(p.map(f64::from)));
        let tracks = self.tracks.tracks.iter();
        let seen = tracks.map(move |track| (track.id, pixel(track.pixel)));
        seen.filter(|(_, at)| at.is_finite())
    }

    /// The newest image is the first of a segment that is to begin.
    fn begin(&mut self, camera: &WorkingCamera) -> OdometryState {
        self.tracks.refill();
        let first: BTreeMap<u32, DVec2> = self.seen(camera).collect();
        let is_blank = first.is_empty();
        self.stage = Stage::Starting { first };
        if is_blank {
            OdometryState::Blank
        } else {
            OdometryState::NoParallax
        }
    }

    fn run(&mut self, stamp: Stamp, map: LocalMap) -> OdometryPose {
        let pose = map.newest_pose();
        self.segment += 1;
        self.tracks.refill();
        let variance = (0.01_f64).powi(2);
        let out = OdometryPose {
            segment: self.segment,
            odometry_from_cam: pose.inverse(),
            covariance: std::array::from_fn(|i| {
                std::array::from_fn(|j| if i == j { variance } else { 0.0 })
            }),
            n_inliers: 0,
        };
        self.stage = Stage::Running(Box::new(Running {
            map,
            last: (stamp, pose),
            before: None,
        }));
        out
    }

    fn locate(
        &mut self,
        stamp: Stamp,
        guess: &Rigid,
        seen: &[(u32, DVec2)],
    ) -> Result<OdometryPose, OdometryState> {
        let Stage::Running(running) = &mut self.stage else {
            return Err(OdometryState::Lost);
        };
        let Some(found) = running.map.locate(seen, guess, self.n_frames) else {
            if stamp.secs_since(running.last.0) > MAX_LOST_SECS {
                self.restart();
            }
            return Err(OdometryState::Lost);
        };
        let mut pose = found.cam_from_odom;
        let outliers = &found.outliers;
        self.tracks.retain(|id| !outliers.contains(&id));
        let seen: Vec<(u32, DVec2)> = seen
            .iter()
            .filter(|(id, _)| !outliers.contains(id))
            .copied()
            .collect();
        if running.map.is_due(&seen, found.n_inliers) {
            running.map.add_keyframe(pose, &seen);
            pose = running.map.newest_pose();
            self.tracks.refill();
        }
        running.before = Some(running.last);
        running.last = (stamp, pose);
        let covariance = found.covariance.map(|row| row.map(|v| v * DESIGN_EFFECT));
        Ok(OdometryPose {
            segment: self.segment,
            odometry_from_cam: pose.inverse(),
            covariance,
            n_inliers: found.n_inliers,
        })
    }

    /// What comes next has nothing in common with what was.
    fn restart(&mut self) {
        self.tracks.retain(|_| false);
        self.stage = Stage::Starting {
            first: BTreeMap::new(),
        };
    }
}

/// A camera that stands where one is predicted to be, and has turned by `turn` (`earlier_from_later`) since one before.
pub(crate) fn turned_by(predicted: &Rigid, before: &Rigid, turn: DQuat) -> Rigid {
    let place = predicted.inverse().translation;
    let rotation = (turn.inverse() * before.rotation).normalize();
    Rigid::new(rotation, -(rotation * place))
}
