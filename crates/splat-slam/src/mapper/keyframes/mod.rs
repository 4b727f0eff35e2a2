//! Keyframes of the map: registered ones, their images, and which of them are in memory.

pub mod image_codec;

pub(crate) mod training_image;

pub mod residency;

pub mod registered;

pub(crate) mod metric_ratios;

pub(crate) mod store;

pub(crate) mod saved_views;

pub(crate) mod poses;

pub(crate) mod tracker_views;
