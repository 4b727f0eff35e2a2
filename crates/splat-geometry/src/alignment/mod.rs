//! Windows of a network -> submaps: registration, loop closures, bundle adjustment.

mod kept_views;

mod epipolar_distance;

mod pair_similarity;

pub mod matched;

mod overlap;

pub mod params;

pub mod matches;

mod loops;

pub mod tracks;

pub mod depths;

mod inlier_tracks;

pub mod depth_bundle_state;

pub mod depth_bundle;

pub mod rescale_depth;

mod global_ba;

mod close_loops;

pub mod register_window;

pub mod epipolar;

pub mod aligner;

pub mod pair_matcher;
