//! All integration tests in one binary: one link of the dependencies.
#![allow(
    unreachable_pub,
    reason = "nothing outside uses a test binary; pub says what other modules may use"
)]
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod alignment;
mod backends;
mod bags;
mod budgets;
mod camera_script;
mod cameras;
mod continued;
mod corrections;
mod crash;
mod declared_lengths;
mod deltas;
mod engine;
mod eval;
mod eval_lines;
mod exposures;
mod formats;
mod gauge;
mod gpu_memory;
mod gpu_runs;
mod gradients;
mod graphs;
mod hard_pictures;
mod hard_world;
mod hostile_bags;
mod hostile_scenes;
mod hostile_splats;
mod html;
mod joint;
mod known;
mod layers;
mod lenses;
mod localise;
mod loops;
mod lpips;
mod mcmc;
mod metres;
mod moves;
mod mvs;
mod node_over_zenoh;
mod onnx;
mod onnx_models;
mod onnx_node;
mod opening;
mod over_zenoh;
mod pictures;
mod publish;
mod recordings;
mod reference;
mod refiner;
mod render;
mod render_poses;
mod replay;
mod report;
mod scene_formats;
mod scene_reference;
mod scenes;
mod sfm;
mod sfm_batches;
mod sfm_lenses;
mod shader_layouts;
mod shaders;
mod shared_poses;
mod sources;
mod steps;
mod synthetic;
mod synthetic_source;
mod topics;
mod tracking;
mod tracking_node;
mod trajectory;
mod xfeat;
