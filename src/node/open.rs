//! A job -> the stages that hold a map: begun anew, or gone on with from a saved one.

use std::path::Path;

use anyhow::{anyhow, bail};

use crate::node::autosave::Autosave;
use crate::node::job::Job;
use crate::node::map_stage::MapStage;
use crate::node::milestones::Milestones;
use crate::node::page_file::PageFile;
use crate::node::recovery::Recovery;
use crate::node::stop::ShutdownTimeout;
use crate::node::track_thread::TrackStage;
use splat_io::queue::{WhenFull, queue};
use splat_ros::odometry::saved_map_frame;
use splat_slam::mapper::map_file::checkpoint;
use splat_slam::mapper::mapper::Mapper;
use splat_slam::mapper::params::Start;
use splat_types::snapshot::Scale;
use splat_types::sparse_point::SparsePoint;

/// The map, who tracks by it, and the first id of keyframes that come.
pub(crate) struct Opened {
    pub(crate) map: MapStage,
    pub(crate) track: TrackStage,
    pub(crate) first_id: u32,
}

/// Takes over the calls of services.
/// `has_depth_of_poses`: as the geometry model says.
pub(crate) fn open(
    job: &mut Job,
    scale: Scale,
    has_depth_of_poses: bool,
) -> anyhow::Result<Opened> {
    let params = &job.params;
    let engine = job.engines.best(params.backend, params.deterministic)?;
    let pages = PageFile::new(job.out.as_deref(), params.map.max_page_file_mib << 20);
    let mut map = Mapper::new(params.mapper(), params.seed, scale, engine)
        .measuring_scale(&params.scale)
        .with_depth_of_poses(has_depth_of_poses)
        .paging_to(Box::new(pages));
    if params.train.start == Start::Points {
        map = map.starting_from(start_points(job)?);
    }
    let mut track = TrackStage::new(&params.track, job.is_live);
    track.grace = ShutdownTimeout::new(job.stop.clone());
    if !params.map.resume.is_empty() {
        let saved = checkpoint::read(Path::new(&params.map.resume))?;
        track.begin_in(&saved.landmarks, &params.track)?;
        if let Some(output) = &job.output {
            let frame = saved_map_frame(saved.map_frame, &saved.snapshot.poses);
            output.handles.frames.set_map_frame(frame);
        }
        map = map
            .resume_report(saved, &params.track)
            .map_err(|reason| anyhow!("cannot go on from {}: {reason}", params.map.resume))?;
    }
    let first_id = map.first_id();
    let n_frames = job.source.len_hint().filter(|n| *n > 0);
    let mut map = MapStage::new(
        map,
        params,
        (job.is_live, n_frames),
        Recovery::new(params, job.is_live, job.engines.clone(), job.stop.clone()),
        job.output.as_mut(),
    );
    map.figures.milestones = Milestones::of(params, job.is_live)?;
    map.autosave = Autosave::start(job.out.as_deref(), params.map.autosave_secs)?;
    if map.autosave.is_some() || job.output.is_some() {
        let (reported, landmarks) = queue("landmarks", 1, WhenFull::DropOldest);
        track.save_landmarks_to(params.map.autosave_secs, reported);
        map.request_handler.receive_landmarks(landmarks);
    }
    Ok(Opened {
        map,
        track,
        first_id,
    })
}

/// Points in the frame of the poses that the geometry answers with.
fn start_points(job: &Job) -> anyhow::Result<Vec<SparsePoint>> {
    let params = &job.params;
    if params.geometry != "ground_truth" || params.ground_truth.windows {
        bail!(
            "train.start = points, and geometry {:?} has poses in a frame of its own, not in that of the scene's points: use --geometry ground_truth without ground_truth.windows, or train.start=depth",
            params.geometry
        );
    }
    let points = job.source.sparse_points()?;
    if points.is_empty() {
        bail!(
            "train.start = points, and the source has no sparse points: name a COLMAP scene with points3D.bin or points3D.txt beside its cameras, or a transforms.json with ply_file_path, or use train.start=depth"
        );
    }
    tracing::info!("{} points of the scene to start from", points.len());
    Ok(points)
}
