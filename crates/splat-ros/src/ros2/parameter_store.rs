//! Parameters as ROS 2 services list, describe, read and set them. The node implements this; nothing here knows which
//! parameters exist.

use std::sync::Arc;

use serde_json::Value;

use crate::ros2::params::{OnTimeJump, Ros2Params};
use splat_io::latest::Latest;

/// What a value may be.
#[derive(Debug, Clone, PartialEq)]
pub enum Range {
    /// `is_whole`: fractions are refused.
    Number {
        min: f64,
        max: f64,
        is_whole: bool,
    },
    Choice(Vec<String>),
    Flag,
    Text,
}

impl std::fmt::Display for Range {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Number { min, max, is_whole } => {
                let whole = if *is_whole { " (whole)" } else { "" };
                write!(f, "a number in [{min}, {max}]{whole}")
            }
            Self::Choice(names) => write!(f, "one of {}", names.join(", ")),
            Self::Flag => write!(f, "true or false"),
            Self::Text => write!(f, "text"),
        }
    }
}

/// One parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Descriptor {
    /// Dotted, for example `ros2.image_timeout`.
    pub key: String,
    pub range: Range,
    /// For example `px`.
    pub unit: Option<String>,
    pub text: String,
    /// It may change while the node runs.
    pub is_live: bool,
}

/// All parameters of a running node.
pub trait ParameterStore: Send + Sync {
    /// All parameters, by key.
    fn list(&self) -> Vec<Descriptor>;

    /// `None` for an unknown key.
    fn get(&self, key: &str) -> Option<Value>;

    /// All changes or none; the error gives the cause.
    fn set(&self, changes: &[(String, Value)]) -> Result<(), String>;
}

/// Parameters `ros2.*` that may change while the node runs. Times in s.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveRos2Params {
    pub image_timeout: f64,
    pub camera_info_timeout: f64,
    pub odometry_timeout: f64,
    pub on_time_jump: OnTimeJump,
}

impl LiveRos2Params {
    /// Keys of the fields.
    pub const KEYS: [&str; 4] = [
        "ros2.image_timeout",
        "ros2.camera_info_timeout",
        "ros2.odometry_timeout",
        "ros2.on_time_jump",
    ];

    pub fn of(params: &Ros2Params) -> Self {
        Self {
            image_timeout: params.image_timeout,
            camera_info_timeout: params.camera_info_timeout,
            odometry_timeout: params.odometry_timeout,
            on_time_jump: params.on_time_jump,
        }
    }
}

/// What the ROS 2 node reads of the parameters.
#[derive(Debug, Clone)]
pub struct Ros2Setup {
    /// As of the start.
    pub params: Ros2Params,
    pub live: Arc<Latest<LiveRos2Params>>,
    pub use_sim_time: bool,
    pub odom_frame: String,
    pub base_frame: String,
}

impl Ros2Setup {
    /// For a node that only looks at the graph: it subscribes to nothing, so no frame is looked up.
    pub fn for_survey() -> Self {
        let params = Ros2Params::default();
        Self {
            live: Arc::new(Latest::new(LiveRos2Params::of(&params))),
            params,
            use_sim_time: false,
            odom_frame: String::new(),
            base_frame: String::new(),
        }
    }
}
