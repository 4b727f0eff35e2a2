//! What browsers look at: the map of a run while it grows, a saved one, a recording of what went out, or a mapper elsewhere.

pub mod viewer;

pub mod saved;

pub mod followed_grid;

pub mod followed;
