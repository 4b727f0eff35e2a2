//! The services that the node offers: names, types, definitions.

use crate::ellipsoid_message;
use crate::ros::standard::TriggerResponse;
use crate::ros::{
    Message, camera_info_body, header_def, image_body, pose_def, quaternion_def, region_def,
    separator, time_def, vector_defs,
};

/// A service by name and type.
#[derive(Debug, PartialEq, Eq)]
pub struct Service {
    /// Below the node's own name.
    pub name: &'static str,
    /// Such as `std_srvs/srv/Trigger`.
    pub type_name: &'static str,
    /// `.srv` text of question and answer, dependencies appended to each as in `Message::DEFINITION`.
    pub request_definition: &'static str,
    pub response_definition: &'static str,
    pub kind: Kind,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    SaveMap,
    LoadMap,
    Export,
    Reset,
    Pause,
    Resume,
    GetSplats,
    RenderView,
    GetDistances,
    GetDistanceBox,
    GetEllipsoids,
    GetMesh,
}

macro_rules! trigger {
    ($name:literal, $kind:expr) => {
        Service {
            name: $name,
            type_name: "std_srvs/srv/Trigger",
            request_definition: "",
            response_definition: TriggerResponse::DEFINITION,
            kind: $kind,
        }
    };
}

const GET_SPLATS_RESPONSE: &str = concat!(
    "bool success\nstring message\nSplatManifest manifest\nSplatChunk[] chunks\n",
    header_def!(),
    separator!(),
    "MSG: splat_mapper_msgs/SplatManifest\n",
    include_str!("../msgs/msg/SplatManifest.msg"),
    separator!(),
    "MSG: splat_mapper_msgs/SplatChunk\n",
    include_str!("../msgs/msg/SplatChunk.msg")
);
const BOX_REQUEST: &str = "string frame_id\nfloat32[3] low\nfloat32[3] high\n";
const RENDER_VIEW_REQUEST: &str = concat!(
    "std_msgs/Header header\ngeometry_msgs/Pose pose\nsensor_msgs/CameraInfo camera\nbool with_depth\n",
    pose_def!(),
    separator!(),
    "MSG: sensor_msgs/CameraInfo\n",
    camera_info_body!(),
    header_def!(),
    region_def!()
);
const RENDER_VIEW_RESPONSE: &str = concat!(
    "bool success\nstring message\nsensor_msgs/Image image\nsensor_msgs/Image depth\n",
    separator!(),
    "MSG: sensor_msgs/Image\n",
    image_body!(),
    header_def!()
);

/// All of them.
pub static SERVICES: [Service; 12] = [
    Service {
        name: "save_map",
        type_name: "splat_mapper_msgs/srv/SaveMap",
        request_definition: "string path\n",
        response_definition: "bool success\nstring message\nstring path\n",
        kind: Kind::SaveMap,
    },
    Service {
        name: "load_map",
        type_name: "splat_mapper_msgs/srv/LoadMap",
        request_definition: "string path\n",
        response_definition: "bool success\nstring message\nstring path\n",
        kind: Kind::LoadMap,
    },
    Service {
        name: "export",
        type_name: "splat_mapper_msgs/srv/Export",
        request_definition: "string path\n",
        response_definition: "bool success\nstring message\nstring path\n",
        kind: Kind::Export,
    },
    trigger!("reset", Kind::Reset),
    trigger!("pause", Kind::Pause),
    trigger!("resume", Kind::Resume),
    Service {
        name: "get_splats",
        type_name: "splat_mapper_msgs/srv/GetSplats",
        request_definition: "uint32 revision\nuint32 first_chunk\nuint32 max_chunks\n",
        response_definition: GET_SPLATS_RESPONSE,
        kind: Kind::GetSplats,
    },
    Service {
        name: "render_view",
        type_name: "splat_mapper_msgs/srv/RenderView",
        request_definition: RENDER_VIEW_REQUEST,
        response_definition: RENDER_VIEW_RESPONSE,
        kind: Kind::RenderView,
    },
    Service {
        name: "get_distances",
        type_name: "splat_mapper_msgs/srv/GetDistances",
        request_definition: "string frame_id\nfloat32[] points\nfloat32 max_distance\n",
        response_definition: concat!(
            "bool success\nstring message\nstring frame_id\nuint32 epoch\nuint32 revision\nfloat32[] distances\nfloat32[] gradients\n",
            "bool[] known\n"
        ),
        kind: Kind::GetDistances,
    },
    Service {
        name: "get_distance_box",
        type_name: "splat_mapper_msgs/srv/GetDistanceBox",
        request_definition: "string frame_id\nfloat32[3] low\nfloat32[3] high\nfloat32 max_distance\n",
        response_definition: concat!(
            "bool success\nstring message\nstring frame_id\nuint32 epoch\nuint32 revision\nfloat32 resolution\n",
            "float32[3] origin\nuint32[3] size\nfloat32[] distances\nbool[] known\n"
        ),
        kind: Kind::GetDistanceBox,
    },
    Service {
        name: "get_ellipsoids",
        type_name: "splat_mapper_msgs/srv/GetEllipsoids",
        request_definition: BOX_REQUEST,
        response_definition: ellipsoid_message::RESPONSE_DEFINITION,
        kind: Kind::GetEllipsoids,
    },
    Service {
        name: "get_mesh",
        type_name: "splat_mapper_msgs/srv/GetMesh",
        request_definition: BOX_REQUEST,
        response_definition: concat!(
            "bool success\nstring message\nstring frame_id\nuint32 epoch\nuint32 revision\nfloat32[] vertices\n",
            "uint8[] colors\nuint32[] triangles\n"
        ),
        kind: Kind::GetMesh,
    },
];
