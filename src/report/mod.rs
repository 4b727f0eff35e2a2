//! Figures -> report.html.

pub mod charts;

pub mod comparisons;

pub mod pose_quality;

pub mod top_view;

mod walk;

pub mod html;
