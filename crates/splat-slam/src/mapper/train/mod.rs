//! What the engine is asked to do and when: schedule, seeds, growth, held-out views.

mod loss_curve;

pub mod schedule;

mod match_weights;

mod correspondences;

mod strong_gradients;

pub(crate) mod held_out;

pub mod photometric;

pub(crate) mod landmark_depth;

pub mod seed;

mod convergence;

mod transient;

pub(crate) mod grow_prune;

mod nearest;

mod seed_shape;

pub(crate) mod start_points;

mod scene_extent;

mod densify;

pub(crate) mod trainer;
