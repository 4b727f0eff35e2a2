//! The node: stages on threads with bounded queues between them, or one after the other in sequence.
//!
//! The end of the input is the only way to end: each stage ends when its queue does. Ctrl-C stops the source alone.

pub mod stop;

pub mod engines;

mod refinement;

pub mod open_source;

pub mod page_file;

pub mod save_map;

mod rate_limited;

mod grid_thread;

mod publish_threads;

mod requests;

pub mod track_thread;

pub mod job;

pub mod autosave;

mod backpressure;

mod recovery;

pub mod ros2;

mod source_thread;

mod quality;

mod milestones;

mod select_stage;

mod map_stage;

mod open;

mod top_view;

pub mod run_dir;

pub mod localise;

mod threads;

mod geometry_thread;

pub mod pipeline;
