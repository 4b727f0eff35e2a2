//! Run directories and images -> figures.

pub mod error;

pub mod alignment;

pub mod numbers;

pub mod image_metrics;

pub mod exposure_fit;

pub mod lpips;

pub mod params;

pub mod images;

pub mod render;

pub mod report_json;

pub mod trajectory;

pub mod evaluation;

pub mod frames;
