//! Visual odometry, and what its poses are in the map: by the newest keyframe, or before there is one.

use crate::track::align::AlignmentFrame;
use crate::track::anchor::Anchor;
use crate::track::inertial_odometry::InertialOdometry;
use crate::track::landmarks::KeyframeView;
use crate::track::odometry_link::{LinkedKeyframe, LinkedMotion, LinkedPose, OdometryLink};
use crate::track::wheel_odometry::{MeasuredFrame, WheelOdometry};
use crate::visual_odometry::odometry::{OdometryPose, VisualOdometry};
use crate::working_camera::WorkingCamera;
use splat_types::camera::Intrinsics;
use splat_types::frame::Frame;
use splat_types::transform::{Rigid, Similarity};

/// The camera of the newest keyframe, as the map has refined it, and what the source said of it.
#[derive(Debug, Clone, Copy)]
struct FrameCamera {
    refined: WorkingCamera,
    stated: Option<Intrinsics>,
    frame_px: (u32, u32),
}

/// Poses that are reported before there is a map.
#[derive(Debug, Clone, Copy, PartialEq)]
enum BeforeMap {
    /// None yet.
    Waiting,
    /// Those of one segment of odometry, in its frame, until frames are found in the map.
    Reported { segment: u32, goes_on: bool },
    /// What was reported has its place in the map, or will never have one.
    Initialised,
}

/// How poses that were reported in odometry's frame lie in the map; `None` where that will not become known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MapInitialisation {
    pub(crate) segment: u32,
    pub(crate) world_from_odometry: Option<Similarity>,
}

/// Frames -> poses by visual odometry, and their place in the map.
#[derive(Debug)]
pub(crate) struct MapOdometry {
    /// `None`: frames are found by the map alone.
    odometry: Option<VisualOdometry>,
    link: OdometryLink,
    /// Odometry that the source has, such as that of wheels.
    wheels: WheelOdometry,
    pub(crate) inertial: InertialOdometry,
    camera: Option<FrameCamera>,
    before_map: BeforeMap,
}

impl MapOdometry {
    pub(crate) fn new(is_on: bool) -> Self {
        Self {
            odometry: is_on.then(VisualOdometry::default),
            link: OdometryLink::default(),
            wheels: WheelOdometry::default(),
            inertial: InertialOdometry::default(),
            camera: None,
            before_map: BeforeMap::Waiting,
        }
    }

    /// There is a map already: nothing is reported in another frame.
    pub(crate) fn in_map(self) -> Self {
        Self {
            before_map: BeforeMap::Initialised,
            ..self
        }
    }

    /// The newest frame, and its camera as the map has refined it.
    pub(crate) fn newest(&self) -> Option<AlignmentFrame<'_>> {
        let pyramid = self.odometry.as_ref()?.newest_image()?;
        let (width, height) = pyramid.image().size();
        let camera = self.camera?.refined.resized((width as u32, height as u32));
        Some(AlignmentFrame { pyramid, camera })
    }

    /// What the source's odometry and its IMU say of one more frame, whatever its image shows.
    pub(crate) fn follow_sensors(&mut self, frame: &Frame) {
        self.wheels.push(frame);
        self.inertial.push(frame);
    }

    /// Odometry of one more frame.
    pub(crate) fn follow(&mut self, frame: &Frame) -> Option<OdometryPose> {
        self.follow_sensors(frame);
        let odometry = self.odometry.as_mut()?;
        let size = (frame.image.width_px, frame.image.height_px);
        let is_same = |known: &FrameCamera| {
            known.frame_px == size
                && (frame.intrinsics.is_none() || frame.intrinsics == known.stated)
        };
        let known = self.camera.filter(is_same).map(|known| known.refined);
        let stated = frame.intrinsics.as_ref();
        let camera = known.or_else(|| WorkingCamera::of(stated?, None, size));
        let inertial = &self.inertial;
        let found = odometry.push_turned(frame, camera.as_ref(), |from| {
            inertial.turn(from, frame.stamp)
        });
        self.link.push(frame.seq, found.pose);
        found.pose
    }

    /// Where a frame is by a keyframe and the odometry since.
    pub(crate) fn locate(&self, seq: u64) -> Option<LinkedPose> {
        self.link.locate(seq)
    }

    /// How the camera has moved between two frames.
    pub(crate) fn motion(&self, earlier: u64, later: u64) -> Option<LinkedMotion> {
        self.link.motion(earlier, later)
    }

    /// Where a frame is by a keyframe and the source's odometry since.
    pub(crate) fn locate_by_wheels(&self, seq: u64) -> Option<LinkedPose> {
        self.trusted_wheels()?.link.locate(seq)
    }

    /// How the camera has moved between two frames by the source's odometry.
    pub(crate) fn motion_by_wheels(&self, earlier: u64, later: u64) -> Option<LinkedMotion> {
        self.trusted_wheels()?.link.motion(earlier, later)
    }

    /// The pose of a frame that the map has reached in the keyframe before it, by the keyframes on both sides.
    pub(crate) fn between_keyframes(&self, seq: u64) -> Option<(u32, Rigid)> {
        let by_images = self.link.between_keyframes(seq);
        by_images.or_else(|| self.trusted_wheels()?.link.between_keyframes(seq))
    }

    fn trusted_wheels(&self) -> Option<&WheelOdometry> {
        (!self.wheels.is_out()).then_some(&self.wheels)
    }

    /// Whether the source has odometry or an IMU.
    pub(crate) fn has_source(&self) -> bool {
        self.wheels.has_come() || self.inertial.has_come()
    }

    /// Whether odometry of the source disagrees with the camera and is left out.
    pub(crate) fn is_source_out(&self) -> bool {
        self.wheels.is_out()
    }

    /// One more frame whose place was measured in the map; `pose_of` gives those of frames before by the map of this moment.
    pub(crate) fn measured(
        &mut self,
        frame: MeasuredFrame,
        scene_depth: f64,
        pose_of: impl Fn(&Anchor) -> Option<Rigid>,
    ) {
        if self.wheels.has_come() {
            self.wheels.compare(frame, scene_depth, &pose_of);
        }
        if self.inertial.has_come() {
            self.inertial.measured(frame, scene_depth, &pose_of);
        }
    }

    /// Whether a pose is to be reported in odometry's frame, as there is no map: the first segment's.
    pub(crate) fn reports_before_map(&mut self, pose: &OdometryPose) -> bool {
        let of_segment = BeforeMap::Reported {
            segment: pose.segment,
            goes_on: true,
        };
        if self.before_map == BeforeMap::Waiting {
            self.before_map = of_segment;
        }
        self.before_map == of_segment
    }

    /// A frame was found in the map: from now on all are reported there. Returns whether others were reported elsewhere before, with
    /// nothing known of how that lies in the map.
    pub(crate) fn registered_in_map(&mut self) -> bool {
        match &mut self.before_map {
            BeforeMap::Reported { goes_on, .. } => std::mem::take(goes_on),
            BeforeMap::Waiting | BeforeMap::Initialised => {
                self.before_map = BeforeMap::Initialised;
                false
            }
        }
    }

    /// Takes over where the map has its keyframes now, in order of id.
    pub(crate) fn update(&mut self, views: &[KeyframeView]) -> Option<MapInitialisation> {
        let linked = || {
            views.iter().map(|view| LinkedKeyframe {
                id: view.keyframe.id,
                seq: view.keyframe.frame.seq,
                world_from_cam: view.world_from_cam,
            })
        };
        let newest = self.link.update(linked());
        self.wheels.link.update(linked());
        if let Some(view) = views.last() {
            self.camera = FrameCamera::of(view);
            if self.before_map == BeforeMap::Waiting {
                self.before_map = BeforeMap::Initialised;
            }
        }
        let BeforeMap::Reported { segment, .. } = self.before_map else {
            return None;
        };
        let (of, world_from_odometry) = newest?;
        self.before_map = BeforeMap::Initialised;
        Some(MapInitialisation {
            segment,
            world_from_odometry: (of == segment).then_some(world_from_odometry),
        })
    }
}

impl FrameCamera {
    fn of(view: &KeyframeView) -> Option<Self> {
        let frame = &view.keyframe.frame;
        let frame_px = (frame.image.width_px, frame.image.height_px);
        Some(Self {
            refined: WorkingCamera::of(&view.intrinsics, view.lens.as_ref(), frame_px)?,
            stated: frame.intrinsics,
            frame_px,
        })
    }
}
