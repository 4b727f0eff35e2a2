//! All integration tests in one binary: one link of the dependencies.
#![allow(
    unreachable_pub,
    reason = "nothing outside uses a test binary; pub says what other modules may use"
)]
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod aligned_tracking;
mod alignment;
mod bags;
mod budgets;
mod camera_script;
mod cameras;
mod corrections;
mod crash;
mod declared_lengths;
mod deltas;
mod device_loss;
mod eval;
mod eval_lines;
mod exposure;
mod formats;
mod gpu_runs;
mod graphs;
mod ground_truth;
mod hard_images;
mod hard_world;
mod hooked;
mod hostile_bags;
mod hostile_scenes;
mod html;
mod images;
mod joint;
mod layers;
mod lenses;
mod live_end;
mod localise;
mod loops;
mod lpips;
mod metric_scale;
mod mvs;
mod node_over_zenoh;
mod old_names;
mod onnx;
mod onnx_models;
mod onnx_node;
mod over_zenoh;
mod photometric;
mod pose_anchor;
mod provisional_splats;

mod publish;
mod real_poses;
mod recordings;
mod relocation;
mod render_poses;
mod replay;
mod report;
mod resume;
mod scene_formats;
mod scene_points;
mod scene_reference;
mod scenes;
mod sent_corrections;
mod sent_submaps;
mod sfm;
mod sfm_batches;
mod sfm_corridor;
mod sfm_lenses;
mod sfm_live;
mod shader_layouts;
mod shaders;
mod sizes;
mod slam;
mod source_errors;
mod sources;
mod stress;
mod submap_runs;
mod submaps;
mod synthetic;
mod synthetic_source;
mod topics;
mod tracking;
mod tracking_node;
mod trajectory;
mod type_hashes;
mod visual_odometry;
mod xfeat;
