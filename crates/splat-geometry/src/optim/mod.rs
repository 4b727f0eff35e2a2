//! Nonlinear least squares: bundle adjustment, pose graphs, covariance of a pose.

pub mod damped;

pub mod bundle;

pub mod pose_graph;

pub mod pose_covariance;
