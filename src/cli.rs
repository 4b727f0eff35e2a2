//! The command line: arguments only. What a command does stands in `node`, `eval` and `source`.

mod mapping;

mod commands;

mod recording;

mod view;

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};

use crate::view::viewer;
use splat_ros::ros2::names::split_arguments;

/// Camera frames in, refined poses and a 3D Gaussian splat map out.
#[derive(Debug, Parser)]
#[command(version, about, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Maps a source until it ends or Ctrl-C
    Run(RunArgs),
    /// Maps a recording or a folder of images and writes a run directory
    Replay(ReplayArgs),
    /// Finds the camera in a map of an earlier run, frame by frame, and leaves the map as it is
    #[command(alias = "localize")]
    Localise(LocaliseArgs),
    /// Records a camera, or any source, into an MCAP file, until Ctrl-C
    Record(RecordArgs),
    /// Renders a recording with exact poses and depth
    Synth(SynthArgs),
    /// Compares the keyframes of a run with reference poses
    Eval(EvalArgs),
    /// Maps one scene in several ways and prints a table: quality, poses, time and memory
    Compare(CompareArgs),
    /// Renders a map from given poses
    Render(RenderArgs),
    /// Shows a map in a browser, until Ctrl-C
    View(ViewArgs),
    /// Converts a map to another format
    Export(ExportArgs),
    /// Looks at models for --geometry onnx:FILE
    #[command(subcommand)]
    Model(ModelCommand),
    /// Says what is missing on this machine, and the line that fixes it
    Doctor,
}

/// Parameters, as launch/params.yaml lists them.
#[derive(Debug, Args)]
struct ParamArgs {
    /// Values for a purpose, launch/presets/NAME.yaml: paper, 3dgs; --params and --set go over them
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// File in ROS 2 parameter form; any subset of launch/params.yaml
    #[arg(long, value_name = "FILE")]
    params: Option<PathBuf>,
    /// One parameter, for example map.max_splats=100000; repeatable
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

#[derive(Debug, Args)]
struct RunArgs {
    /// v4l2:/dev/video0, webcam:0, ros2:/TOPIC, mcap:PATH, images:DIR (images, COLMAP scene, transforms.json) or synthetic:SCENE
    #[arg(long, value_name = "URI")]
    source: String,
    /// Run directory to write at the end
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// map.splatmap of an earlier run to resume
    #[arg(long, visible_alias = "map", value_name = "FILE")]
    resume: Option<PathBuf>,
    /// Serves a page that shows the map while it grows: ADDRESS:PORT, else 127.0.0.1:8642
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = viewer::DEFAULT_ADDRESS)]
    view: Option<String>,
    #[command(flatten)]
    params: ParamArgs,
}

#[derive(Debug, Args)]
struct ReplayArgs {
    /// MCAP file, rosbag2 folder, image folder or source URI
    #[arg(value_name = "BAG_OR_DIR")]
    input: String,
    /// Run directory to write
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// map.splatmap of an earlier run to resume
    #[arg(long, visible_alias = "map", value_name = "FILE")]
    resume: Option<PathBuf>,
    /// Multiple of the recorded speed, or max; with a number late frames are dropped and counted
    #[arg(long, value_name = "R|max")]
    rate: Option<String>,
    /// auto, wgpu or cpu
    #[arg(long)]
    backend: Option<String>,
    /// sfm, ground_truth or onnx:FILE
    #[arg(long)]
    geometry: Option<String>,
    /// Optimiser updates of the whole run
    #[arg(long)]
    steps: Option<u64>,
    /// Longer side of the working image, in pixels
    #[arg(long, value_name = "PX")]
    max_side: Option<u32>,
    /// Everything random follows from it
    #[arg(long)]
    seed: Option<u64>,
    /// Keeps every N-th keyframe out of optimisation to measure quality; 0 = off
    #[arg(long, value_name = "N")]
    holdout: Option<u32>,
    /// Serves a page that shows the map while it grows: ADDRESS:PORT, else 127.0.0.1:8642
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = viewer::DEFAULT_ADDRESS)]
    view: Option<String>,
    #[command(flatten)]
    params: ParamArgs,
}

#[derive(Debug, Args)]
struct LocaliseArgs {
    /// map.splatmap of an earlier run
    map: PathBuf,
    /// MCAP file, rosbag2 folder, image folder or source URI
    #[arg(value_name = "BAG_OR_DIR")]
    input: String,
    /// Folder for trajectory.tum, frames.csv and localisation.json
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Prints JSON
    #[arg(long)]
    json: bool,
    /// Serves a page that shows the camera in the map: ADDRESS:PORT, else 127.0.0.1:8642
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = viewer::DEFAULT_ADDRESS)]
    view: Option<String>,
    #[command(flatten)]
    params: ParamArgs,
}

#[derive(Debug, Args)]
struct ViewArgs {
    /// map.splatmap, the directory of a run, or a .ply or .spz of any program; zenoh:ENDPOINT follows a mapper elsewhere (zenoh: alone finds one),
    /// FILE.mcap of publish.record shows what it sent
    #[arg(value_name = "MAP|RUN_DIR|zenoh:ENDPOINT|FILE.mcap")]
    map: String,
    /// Address of the page; publish.view_* has token and encryption
    #[arg(long, value_name = "ADDRESS:PORT")]
    at: Option<String>,
    #[command(flatten)]
    params: ParamArgs,
}

#[derive(Debug, Args)]
struct RecordArgs {
    /// v4l2:/dev/video0, webcam:0 or any other source that run takes
    #[arg(long, value_name = "URI")]
    source: String,
    /// Recording to write; record.max_file_* splits it into FILE_1.mcap, FILE_2.mcap ...
    #[arg(long, value_name = "FILE.mcap")]
    out: PathBuf,
    /// Ends after so long
    #[arg(long, value_name = "SECS", value_parser = seconds)]
    duration: Option<f64>,
    #[command(flatten)]
    params: ParamArgs,
}

/// A time that can be waited for.
fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(secs) if secs > 0.0 && secs.is_finite() => Ok(secs),
        _ => Err("expected seconds above 0".to_owned()),
    }
}

#[derive(Debug, Args)]
struct SynthArgs {
    /// room, facade, corridor, hallway or house
    scene: String,
    /// Recording to write, FILE.mcap; its poses go beside it as .tum. With --layout a new folder
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// A folder of images and poses instead of a recording: colmap, nerfstudio, blender or robustnerf
    #[arg(long)]
    layout: Option<String>,
    #[arg(long)]
    frames: Option<u32>,
    /// Pixels
    #[arg(long)]
    width: Option<u32>,
    /// Pixels
    #[arg(long)]
    height: Option<u32>,
    /// Horizontal field of view in degrees
    #[arg(long)]
    fov: Option<f64>,
    /// pinhole, radial or fisheye
    #[arg(long)]
    lens: Option<String>,
    #[arg(long)]
    seed: Option<u64>,
    /// One more option, for example rate=30 (frames per second), noise=2, exposure=0.3, blur=0.5; repeatable
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

#[derive(Debug, Args)]
struct EvalArgs {
    /// Run directory of a replay
    run_dir: PathBuf,
    /// Reference poses, camera to world: a TUM file, a folder with poses_tum.txt, a COLMAP scene or a transforms.json
    #[arg(long, value_name = "FILE_OR_SCENE")]
    reference: PathBuf,
    /// Prints JSON
    #[arg(long)]
    json: bool,
}

/// Many fields: one for each flag.
#[derive(Debug, Args)]
struct CompareArgs {
    /// MCAP file, rosbag2 folder, folder of images, COLMAP scene or transforms.json
    scene: PathBuf,
    /// Folder for the table and a run directory of each row; rows that are there already are kept
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// ours, fastsplatting, 3dgs (the scene's points), colmap_3dgs, 3dgs_mcmc, 3rgs; the first is what others are compared with at equal
    /// time
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "ours,fastsplatting,colmap_3dgs,3dgs_mcmc,3rgs"
    )]
    rows: Vec<String>,
    /// Steps of every row; schedules of the methods are shortened to them
    #[arg(long, default_value_t = 1500)]
    steps: u64,
    /// Longer side of the images, pixels
    #[arg(long, value_name = "PX", default_value_t = 320)]
    max_side: u32,
    /// Cap on splats
    #[arg(long, default_value_t = 60_000)]
    max_splats: usize,
    /// Images drawn from a folder by the seed; 0 = all
    #[arg(long, default_value_t = 0)]
    images: usize,
    /// Where ours and FastSplatting take poses and depth from: sfm or onnx:FILE
    #[arg(long, default_value = "sfm")]
    geometry: String,
    /// auto, wgpu or cpu
    #[arg(long, default_value = "auto")]
    backend: String,
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Every N-th image of the scene is held out: the same images in all rows
    #[arg(long, value_name = "N", default_value_t = 10)]
    holdout: u32,
    /// Poses to measure by, as eval takes them; else the scene's own
    #[arg(long, value_name = "FILE_OR_SCENE")]
    reference: Option<PathBuf>,
    /// ONNX file of LPIPS (docs/FORMATS.md)
    #[arg(long, value_name = "FILE", default_value = "")]
    lpips: String,
    /// Prints JSON instead of the table
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct RenderArgs {
    /// map.splatmap or map.ply
    map: PathBuf,
    /// Poses to render from, camera to map, TUM format
    #[arg(long, value_name = "FILE")]
    poses: PathBuf,
    /// Pinhole camera as JSON: width, height, fx, fy, cx, cy; whole numbers are pixel centres
    #[arg(long, value_name = "FILE")]
    intrinsics: PathBuf,
    /// Folder for the PNG files
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Writes depth as 16-bit PNG too
    #[arg(long)]
    depth: bool,
    /// auto, wgpu or cpu
    #[arg(long, default_value = "auto")]
    backend: String,
}

#[derive(Debug, Args)]
struct ExportArgs {
    /// map.splatmap, or a .ply or .spz of any program
    map: PathBuf,
    /// OUT.ply, .compressed.ply, .spz, .glb or .splat; .yaml for map_server, .mesh.ply, .mesh.glb or .npy for planners; or DIR/ for a scene of
    /// images and poses
    out: PathBuf,
    /// Of a scene: colmap or nerfstudio
    #[arg(long)]
    layout: Option<String>,
    /// Of an .spz: 3, which web viewers read, or 4
    #[arg(long, value_name = "3|4", default_value_t = 3)]
    spz_version: u32,
    #[command(flatten)]
    params: ParamArgs,
}

#[derive(Debug, Subcommand)]
enum ModelCommand {
    /// Checks a model against the contract of docs/MODELS.md, and times windows of 1, 2, 4 ... frames
    Check(ModelCheckArgs),
}

#[derive(Debug, Args)]
struct ModelCheckArgs {
    /// ONNX file; its description lies beside it as .json
    #[arg(value_name = "FILE.onnx")]
    file: PathBuf,
    /// Prints JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    params: ParamArgs,
}

/// Runs the program: exit 0 done, 1 failed with one line that says why, 2 usage.
pub fn main() -> ExitCode {
    let (arguments, ros_arguments) = split_arguments(std::env::args_os());
    let cli = Cli::parse_from(arguments);
    let result = match cli.command {
        _ if !ros_arguments.is_empty() && !cfg!(feature = "ros2") => Err(Usage(
            "arguments behind --ros-args need a build with ROS 2; docs/ROS2.md says how".to_owned(),
        )
        .into()),
        Command::Run(args) => mapping::run(&args),
        Command::Replay(args) => mapping::replay(&args),
        Command::Localise(args) => mapping::localise(&args),
        Command::Record(args) => recording::run(&args),
        Command::Synth(args) => commands::synth(&args),
        Command::Eval(args) => commands::eval(&args),
        Command::Compare(args) => commands::compare(&args),
        Command::Render(args) => commands::render(&args),
        Command::View(args) => view::run(&args),
        Command::Export(args) => commands::export(&args),
        Command::Model(ModelCommand::Check(args)) => commands::model_check(&args),
        Command::Doctor => Ok(commands::doctor()),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            // The one place where an error is printed; a closed stderr is no reason to fail differently.
            writeln!(std::io::stderr(), "splat-mapper: {error:#}").ok();
            if error.is::<Usage>() {
                ExitCode::from(2)
            } else {
                ExitCode::FAILURE
            }
        }
    }
}

/// An argument that clap cannot check.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Usage(String);

/// Writes a line to stdout; a closed pipe is the reader's choice.
fn say(text: impl std::fmt::Display) {
    writeln!(std::io::stdout(), "{text}").ok();
}
