//! A map with the depth of its keyframes -> what planners load: the two files of map_server, a mesh, a volume of distances.
//!
//! The frame is the robot's map frame, as it was saved with the map, turned so that the ground is level: what the run published, and what a run that goes
//! on from the map publishes. A map that was made without anything published begins at its first keyframe, which looks along x. Metres.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{IVec2, IVec3};
use serde_json::json;

use crate::formats::mesh_glb;
use splat_io::whole_file::write_file;
use splat_ros::odometry::saved_map_frame;
use splat_slam::mapper::map_file::checkpoint::Checkpoint;
use splat_types::snapshot::KeyframePose;
use splat_types::transform::Similarity;
use splat_volume::blocks::SIDE;
use splat_volume::grid::{FREE, Grid, OCCUPIED, grid};
use splat_volume::map_file;
use splat_volume::mesh::{Mesh, mesh};
use splat_volume::mesh_colour::colours;
use splat_volume::params::GridParams;
use splat_volume::volume::{KeyframeDepth, Volume};

/// Voxels of a volume that is written as one array: 512 MiB.
const MAX_VOXELS: u64 = 1 << 27;

/// What can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlannerFile {
    /// `.yaml` for map_server, and a `.pgm` beside it.
    Grid,
    /// `.mesh.ply`
    MeshPly,
    /// `.mesh.glb`
    MeshGlb,
    /// `.npy`, and a `.json` beside it that says where it lies.
    Distances,
}

#[derive(Debug, thiserror::Error)]
pub enum PlannerError {
    #[error(
        "the map holds no depth of keyframes: map again with map.save_images_mib above 0, or name a .splatmap and not a .ply"
    )]
    NoDepth,
    #[error(
        "the map's scale is unknown, so that heights and distances are: map with a baseline, depth, odometry or scale.camera_height, or \
         --set grid.allow_unscaled=true for one metre a unit"
    )]
    Unscaled,
    #[error(
        "no ground was seen: a plane with 3 % of all places seen that leans by less than 25 degrees from level, with nothing below it"
    )]
    NoGround,
    #[error("the depth of keyframe {keyframe_id} cannot be read: {reason}")]
    Depth { keyframe_id: u32, reason: String },
    #[error(
        "a volume of {n} voxels is more than {MAX_VOXELS}; raise grid.resolution or lower grid.max_range"
    )]
    TooLarge { n: u64 },
    #[error("cannot write: {reason}: {}", path.display())]
    Write { reason: String, path: PathBuf },
}

impl PlannerFile {
    /// By the ending of its name.
    pub fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?.to_ascii_lowercase();
        let known = [
            (".yaml", Self::Grid),
            (".mesh.ply", Self::MeshPly),
            (".mesh.glb", Self::MeshGlb),
            (".npy", Self::Distances),
        ];
        let is_named = |ending: &str| name.len() > ending.len() && name.ends_with(ending);
        let found = known.into_iter().find(|(ending, _)| is_named(ending));
        found.map(|(_, file)| file)
    }

    /// Writes the file -> what it holds. `volume`: of the map.
    pub fn write(
        self,
        map: &Checkpoint,
        volume: &mut Volume,
        out: &Path,
    ) -> Result<String, PlannerError> {
        match self {
            Self::Grid => {
                let grid = grid_of(volume)?;
                let image = out.with_extension("pgm");
                let name = image.file_name().unwrap_or_default().to_string_lossy();
                save(&image, &map_file::pgm(&grid))?;
                save(out, map_file::yaml(&grid, &name).as_bytes())?;
                let n = |wanted: i8| grid.cells.iter().filter(|cell| **cell == wanted).count();
                Ok(format!(
                    "{} free and {} occupied cells of {} m",
                    n(FREE),
                    n(OCCUPIED),
                    grid.resolution
                ))
            }
            Self::MeshPly => {
                let (mesh, colours) = coloured_mesh(map, volume);
                save(out, &mesh.ply(&colours))?;
                Ok(format!("{} triangles", mesh.triangles.len()))
            }
            Self::MeshGlb => {
                let (mesh, colours) = coloured_mesh(map, volume);
                let name = out.file_name().unwrap_or_default().to_string_lossy();
                let write = |file: &mut dyn Write| mesh_glb::write(&mesh, &colours, &name, file);
                write_file(out, |file| write(file)).map_err(fault(out))?;
                Ok(format!("{} triangles", mesh.triangles.len()))
            }
            Self::Distances => distances(volume, out),
        }
    }
}

/// All keyframes of the map that have depth, fused.
pub fn volume(map: &Checkpoint, params: &GridParams) -> Result<Volume, PlannerError> {
    let metres = map.snapshot.scale.metres_per_unit;
    if metres.is_none() && !params.allow_unscaled {
        return Err(PlannerError::Unscaled);
    }
    let poses = map.snapshot.poses.iter();
    let poses: BTreeMap<u32, &KeyframePose> = poses.map(|pose| (pose.keyframe_id, pose)).collect();
    let map_from_world = map_from_world_of(map);
    let mut keyframes = Vec::new();
    for view in &map.views {
        let Some(pose) = poses.get(&view.keyframe_id) else {
            continue;
        };
        let k = pose.intrinsics;
        let unpacked = view.unpacked((k.width_px, k.height_px));
        let (_, depth) = unpacked.map_err(|reason| PlannerError::Depth {
            keyframe_id: view.keyframe_id,
            reason,
        })?;
        keyframes.push(KeyframeDepth {
            id: view.keyframe_id,
            map_from_camera: map_from_world * Similarity::from(pose.world_from_cam),
            intrinsics: k,
            depth: Arc::new(depth),
        });
    }
    let volume = fused(&keyframes, params);
    if volume.voxels().n_blocks() == 0 {
        return Err(PlannerError::NoDepth);
    }
    Ok(volume)
}

/// The mesh of all that was fused, and a colour for each vertex.
fn coloured_mesh(map: &Checkpoint, volume: &Volume) -> (Mesh, Vec<[u8; 3]>) {
    let voxels = volume.voxels();
    let level_from_world = volume.in_level(&map_from_world_of(map));
    let mesh = mesh(voxels);
    let colours = colours(&mesh, voxels.size, &map.snapshot.splats, &level_from_world);
    (mesh, colours)
}

fn map_from_world_of(map: &Checkpoint) -> Similarity {
    let frame = saved_map_frame(map.map_frame, &map.snapshot.poses);
    let metres = map.snapshot.scale.metres_per_unit;
    frame.map_from_world(metres.unwrap_or(1.0))
}

/// What cannot be fused is left out, with a warning.
pub fn fused(keyframes: &[KeyframeDepth], params: &GridParams) -> Volume {
    let mut volume = Volume::new(params);
    let mut faults = volume.set_keyframes(keyframes);
    faults.extend(volume.fuse(usize::MAX).1);
    for fault in faults {
        tracing::warn!("{fault}");
    }
    volume
}

/// Cells of all that was fused.
pub fn grid_of(volume: &mut Volume) -> Result<Grid, PlannerError> {
    grid(volume, None, IVec2::ZERO).ok_or(PlannerError::NoGround)
}

/// Truncated signed distances as a NumPy array of 32-bit floats, indices z, y, x; NaN where nothing was seen.
fn distances(volume: &Volume, out: &Path) -> Result<String, PlannerError> {
    let voxels = volume.voxels();
    let blocks = voxels.indices();
    let low = blocks.iter().fold(IVec3::MAX, |a, b| a.min(*b)) * SIDE;
    let high = (blocks.iter().fold(IVec3::MIN, |a, b| a.max(*b)) + 1) * SIDE;
    let size = (high - low).as_i64vec3();
    let n = size.x.saturating_mul(size.y).saturating_mul(size.z) as u64;
    if n > MAX_VOXELS {
        return Err(PlannerError::TooLarge { n });
    }
    let beside = out.with_extension("json");
    let origin = (low.as_dvec3() * voxels.size).to_array();
    let place = json!({
        "array": "signed distance to the nearest surface in metres, positive in free space, at most the truncation; NaN: not seen",
        "index_order": "z, y, x",
        "voxel_m": voxels.size,
        "truncation_m": voxels.truncation,
        "lower_corner_m": origin,
        "frame": "the robot's map frame, turned level: z up",
    });
    save(&beside, format!("{place:#}\n").as_bytes())?;
    let fill = |file: &mut dyn Write| -> io::Result<()> {
        file.write_all(&npy_header(size.to_array().map(|n| n as u64)))?;
        for z in low.z..high.z {
            for y in low.y..high.y {
                for x in low.x..high.x {
                    let distance = voxels
                        .voxel(IVec3::new(x, y, z))
                        .distance(voxels.truncation);
                    let value = distance.map_or(f32::NAN, |metres| metres as f32);
                    file.write_all(&value.to_le_bytes())?;
                }
            }
        }
        Ok(())
    };
    write_file(out, |file| fill(file)).map_err(fault(out))?;
    Ok(format!("{} x {} x {} voxels", size.x, size.y, size.z))
}

/// Version 1.0 of the format, padded to 64 bytes.
fn npy_header([x, y, z]: [u64; 3]) -> Vec<u8> {
    let text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({z}, {y}, {x}), }}");
    let padded = (10 + text.len() + 1).div_ceil(64) * 64 - 10;
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend_from_slice(&(padded as u16).to_le_bytes());
    bytes.extend_from_slice(format!("{text:<width$}\n", width = padded - 1).as_bytes());
    bytes
}

fn save(path: &Path, bytes: &[u8]) -> Result<(), PlannerError> {
    write_file(path, |file| file.write_all(bytes)).map_err(fault(path))
}

fn fault(path: &Path) -> impl Fn(io::Error) -> PlannerError {
    let path = path.to_owned();
    move |e| PlannerError::Write {
        reason: e.to_string(),
        path: path.clone(),
    }
}
