//! Grids of the volume -> what costmaps and planners read: the grid, its updates, distances to obstacles.

use std::sync::Arc;

use glam::{DQuat, DVec3};

use crate::error::PublishError;
use crate::obstacles::{ELLIPSOIDS, VOXELS, ellipsoid_array, voxel_cloud};
use crate::odometry::FrameCells;
use crate::params::PublishParams;
use crate::publisher::Publisher;
use crate::reports::Reports;
use crate::shared_volume::{SharedVolume, VolumeFrames};
use crate::transport::{Delivery, Event, Sample, Topic};
use splat_msgs::ros::navigation::{
    DistanceMapSlice, MapMetaData, OccupancyGrid, OccupancyGridUpdate,
};
use splat_msgs::ros::{Header, Pose, TfMessage, TransformStamped, Vector3};
use splat_types::snapshot::Snapshot;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::{Rigid, Similarity};
use splat_volume::distance::{UNKNOWN_DISTANCE, signed_distances};
use splat_volume::ellipsoids::Region;
use splat_volume::grid::{Extent, Grid};
use splat_volume::volume::Volume;

pub static GRID: Topic = Topic::of::<OccupancyGrid>("grid", Delivery::Latched { depth: 1 });
/// Below the name of the grid, as Nav2's static layer looks for it.
pub static UPDATES: Topic =
    Topic::of::<OccupancyGridUpdate>("grid_updates", Delivery::Reliable { depth: 10 });
pub static DISTANCES: Topic =
    Topic::of::<DistanceMapSlice>("distance_slice", Delivery::Latched { depth: 1 });
pub static TF_STATIC: Topic = Topic::of::<TfMessage>("/tf_static", Delivery::Latched { depth: 1 });
pub static TOPICS: [&Topic; 4] = [&GRID, &UPDATES, &DISTANCES, &TF_STATIC];

/// Distances are exact up to it, metres; planners look no farther.
const MAX_DISTANCE: f64 = 2.0;
/// A change of more cells goes out as a whole grid.
const MAX_UPDATE_SHARE: f64 = 0.25;
/// Late joiners get a grid that is at most so old, seconds, and the updates since.
const WHOLE_SECS: f64 = 5.0;

/// A grid, and where it lies.
#[derive(Debug, Clone)]
pub struct LevelGrid {
    pub grid: Grid,
    pub stamp: Stamp,
    /// Of the ground's normal; identity: the map frame is level.
    pub level_from_map: DQuat,
    /// Of the ground, and of the slice of distances above it, metres.
    pub ground: f64,
    pub height: f64,
}

/// Owned by the thread that makes grids.
#[derive(Debug)]
pub struct GridStream {
    params: PublishParams,
    frames: Arc<FrameCells>,
    reports: Arc<Reports>,
    /// As readers have it.
    published: Option<LevelGrid>,
    since_whole: Stopwatch,
    /// Updates went out since the last whole one.
    is_ahead: bool,
}

impl GridStream {
    pub(crate) fn new(
        params: &PublishParams,
        reports: Arc<Reports>,
        frames: Arc<FrameCells>,
    ) -> Self {
        Self {
            params: params.clone(),
            frames,
            reports,
            published: None,
            since_whole: Stopwatch::start(),
            is_ahead: false,
        }
    }

    /// Takes the splat frame to the map frame, in metres where they are known.
    pub fn map_from_world(&self, metres_per_unit: Option<f64>) -> Similarity {
        let mut tree = self.frames.tree();
        tree.metres_per_unit = metres_per_unit;
        tree.map_from_world()
    }

    /// Of the last grid: the next one is no smaller.
    pub fn extent(&self) -> Option<Extent> {
        self.published
            .as_ref()
            .map(|level_grid| level_grid.grid.extent)
    }

    /// Why there is no grid; empty while there is one, or none is wanted.
    pub fn report(&self, refused: &str) {
        self.reports
            .grid
            .update(|status| refused.clone_into(&mut status.refused));
    }

    /// Services answer from it until the next one.
    pub fn keep_volume(&self, publisher: &Publisher, volume: &Volume, snapshot: &Snapshot) {
        let level_from_map = volume.level_from_map();
        publisher.latched().keep_volume(SharedVolume {
            voxels: volume.voxels().clone(),
            keyframes: volume.fused(),
            max_range: volume.params().max_range,
            level_from_map,
            level_from_world: volume.in_level(&self.map_from_world(snapshot.scale.metres_per_unit)),
            frames: VolumeFrames {
                map: self.params.map_frame.clone(),
                level: self.frame_of(level_from_map),
            },
            map_id: snapshot.map_id,
            epoch: snapshot.epoch,
            revision: snapshot.revision,
        });
    }

    /// Sends what lies within `reach` metres of a place of the level frame, as the volume that was kept last has it.
    pub fn publish_obstacles(
        &self,
        publisher: &Publisher,
        snapshot: &Snapshot,
        (place, reach): (DVec3, f64),
        max_ellipsoids: usize,
    ) -> Result<(), PublishError> {
        let Some(volume) = publisher.latched().volume() else {
            return Ok(());
        };
        let region = Region::around(place, reach);
        let header = Header::new(snapshot.stamp, &volume.frames.level);
        let cloud = voxel_cloud(&volume, &region, header);
        publisher.send(&Sample::of(&VOXELS, snapshot.stamp, &cloud)?)?;
        let array = ellipsoid_array(&volume, snapshot, &region, max_ellipsoids);
        publisher.send(&Sample::of(&ELLIPSOIDS, snapshot.stamp, &array)?)
    }

    /// Sends what has changed; nothing where nothing has.
    pub fn publish(
        &mut self,
        publisher: &Publisher,
        level_grid: LevelGrid,
    ) -> Result<(), PublishError> {
        let frame = self.frame_of(level_grid.level_from_map);
        let header = || Header::new(level_grid.stamp, &frame);
        let before = self.published.take();
        let before = before.filter(|before| {
            before.grid.extent == level_grid.grid.extent
                && before.level_from_map == level_grid.level_from_map
        });
        let part = before
            .as_ref()
            .map(|before| level_grid.grid.changed_since(&before.grid));
        let is_whole = match part {
            None => true,
            Some(None) => self.is_ahead && self.since_whole.secs() >= WHOLE_SECS,
            Some(Some([_, _, width, height])) => {
                let share = (width * height) as f64 / level_grid.grid.cells.len() as f64;
                share > MAX_UPDATE_SHARE || self.since_whole.secs() >= WHOLE_SECS
            }
        };
        let is_turned = before.is_none() && level_grid.level_from_map != DQuat::IDENTITY;
        if is_turned {
            publisher.send(&self.level_transform(&level_grid, &frame)?)?;
        }
        if is_whole {
            publisher.send(&Sample::of(
                &GRID,
                level_grid.stamp,
                &whole(&level_grid, header()),
            )?)?;
            (self.since_whole, self.is_ahead) = (Stopwatch::start(), false);
        } else if let Some(Some(part)) = part {
            let update = update(&level_grid.grid, part, header());
            publisher.send(&Sample::of(&UPDATES, level_grid.stamp, &update)?)?;
            self.is_ahead = true;
        }
        if is_whole || part.flatten().is_some() {
            publisher.observe(&Event::Grid {
                grid: &level_grid.grid,
                map_from_grid: level_grid.level_from_map.inverse(),
                ground: level_grid.ground,
                frame: &frame,
            });
            let slice = distances(&level_grid, header());
            publisher.send(&Sample::of(&DISTANCES, level_grid.stamp, &slice)?)?;
        }
        self.published = Some(level_grid);
        Ok(())
    }

    /// The map frame, or one that is level above the same origin.
    fn frame_of(&self, level_from_map: DQuat) -> String {
        if level_from_map == DQuat::IDENTITY {
            self.params.map_frame.clone()
        } else {
            format!("{}_level", self.params.map_frame)
        }
    }

    fn level_transform(&self, level_grid: &LevelGrid, frame: &str) -> Result<Sample, PublishError> {
        let pose = Rigid::new(level_grid.level_from_map.inverse(), DVec3::ZERO);
        let transform = TransformStamped {
            header: Header::new(level_grid.stamp, &self.params.map_frame),
            child_frame_id: frame.to_owned(),
            transform: pose.into(),
        };
        let transforms = vec![transform];
        Sample::of(&TF_STATIC, level_grid.stamp, &TfMessage { transforms })
    }
}

/// As Nav2's static layer takes it: the origin on a multiple of the resolution, without a rotation.
fn whole(level_grid: &LevelGrid, header: Header) -> OccupancyGrid {
    let grid = &level_grid.grid;
    // Costmaps do not look at z; RViz draws the grid there.
    let origin = grid.origin().extend(level_grid.ground);
    let origin = Rigid::new(DQuat::IDENTITY, origin);
    OccupancyGrid {
        info: MapMetaData {
            map_load_time: header.stamp,
            resolution: grid.resolution as f32,
            width: grid.extent.width as u32,
            height: grid.extent.height as u32,
            origin: Pose::from(origin),
        },
        header,
        data: grid.cells.clone(),
    }
}

fn update(grid: &Grid, part: [usize; 4], header: Header) -> OccupancyGridUpdate {
    let [x, y, width, height] = part;
    OccupancyGridUpdate {
        header,
        x: x as i32,
        y: y as i32,
        width: width as u32,
        height: height as u32,
        data: grid.part(part),
    }
}

fn distances(level_grid: &LevelGrid, header: Header) -> DistanceMapSlice {
    let grid = &level_grid.grid;
    let origin = grid.origin();
    DistanceMapSlice {
        header,
        resolution: grid.resolution as f32,
        width: grid.extent.width as u32,
        height: grid.extent.height as u32,
        origin: Vector3 {
            x: origin.x,
            y: origin.y,
            z: level_grid.height,
        },
        unknown_value: UNKNOWN_DISTANCE,
        data: signed_distances(grid, MAX_DISTANCE),
    }
}
