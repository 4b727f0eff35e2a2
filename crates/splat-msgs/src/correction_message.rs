//! A correction of the map -> its message.

use serde::{Deserialize, Serialize};

use crate::ros::{
    Header, Message, Pose, header_def, quaternion_def, separator, time_def, transform_defs,
    vector_defs,
};
use splat_types::correction::{MapCorrection, Reason};
use splat_types::snapshot::Snapshot;
use splat_types::transform::{Rigid, Similarity};

/// `splat_mapper_msgs/msg/MapCorrection`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MapCorrectionMsg {
    pub header: Header,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub new_world_from_old_world: Pose,
    pub scale: f64,
    pub translation: f64,
    pub rotation_rad: f64,
    pub reason: u8,
}

impl Message for MapCorrectionMsg {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/MapCorrection";
    const DEFINITION: &'static str = concat!(
        include_str!("../msgs/msg/MapCorrection.msg"),
        header_def!(),
        transform_defs!()
    );
}

/// The message of a correction that `snapshot` is the first to show; `frame` is the splats' own.
pub fn message(correction: &MapCorrection, snapshot: &Snapshot, frame: &str) -> MapCorrectionMsg {
    let moved = &correction.new_world_from_old_world;
    MapCorrectionMsg {
        header: Header::new(snapshot.stamp, frame),
        map_id: snapshot.map_id,
        epoch: snapshot.epoch,
        revision: snapshot.revision,
        new_world_from_old_world: Rigid::new(moved.rotation, moved.translation).into(),
        scale: moved.scale,
        translation: correction.translation,
        rotation_rad: correction.rotation_rad,
        reason: code(correction.reason),
    }
}

/// In the order of the numbers of `MapCorrection.msg`.
const REASONS: [Reason; 5] = [
    Reason::Loop,
    Reason::Merge,
    Reason::Reset,
    Reason::Loaded,
    Reason::Renumbered,
];

fn code(reason: Reason) -> u8 {
    REASONS
        .iter()
        .position(|known| *known == reason)
        .unwrap_or(0) as u8
}

impl MapCorrectionMsg {
    /// `None` where a number is none, or the reason unknown.
    pub fn to_correction(&self) -> Option<MapCorrection> {
        let moved = self.new_world_from_old_world.to_rigid()?;
        let numbers = [self.scale, self.translation, self.rotation_rad];
        let is_sound = numbers.iter().all(|v| v.is_finite()) && self.scale > 0.0;
        let reason = *REASONS.get(usize::from(self.reason))?;
        is_sound.then_some(MapCorrection {
            epoch: self.epoch,
            revision: self.revision,
            new_world_from_old_world: Similarity {
                scale: self.scale,
                rotation: moved.rotation,
                translation: moved.translation,
            },
            translation: self.translation,
            rotation_rad: self.rotation_rad,
            reason,
        })
    }
}
