//! Two snapshots of different epochs -> how the map moved as a whole.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::map::align;
use crate::map::correction::Reason;
use crate::map::snapshot::Snapshot;
use crate::pose::{Rigid, Similarity};
use crate::publish::face::{Delivery, Topic};
use crate::ros::{Header, Message, Pose};
use crate::ros::{header_def, quaternion_def, separator, time_def, transform_defs, vector_defs};

pub static CORRECTION: Topic =
    Topic::of::<MapCorrection>("correction", Delivery::Latched { depth: 10 });

/// Why a map moved; the numbers of `MapCorrection.msg`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapMove {
    Loop,
    Merge,
    Reset,
    Loaded,
}

/// `splat_mapper_msgs/msg/MapCorrection`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MapCorrection {
    pub header: Header,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub new_map_from_old_map: Pose,
    pub scale: f64,
    pub shift: f64,
    pub turn_rad: f64,
    pub reason: u8,
}

impl Message for MapCorrection {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/MapCorrection";
    const DEFINITION: &'static str = concat!(
        include_str!("../../msgs/msg/MapCorrection.msg"),
        header_def!(),
        transform_defs!()
    );
}

impl MapMove {
    fn code(self) -> u8 {
        match self {
            Self::Loop => 0,
            Self::Merge => 1,
            Self::Reset => 2,
            Self::Loaded => 3,
        }
    }
}

/// `None` where both are of one epoch.
pub fn correction(
    old: &Snapshot,
    new: &Snapshot,
    why: Option<Reason>,
    frame: &str,
) -> Option<MapCorrection> {
    let is_other = old.map_id != new.map_id;
    if !is_other && old.epoch == new.epoch {
        return None;
    }
    let olds: BTreeMap<u32, Rigid> = old
        .poses
        .iter()
        .map(|pose| (pose.keyframe_id, pose.map_from_cam))
        .collect();
    let pairs: Vec<(Rigid, Rigid)> = new
        .poses
        .iter()
        .filter_map(|pose| Some((pose.map_from_cam, *olds.get(&pose.keyframe_id)?)))
        .collect();
    let is_merged = why == Some(Reason::Merge);
    let (found, why) = match align::align(&pairs) {
        Some(similarity) if !is_other && is_merged => (similarity, MapMove::Merge),
        Some(similarity) if !is_other => (similarity, MapMove::Loop),
        _ if new.poses.is_empty() => (Similarity::IDENTITY, MapMove::Reset),
        _ if is_other => (Similarity::IDENTITY, MapMove::Loaded),
        _ => (Similarity::IDENTITY, MapMove::Loop),
    };
    let (shift, turn_rad) = pairs.last().map_or((0.0, 0.0), |(is, was)| {
        (is.translation.distance(was.translation), is.angle_to(was))
    });
    Some(MapCorrection {
        header: Header::new(new.stamp, frame),
        map_id: new.map_id,
        epoch: new.epoch,
        revision: new.revision,
        new_map_from_old_map: Rigid::new(found.rotation, found.translation).into(),
        scale: found.scale,
        shift,
        turn_rad,
        reason: why.code(),
    })
}
