//! What is said in JSON, docs/VIEWER.md.

use glam::{DMat3, DVec3};
use serde_json::{Value, json};

use crate::hash::Hash;
use crate::view_map::{SeenKeyframe, ViewMap};
use splat_msgs::status_message::MapperStatus;
use splat_types::correction::{MapCorrection, Reason};
use splat_types::tracking::{TrackState, TrackedFrame};
use splat_types::transform::Rigid;

pub const PROTOCOL: u32 = 1;
/// By the code of `MapperStatus.state`.
const STATES: [&str; 7] = [
    "initialising",
    "tracking",
    "lost",
    "relocalised",
    "paused",
    "ended",
    "recovering",
];

pub fn welcome(source: &str, title: &str) -> String {
    let server = concat!("splat-mapper ", env!("CARGO_PKG_VERSION"));
    json!({"type": "welcome", "protocol": PROTOCOL, "server": server, "source": source, "title": title})
        .to_string()
}

pub fn bye(reason: &str) -> String {
    json!({"type": "bye", "reason": reason}).to_string()
}

/// An update begins. `sh_degree`: of the client.
pub fn map(map: &ViewMap, sh_degree: u8) -> String {
    let to_map = &map.map_from_world;
    let q = to_map.rotation;
    json!({
        "type": "map",
        "map_id": hex(&map.map_id),
        "epoch": map.epoch,
        "revision": map.revision,
        "sh_degree": map.sh_degree.min(sh_degree),
        "n_splats": map.n_splats(),
        "metres_per_unit": map.scale.metres_per_unit,
        "scale_source": map.scale.source.name(),
        "rotation": [q.x, q.y, q.z, q.w],
        "translation": to_map.translation.to_array(),
        "scale": to_map.scale,
    })
    .to_string()
}

pub fn keyframes(seen: &[SeenKeyframe], removed: &[u32]) -> String {
    let row = |seen: &SeenKeyframe| {
        let (pose, i) = (&seen.pose, seen.pose.intrinsics);
        let mut row = vec![json!(pose.keyframe_id), json!(secs(pose.stamp.nanos))];
        row.extend(numbers(&pose.world_from_cam).map(Value::from));
        row.extend([json!(i.width_px), json!(i.height_px)]);
        row.extend([i.fx, i.fy, i.cx, i.cy].map(Value::from));
        Value::Array(row)
    };
    let rows: Vec<Value> = seen.iter().map(row).collect();
    json!({"type": "keyframes", "keyframes": rows, "removed": removed}).to_string()
}

pub fn dropped(chunks: &[u32]) -> String {
    json!({"type": "drop", "chunks": chunks}).to_string()
}

pub fn synced(map: &ViewMap, n_splats: usize, hash: Hash) -> String {
    json!({"type": "synced", "epoch": map.epoch, "revision": map.revision, "n_splats": n_splats, "hash": hash.0})
        .to_string()
}

/// The camera now; `metres_per_unit` 1 where it is not known.
pub fn pose(frame: &TrackedFrame, metres_per_unit: f64) -> String {
    let state = match frame.state {
        TrackState::Initialising => STATES[0],
        TrackState::Tracking => STATES[1],
        TrackState::Lost => STATES[2],
        TrackState::Relocalised => STATES[3],
    };
    let pose = frame.pose.filter(|_| frame.state != TrackState::Lost);
    let reason = frame.reason.map(|reason| reason.to_string());
    let mut message = json!({
        "type": "pose",
        "stamp": secs(frame.stamp.nanos),
        "pose": pose.map(|pose| numbers(&pose.world_from_cam)),
        "state": state,
        "reason": reason,
    });
    if let Some(pose) = pose {
        // Of the camera's own axes: turned into those of the splat frame.
        let turn = DMat3::from_quat(pose.world_from_cam.rotation);
        let std = |first: usize| {
            let row = |i: usize| {
                DVec3::from_array(std::array::from_fn(|j| {
                    pose.covariance[first + i][first + j]
                }))
            };
            let block = DMat3::from_cols(row(0), row(1), row(2));
            let turned = turn * block * turn.transpose();
            [0, 1, 2].map(|k| turned.col(k)[k].max(0.0).sqrt())
        };
        message["std_m"] = json!(std(0).map(|v| v * metres_per_unit));
        message["std_rad"] = json!(std(3));
    }
    message.to_string()
}

/// The fields of the message, without its header; numbers that are not known are null.
pub fn status(status: &MapperStatus) -> String {
    let mut message = serde_json::to_value(status).unwrap_or_default();
    if let Value::Object(fields) = &mut message {
        fields.remove("header");
        let state = STATES.get(usize::from(status.state)).copied();
        fields.insert("state".to_owned(), json!(state.unwrap_or("unknown")));
        fields.insert("map_id".to_owned(), json!(hex(&status.map_id)));
        fields.insert("type".to_owned(), json!("status"));
        fields.insert(
            "stamp".to_owned(),
            json!(
                f64::from(status.header.stamp.sec) + 1e-9 * f64::from(status.header.stamp.nanosec)
            ),
        );
    }
    message.to_string()
}

pub fn correction(correction: &MapCorrection) -> String {
    let reason = match correction.reason {
        Reason::Loop => "loop",
        Reason::Merge => "merge",
        Reason::Reset => "reset",
        Reason::Loaded => "loaded",
        Reason::Renumbered => "renumbered",
    };
    json!({"type": "correction", "reason": reason, "moved": correction.translation, "rotation_rad": correction.rotation_rad})
        .to_string()
}

/// A line in the robot's map frame, metres.
pub fn path(name: &str, points: &[DVec3]) -> String {
    let points: Vec<[f64; 3]> = points.iter().map(DVec3::to_array).collect();
    json!({"type": "path", "name": name, "points": points}).to_string()
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn secs(nanos: i64) -> f64 {
    nanos as f64 * 1e-9
}

fn numbers(pose: &Rigid) -> [f64; 7] {
    let (q, t) = (pose.rotation, pose.translation);
    [q.x, q.y, q.z, q.w, t.x, t.y, t.z]
}
