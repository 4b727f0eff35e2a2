//! Keyframes of the map: registered ones, their images, and which of them are in memory.

pub mod image_codec;

pub mod residency;

pub mod registered;

pub(crate) mod training_image;

pub(crate) mod metric_ratios;

pub(crate) mod store;

pub(crate) mod tracker_views;
