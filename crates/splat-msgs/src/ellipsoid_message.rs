//! Splats that planners keep clear of, as their message. What each field means is said in msgs/msg/EllipsoidArray.msg.

use serde::{Deserialize, Serialize};

use crate::ros::{Header, Message, header_def, separator, time_def};

/// `splat_mapper_msgs/msg/EllipsoidArray`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct EllipsoidArray {
    pub header: Header,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub k_sigma: f32,
    pub min_opacity: f32,
    pub min_observations: u32,
    pub low: [f32; 3],
    pub high: [f32; 3],
    pub n_left_out: u32,
    pub complete_within: f32,
    pub ids: Vec<u32>,
    pub means: Vec<f32>,
    pub rotations: Vec<f32>,
    pub semi_axes: Vec<f32>,
    pub opacities: Vec<f32>,
    pub observations: Vec<u32>,
    pub last_keyframes: Vec<u32>,
    pub position_sigmas: Vec<f32>,
}

impl Message for EllipsoidArray {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/EllipsoidArray";
    const DEFINITION: &'static str = concat!(
        include_str!("../msgs/msg/EllipsoidArray.msg"),
        header_def!()
    );
}

/// As an answer has it.
pub(crate) const RESPONSE_DEFINITION: &str = concat!(
    "bool success\nstring message\nEllipsoidArray ellipsoids\n",
    header_def!(),
    separator!(),
    "MSG: splat_mapper_msgs/EllipsoidArray\n",
    include_str!("../msgs/msg/EllipsoidArray.msg")
);
