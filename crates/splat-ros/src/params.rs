//! Parameters of what is published, `publish.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters `publish.*`: transports, messages, frames and services.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PublishParams {
    /// Publish poses and splats over zenoh.
    pub zenoh: bool,
    /// Endpoint to listen on; empty = none.
    pub zenoh_listen: String,
    /// Endpoint to connect to, for example tcp/127.0.0.1:7447; empty = none.
    pub zenoh_connect: String,
    /// File with a zenoh configuration (TLS, access control) that replaces the two above.
    pub zenoh_config: String,
    /// Find peers by UDP multicast.
    pub scouting: bool,
    /// First element of every key, as ROS_DOMAIN_ID.
    #[schemars(range(min = 0, max = 232))]
    pub domain_id: u32,
    /// Second element of every key, the node's name.
    pub namespace: String,
    /// Address that Foxglove connects to for all topics, for example 127.0.0.1:8765. Who reaches it reads everything and can
    /// command nothing; empty = none.
    pub foxglove: String,
    /// MCAP file that all outgoing messages are written to; empty = none.
    pub record: String,
    /// Address that the viewer's page is served on, for example 127.0.0.1:8642; 0.0.0.0:8642 for other machines; empty = none.
    pub view: String,
    /// What browsers must bring (?token=...); empty = nothing on this machine, a random one, printed at the start, for other machines.
    pub view_token: String,
    /// Encryption of the viewer: off; self_signed; or CERTIFICATE.pem,KEY.pem. Headsets offer VR only with it, or on localhost.
    pub view_tls: String,
    /// Browsers that may look at once.
    #[schemars(range(min = 1, max = 64))]
    pub view_clients: usize,
    /// Highest degree of spherical harmonics that browsers get: 20 bytes a splat at 0, 28 at 1, 44 at 2, 60 at 3.
    #[schemars(range(min = 0, max = 3))]
    pub view_sh_degree: u8,
    /// Topic of nav_msgs/Path that the viewer draws, over ROS 2 or zenoh: where a planner means to go; empty = none.
    pub plan_topic: String,
    /// Payload of one chunk of a snapshot.
    #[schemars(range(min = 1024, max = 262144))]
    pub chunk_bytes: usize,
    /// Wall time between whole snapshots; in between, visible changes are published as deltas. 0 = every snapshot
    /// whole.
    #[schemars(range(min = 0.0, max = 86400.0), extend("unit" = "s"))]
    pub full_map_period: f64,
    /// Largest delta, share of the bytes of a whole snapshot; the greatest changes go first.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub delta_share: f64,
    /// Points of the cloud for planners.
    #[schemars(range(min = 1, max = 50000))]
    pub cloud_points: usize,
    /// Frame of poses, path and clouds: z up, metres where the scale is known. Its origin is that of odometry,
    /// else the robot's first position.
    pub map_frame: String,
    /// Frame of odometry.
    pub odom_frame: String,
    /// Frame of the robot.
    pub base_frame: String,
    /// Frame of splats and keyframes, in the axes and scale of the map; tf connects it to the map frame,
    /// SplatManifest gives its scale in metres.
    pub splat_frame: String,
    /// Frame of the camera where the images name none.
    pub camera_frame: String,
    /// Transforms to broadcast: map to odom (odometry comes from elsewhere); map to odom and odom to base; none.
    /// auto takes the first where odometry exists.
    pub tf: TfMode,
    /// Transforms from the map frame stay valid this long after their frame.
    #[schemars(range(min = 0.0, max = 10.0), extend("unit" = "s"))]
    pub tf_tolerance: f64,
    /// Corrections move map to odom no faster than this at the robot, so that navigation does not jump; pose and
    /// correction report the whole correction at once. 0 = at once.
    #[schemars(range(min = 0.0, max = 100.0), extend("unit" = "m/s"))]
    pub max_correction_speed: f64,
    /// The same for rotations, where max_correction_speed is above 0.
    #[schemars(range(min = 0.0, max = 3600.0), extend("unit" = "deg/s"))]
    pub max_correction_rotation_deg: f64,
    /// x y z qx qy qz qw of the camera in the base frame; empty takes tf where it exists, else a camera that
    /// faces forward at the robot's origin.
    pub base_from_camera: String,
    /// Folder that services may write to and read from; empty = they may not.
    pub map_directory: String,
    /// A replay stays up this long after its end for late subscribers.
    #[schemars(range(min = 0.0, max = 86400.0), extend("unit" = "s"))]
    pub shutdown_delay: f64,
}

impl Default for PublishParams {
    fn default() -> Self {
        Self {
            zenoh: false,
            zenoh_listen: "tcp/127.0.0.1:0".to_owned(),
            zenoh_connect: String::new(),
            zenoh_config: String::new(),
            scouting: true,
            domain_id: 0,
            namespace: "splat_mapper".to_owned(),
            foxglove: String::new(),
            record: String::new(),
            view: String::new(),
            view_token: String::new(),
            view_tls: "off".to_owned(),
            view_clients: 16,
            view_sh_degree: 3,
            plan_topic: "/plan".to_owned(),
            chunk_bytes: 196608,
            full_map_period: 30.0,
            delta_share: 0.1,
            cloud_points: 40000,
            map_frame: "map".to_owned(),
            odom_frame: "odom".to_owned(),
            base_frame: "base_link".to_owned(),
            splat_frame: "splat_map".to_owned(),
            camera_frame: "camera_optical".to_owned(),
            tf: TfMode::Auto,
            tf_tolerance: 0.2,
            max_correction_speed: 0.0,
            max_correction_rotation_deg: 10.0,
            base_from_camera: String::new(),
            map_directory: String::new(),
            shutdown_delay: 0.0,
        }
    }
}

/// Which transforms the node broadcasts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum TfMode {
    /// `Odom` where the input brings odometry, else `Full`.
    Auto,
    /// map to odom: odometry comes from elsewhere.
    Odom,
    /// map to odom and odom to base.
    Full,
    /// None.
    Off,
}
