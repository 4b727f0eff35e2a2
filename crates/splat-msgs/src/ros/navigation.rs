//! Messages that planners read: occupancy grids with their updates, and slices of a distance field.

use serde::{Deserialize, Serialize};

use crate::ros::{
    Header, Message, Pose, Time, Vector3, header_def, pose_def, quaternion_def, separator,
    time_def, vector_defs,
};

/// `nav_msgs/msg/MapMetaData`: `origin` is the lower left corner of cell (0, 0).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MapMetaData {
    pub map_load_time: Time,
    /// Metres.
    pub resolution: f32,
    pub width: u32,
    pub height: u32,
    pub origin: Pose,
}

/// `nav_msgs/msg/OccupancyGrid`: row by row from the lowest y, -1, 0 or 100.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct OccupancyGrid {
    pub header: Header,
    pub info: MapMetaData,
    pub data: Vec<i8>,
}

impl Message for OccupancyGrid {
    const TYPE_NAME: &'static str = "nav_msgs/msg/OccupancyGrid";
    const DEFINITION: &'static str = concat!(
        "std_msgs/Header header\nMapMetaData info\nint8[] data\n",
        header_def!(),
        separator!(),
        "MSG: nav_msgs/MapMetaData\nbuiltin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\n",
        "geometry_msgs/Pose origin\n",
        pose_def!()
    );
}

/// `map_msgs/msg/OccupancyGridUpdate`: a part of the last grid, `x` and `y` in its cells.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OccupancyGridUpdate {
    pub header: Header,
    pub x: i32,
    pub y: i32,
    pub width: u32,
    pub height: u32,
    pub data: Vec<i8>,
}

impl Message for OccupancyGridUpdate {
    const TYPE_NAME: &'static str = "map_msgs/msg/OccupancyGridUpdate";
    const DEFINITION: &'static str = concat!(
        "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n",
        header_def!()
    );
}

/// `nvblox_msgs/msg/DistanceMapSlice`: metres to the nearest obstacle, `origin` the lower left corner with z the height of the slice.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct DistanceMapSlice {
    pub header: Header,
    /// Metres.
    pub resolution: f32,
    pub width: u32,
    pub height: u32,
    pub origin: Vector3,
    /// Of cells that nobody knows.
    pub unknown_value: f32,
    pub data: Vec<f32>,
}

impl Message for DistanceMapSlice {
    const TYPE_NAME: &'static str = "nvblox_msgs/msg/DistanceMapSlice";
    const DEFINITION: &'static str = concat!(
        "std_msgs/Header header\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Point origin\nfloat32 unknown_value\n",
        "float32[] data\n",
        header_def!(),
        vector_defs!("Point")
    );
}
