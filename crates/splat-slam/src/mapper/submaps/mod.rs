//! Submaps of the geometry -> one world frame: updates of poses, prior maps, map corrections.

pub(crate) mod pose_anchor;

mod prior_alignment;

pub mod prior_map;

pub(crate) mod pose_revision;

pub(crate) mod parked;

pub(crate) mod parked_submaps;

pub(crate) mod registry;

pub(crate) mod active;

pub(crate) mod pose_updates;
