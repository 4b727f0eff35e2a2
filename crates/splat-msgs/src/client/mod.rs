//! Messages of a map -> the map: what a subscriber does.

pub mod assembler;

pub mod follower;
