//! Snapshot -> messages. The definitions are the files in msgs/msg, which say what each field means.

use std::ops::Range;

use glam::DQuat;
use serde::{Deserialize, Serialize};

use crate::ros::{
    self, CdrError, Header, Message, Pose, Time, header_def, pose_def, quaternion_def, separator,
    time_def, vector_defs,
};
use splat_types::camera::Intrinsics;
use splat_types::snapshot::{KeyframePose, Snapshot};
use splat_types::splats::layout;
use splat_types::splats::splats::Splats;

/// No message is larger, whatever the parameters say.
pub const MAX_MESSAGE_BYTES: usize = 1 << 20;

/// Bytes of one `KeyframePoseMsg` in CDR, alignment included.
const KEYFRAME_POSE_BYTES: usize = 112;

/// `splat_mapper_msgs/msg/SplatChunk`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SplatChunk {
    pub header: Header,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub map_sha256: [u8; 32],
    pub n_splats: u32,
    pub sh_degree: u8,
    pub n_chunks: u32,
    pub chunk_ix: u32,
    pub first_splat: u32,
    pub ids: Vec<u32>,
    pub crc32c: u32,
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
}

/// `splat_mapper_msgs/msg/SplatManifest`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SplatManifest {
    pub header: Header,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub map_sha256: [u8; 32],
    pub n_splats: u32,
    pub sh_degree: u8,
    pub n_chunks: u32,
    pub n_keyframes: u32,
    pub scale_source: u8,
    pub metres_per_unit: f64,
    pub scale_std: f64,
}

/// `splat_mapper_msgs/msg/KeyframePose`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct KeyframePoseMsg {
    pub keyframe_id: u32,
    pub stamp: Time,
    pub pose: Pose,
    pub width: u32,
    pub height: u32,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
}

/// `splat_mapper_msgs/msg/KeyframeArray`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct KeyframeArray {
    pub header: Header,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub n_keyframes: u32,
    pub first_ix: u32,
    pub keyframes: Vec<KeyframePoseMsg>,
}

macro_rules! keyframe_pose_body {
    () => {
        include_str!("../msgs/msg/KeyframePose.msg")
    };
}

/// `splat_mapper_msgs/msg/SplatDelta`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SplatDelta {
    pub header: Header,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub base_revision: u32,
    pub map_sha256: [u8; 32],
    pub n_splats: u32,
    pub sh_degree: u8,
    pub n_pieces: u32,
    pub piece_ix: u32,
    pub removed: Vec<u32>,
    pub ids: Vec<u32>,
    pub crc32c: u32,
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
}

impl Message for SplatDelta {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/SplatDelta";
    const DEFINITION: &'static str =
        concat!(include_str!("../msgs/msg/SplatDelta.msg"), header_def!());
}

impl Message for SplatChunk {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/SplatChunk";
    const DEFINITION: &'static str =
        concat!(include_str!("../msgs/msg/SplatChunk.msg"), header_def!());
}

impl Message for SplatManifest {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/SplatManifest";
    const DEFINITION: &'static str =
        concat!(include_str!("../msgs/msg/SplatManifest.msg"), header_def!());
}

impl Message for KeyframePoseMsg {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/KeyframePose";
    const DEFINITION: &'static str = concat!(keyframe_pose_body!(), time_def!(), pose_def!());
}

impl Message for KeyframeArray {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/KeyframeArray";
    const DEFINITION: &'static str = concat!(
        include_str!("../msgs/msg/KeyframeArray.msg"),
        header_def!(),
        separator!(),
        "MSG: splat_mapper_msgs/KeyframePose\n",
        keyframe_pose_body!(),
        pose_def!()
    );
}

/// A snapshot cut into messages. Chunks are made one at a time: the whole map need not be there twice.
#[derive(Debug)]
pub struct Messages<'a> {
    pub snapshot: &'a Snapshot,
    frame: &'a str,
    pub map_sha256: [u8; 32],
    pub chunk_bytes: usize,
    splats_per_chunk: usize,
    keyframes_per_array: usize,
}

impl<'a> Messages<'a> {
    /// A chunk holds at least one splat, however small `chunk_bytes` is. `frame` is the splats' own.
    pub fn new(snapshot: &'a Snapshot, frame: &'a str, chunk_bytes: usize) -> Self {
        let map_sha256 = layout::digest(&snapshot.splats);
        Self::of_known(snapshot, map_sha256, frame, chunk_bytes)
    }

    /// Where the splats' digest is known already.
    pub fn of_known(
        snapshot: &'a Snapshot,
        map_sha256: [u8; 32],
        frame: &'a str,
        chunk_bytes: usize,
    ) -> Self {
        let chunk_bytes = chunk_bytes.min(MAX_MESSAGE_BYTES / 2);
        Self {
            snapshot,
            frame,
            map_sha256,
            chunk_bytes,
            splats_per_chunk: splats_per_message(&snapshot.splats, chunk_bytes),
            keyframes_per_array: (chunk_bytes / KEYFRAME_POSE_BYTES).max(1),
        }
    }

    pub fn manifest(&self) -> SplatManifest {
        let snapshot = self.snapshot;
        let (scale_source, metres_per_unit, scale_std) = snapshot.scale.to_numbers();
        SplatManifest {
            header: self.header(),
            map_id: snapshot.map_id,
            epoch: snapshot.epoch,
            revision: snapshot.revision,
            map_sha256: self.map_sha256,
            n_splats: snapshot.splats.len() as u32,
            sh_degree: snapshot.splats.sh_degree,
            n_chunks: self.n_chunks() as u32,
            n_keyframes: snapshot.poses.len() as u32,
            scale_source,
            metres_per_unit,
            scale_std,
        }
    }

    /// At least one, so that a client learns of a map without keyframes.
    pub fn keyframes(&self) -> impl Iterator<Item = KeyframeArray> {
        let n_keyframes = self.snapshot.poses.len();
        (0..n_keyframes.max(1))
            .step_by(self.keyframes_per_array)
            .map(move |first| KeyframeArray {
                header: self.header(),
                map_id: self.snapshot.map_id,
                epoch: self.snapshot.epoch,
                revision: self.snapshot.revision,
                n_keyframes: n_keyframes as u32,
                first_ix: first as u32,
                keyframes: self.snapshot.poses
                    [first..n_keyframes.min(first + self.keyframes_per_array)]
                    .iter()
                    .map(KeyframePoseMsg::from)
                    .collect(),
            })
    }

    pub fn chunks(&self) -> impl Iterator<Item = SplatChunk> {
        self.chunks_from(0, self.n_chunks())
    }

    /// At most `n` of them.
    pub fn chunks_from(&self, first: usize, n: usize) -> impl Iterator<Item = SplatChunk> {
        let n_splats = self.snapshot.splats.len();
        (first..first.saturating_add(n).min(self.n_chunks())).map(move |chunk_ix| {
            let first = chunk_ix * self.splats_per_chunk;
            self.chunk(chunk_ix, first..n_splats.min(first + self.splats_per_chunk))
        })
    }

    fn chunk(&self, chunk_ix: usize, range: Range<usize>) -> SplatChunk {
        let snapshot = self.snapshot;
        let first_splat = range.start as u32;
        let ids = snapshot.splat_ids[range.clone()].to_vec();
        let mut data = Vec::new();
        layout::encode(&snapshot.splats, range, &mut data);
        SplatChunk {
            header: self.header(),
            map_id: snapshot.map_id,
            epoch: snapshot.epoch,
            revision: snapshot.revision,
            map_sha256: self.map_sha256,
            n_splats: snapshot.splats.len() as u32,
            sh_degree: snapshot.splats.sh_degree,
            n_chunks: self.n_chunks() as u32,
            chunk_ix: chunk_ix as u32,
            first_splat,
            ids,
            crc32c: crc32c::crc32c(&data),
            data,
        }
    }

    fn n_chunks(&self) -> usize {
        self.snapshot.splats.len().div_ceil(self.splats_per_chunk)
    }

    pub fn header(&self) -> Header {
        Header::new(self.snapshot.stamp, self.frame)
    }
}

/// Splats, and their ids, that fit into so many bytes; at least one.
pub fn splats_per_message(splats: &Splats, chunk_bytes: usize) -> usize {
    (chunk_bytes / (layout::bytes_per_splat(splats.sh_degree) + 4)).max(1)
}

impl From<&KeyframePose> for KeyframePoseMsg {
    fn from(pose: &KeyframePose) -> Self {
        let k = &pose.intrinsics;
        Self {
            keyframe_id: pose.keyframe_id,
            stamp: pose.stamp.into(),
            pose: pose.world_from_cam.into(),
            width: k.width_px,
            height: k.height_px,
            fx: k.fx,
            fy: k.fy,
            // Outside, pixel centres are at integers.
            cx: k.cx - 0.5,
            cy: k.cy - 0.5,
        }
    }
}

impl KeyframePoseMsg {
    /// `None` when pose or intrinsics are of no use.
    pub fn to_pose(&self) -> Option<KeyframePose> {
        let intrinsics = Intrinsics {
            width_px: self.width,
            height_px: self.height,
            fx: self.fx,
            fy: self.fy,
            cx: self.cx + 0.5,
            cy: self.cy + 0.5,
        };
        let mut world_from_cam = self.pose.to_rigid()?;
        // `to_rigid` divides by the length; a rotation that is of unit length already must come back bit for bit.
        let q = self.pose.orientation;
        let rotation = DQuat::from_xyzw(q.x, q.y, q.z, q.w);
        if (rotation.length_squared() - 1.0).abs() < 1e-9 {
            world_from_cam.rotation = rotation;
        }
        let stamp = self.stamp.into();
        intrinsics.is_plausible().then_some(KeyframePose {
            keyframe_id: self.keyframe_id,
            stamp,
            world_from_cam,
            intrinsics,
        })
    }
}

/// A message as it travels; the bound on its size is ours to keep.
pub fn payload<T: Message + Serialize>(message: &T) -> Result<Vec<u8>, CdrError> {
    let payload = ros::encode(message)?;
    assert!(
        payload.len() <= MAX_MESSAGE_BYTES,
        "{} of {} bytes",
        T::TYPE_NAME,
        payload.len()
    );
    Ok(payload)
}
