//! Figures -> report.html.

pub mod charts;

pub mod comparisons;

pub mod pose_quality;

mod walk;

pub mod html;
