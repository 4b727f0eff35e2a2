//! Keyframes that come, move and go -> a volume that holds each where it is now.

use std::collections::{BTreeMap, HashSet};
use std::sync::{Arc, Weak};

use glam::{DQuat, DVec3, IVec2, IVec3};

use crate::blocks::{BLOCK_BYTES, SIDE};
use crate::columns::Columns;
use crate::ellipsoids::FusedKeyframe;
use crate::error::VolumeError;
use crate::ground::GroundPlane;
use crate::params::GridParams;
use crate::view::DepthView;
use crate::voxels::{Change, MAX_CANDIDATES, Voxels};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::pages::PageStore;
use splat_types::transform::Similarity;

/// A keyframe is fused anew where a point of it has moved by a larger share of a voxel.
const MAX_MOVE: f64 = 0.5;
/// Keyframes that the ground is looked for in, and points of each.
const GROUND_VIEWS: usize = 40;
const GROUND_POINTS: usize = 1500;
/// Of points so near each other, metres, one counts: a wall beside the camera fills images, and the floor is seen at a flat angle.
const GROUND_CELL: f64 = 0.1;
/// Of more points every n-th.
const MAX_GROUND_POINTS: usize = 15_000;
/// Where the ground leans by less in the map frame, degrees, that frame is level enough.
const MAX_TILT_DEG: f64 = 2.0;
/// Blocks around the newest keyframe whose columns are read anew.
const REMEMBERED: i32 = 64;
/// The level frame is another one where the ground turns out to lean by more, degrees.
const MAX_LEVEL_ERROR_DEG: f64 = 1.0;
/// So many more keyframes than at the last look for the ground, and it is looked for again.
const MORE_VIEWS: f64 = 1.5;

/// A keyframe as the map has it now.
#[derive(Debug, Clone)]
pub struct KeyframeDepth {
    pub id: u32,
    /// Metres; the scale is metres per unit of the depth.
    pub map_from_camera: Similarity,
    /// Of the image, at any size.
    pub intrinsics: Intrinsics,
    /// Units of the map.
    pub depth: Arc<DepthMap>,
}

/// A keyframe in the volume.
#[derive(Debug)]
struct Fused {
    /// What it was made of; another one is fused anew. It does not keep the pixels.
    source: Weak<DepthMap>,
    width_px: u32,
    view: Arc<DepthView>,
    /// As it was put in; `None`: not yet.
    level_from_cam: Option<Similarity>,
    /// Where it belongs.
    target: Similarity,
}

/// Voxels, the keyframes in them, and the level frame they lie in: the map's, turned so that the ground is level.
#[derive(Debug)]
pub struct Volume {
    params: GridParams,
    voxels: Voxels,
    columns: Columns,
    keyframes: BTreeMap<u32, Fused>,
    /// Keyframes up to this one can no longer move: their depth has made room.
    settled: Option<u32>,
    level_from_map: DQuat,
    ground: Option<GroundPlane>,
    n_views_at_level: usize,
    dirty: HashSet<IVec2>,
    room: Room,
}

/// What the volume has beside its memory.
#[derive(Debug, Default)]
struct Room {
    /// Of blocks far from the newest keyframe.
    pages: Option<Box<dyn PageStore>>,
    /// Tiles whose columns were forgotten; their blocks are still there.
    tiles: HashSet<IVec2>,
    /// Where the newest keyframe was when those were looked at last.
    looked_at: IVec2,
}

impl Volume {
    pub fn new(params: &GridParams) -> Self {
        let truncation = params.resolution * f64::from(params.truncation_voxels);
        Self {
            params: params.clone(),
            voxels: Voxels::new(params.resolution, truncation),
            columns: Columns::default(),
            keyframes: BTreeMap::new(),
            settled: None,
            level_from_map: DQuat::IDENTITY,
            ground: None,
            n_views_at_level: 0,
            dirty: HashSet::new(),
            room: Room::default(),
        }
    }

    /// Blocks far from the newest keyframe go there when memory is short.
    #[must_use]
    pub fn paging_to(mut self, pages: Box<dyn PageStore>) -> Self {
        self.room.pages = Some(pages);
        self
    }

    pub fn voxels(&self) -> &Voxels {
        &self.voxels
    }

    /// Up to date with the voxels.
    pub fn columns(&mut self) -> &Columns {
        let dirty = std::mem::take(&mut self.dirty);
        self.columns.update(&self.voxels, dirty);
        let focus = self.focus().truncate();
        let max_bytes = self.budget() / 2;
        self.room
            .tiles
            .extend(self.columns.forget(focus, max_bytes));
        &self.columns
    }

    pub fn params(&self) -> &GridParams {
        &self.params
    }

    /// In the level frame, where its normal is z; `None` while no ground was found.
    pub fn ground(&self) -> Option<GroundPlane> {
        self.ground.map(|ground| GroundPlane {
            normal: DVec3::Z,
            ..ground
        })
    }

    pub fn level_from_map(&self) -> DQuat {
        self.level_from_map
    }

    pub fn bytes(&self) -> usize {
        let views: usize = self.keyframes.values().map(|k| k.view.bytes()).sum();
        self.voxels.bytes() + self.columns.bytes() + views
    }

    pub fn n_keyframes(&self) -> usize {
        self.keyframes.len()
    }

    /// Those that are in the volume and still have their depth, as they were put in.
    pub fn fused(&self) -> Vec<FusedKeyframe> {
        let keyframes = self.keyframes.iter();
        keyframes
            .filter_map(|(id, fused)| {
                Some(FusedKeyframe {
                    id: *id,
                    level_from_cam: fused.level_from_cam?,
                    view: Arc::clone(&fused.view),
                })
            })
            .collect()
    }

    /// Where keyframes belong from now on; those that are not among them go. Faulty ones stay out and are returned.
    pub fn set_keyframes(&mut self, keyframes: &[KeyframeDepth]) -> Vec<VolumeError> {
        let mut faults = Vec::new();
        let ids: HashSet<u32> = keyframes.iter().map(|keyframe| keyframe.id).collect();
        let gone: Vec<u32> = self
            .keyframes
            .keys()
            .filter(|id| !ids.contains(id))
            .copied()
            .collect();
        for id in gone {
            self.take_out(id);
            self.keyframes.remove(&id);
        }
        for keyframe in keyframes {
            if self.settled.is_some_and(|settled| keyframe.id <= settled) {
                continue;
            }
            if let Err(fault) = self.set_keyframe(keyframe) {
                faults.push(fault);
            }
        }
        self.find_level();
        faults
    }

    fn set_keyframe(&mut self, keyframe: &KeyframeDepth) -> Result<(), VolumeError> {
        let (pose, k) = (keyframe.map_from_camera, &keyframe.intrinsics);
        let is_sound = pose.is_finite()
            && pose.scale > 0.0
            && (pose.rotation.length() - 1.0).abs() < 1e-3
            && k.is_plausible();
        if !is_sound {
            return Err(VolumeError::Pose {
                keyframe: keyframe.id,
                scale: pose.scale,
            });
        }
        if keyframe.depth.width_px == 0 || keyframe.depth.height_px == 0 {
            return Ok(());
        }
        let (source, target) = (Arc::downgrade(&keyframe.depth), pose);
        let width_px = keyframe.depth.width_px;
        match self.keyframes.get_mut(&keyframe.id) {
            // Depth that has become smaller has made room, it says nothing new.
            Some(fused) if fused.source.ptr_eq(&source) || width_px < fused.width_px => {
                fused.target = target;
            }
            _ => {
                self.take_out(keyframe.id);
                let view = Arc::new(DepthView::new(&keyframe.depth, k));
                let fused = Fused {
                    source,
                    width_px,
                    view,
                    level_from_cam: None,
                    target,
                };
                self.keyframes.insert(keyframe.id, fused);
            }
        }
        Ok(())
    }

    /// Fuses up to `n` keyframes that are new or have moved, the farthest first -> how many are left. Keyframes that cannot be fused stay out and
    /// are returned.
    pub fn fuse(&mut self, n: usize) -> (usize, Vec<VolumeError>) {
        let mut moved: Vec<(f64, u32)> = self
            .keyframes
            .iter()
            .filter_map(|(id, fused)| {
                let by = self.moved(fused);
                (by > MAX_MOVE * self.params.resolution).then_some((by, *id))
            })
            .collect();
        moved.sort_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)));
        let n_left = moved.len().saturating_sub(n);
        let mut faults = Vec::new();
        for (_, id) in moved.into_iter().take(n) {
            self.take_out(id);
            if let Err(fault) = self.put_in(id) {
                self.keyframes.remove(&id);
                faults.push(fault);
            }
        }
        faults.extend(self.make_room());
        self.remember();
        (n_left, faults)
    }

    /// How far the keyframe's points have moved since it was put in, metres.
    fn moved(&self, fused: &Fused) -> f64 {
        let Some(old) = fused.level_from_cam else {
            return f64::INFINITY;
        };
        let new = self.in_level(&fused.target);
        let depth = fused.view.farthest() * old.scale;
        let depth = depth.min(self.params.max_range);
        (new.translation - old.translation).length()
            + new.rotation.angle_between(old.rotation) * depth
            + (new.scale / old.scale - 1.0).abs() * depth
    }

    /// What leads to the map frame, led on to the level one.
    pub fn in_level(&self, map_from_camera: &Similarity) -> Similarity {
        Similarity {
            scale: map_from_camera.scale,
            rotation: self.level_from_map * map_from_camera.rotation,
            translation: self.level_from_map * map_from_camera.translation,
        }
    }

    fn put_in(&mut self, id: u32) -> Result<(), VolumeError> {
        let Some(fused) = self.keyframes.get(&id) else {
            return Ok(());
        };
        let place = self.in_level(&fused.target);
        let range = self.params.max_range;
        let changed = self.voxels.change(&fused.view, &place, range, Change::Add);
        let changed = changed.map_err(|found| VolumeError::TooManyBlocks {
            keyframe: id,
            found,
            limit: MAX_CANDIDATES,
            range,
        })?;
        self.dirty.extend(changed.iter().map(|b| b.truncate()));
        if let Some(fused) = self.keyframes.get_mut(&id) {
            fused.level_from_cam = Some(place);
        }
        Ok(())
    }

    /// What was put in comes out as it was.
    fn take_out(&mut self, id: u32) {
        let Some(fused) = self.keyframes.get_mut(&id) else {
            return;
        };
        let Some(place) = fused.level_from_cam.take() else {
            return;
        };
        let range = self.params.max_range;
        let changed = self
            .voxels
            .change(&fused.view, &place, range, Change::Remove);
        // It could be put in, so it can be taken out.
        self.dirty
            .extend(changed.into_iter().flatten().map(|b| b.truncate()));
    }

    fn budget(&self) -> usize {
        usize::try_from(self.params.max_mib << 20).unwrap_or(usize::MAX)
    }

    /// The block that the newest keyframe stands in.
    fn focus(&self) -> IVec3 {
        let newest = self.keyframes.last_key_value().map(|(_, fused)| fused);
        let place = newest.map_or(DVec3::ZERO, |fused| {
            self.in_level(&fused.target).translation
        });
        let edge = self.params.resolution * f64::from(SIDE);
        (place / edge).floor().as_ivec3()
    }

    /// Beyond the budget blocks far from the newest keyframe go to disk, then the oldest keyframes lose their depth, so that what they have seen
    /// stays where it is, then far blocks are forgotten, which is returned.
    fn make_room(&mut self) -> Option<VolumeError> {
        let budget = self.budget();
        if self.bytes() <= budget {
            return None;
        }
        let focus = self.focus();
        let distance = |index: IVec3| (index - focus).as_i64vec3().length_squared();
        let mut reason = None;
        if let Some(pages) = &self.room.pages {
            let n = self.n_too_many();
            let done = self.voxels.blocks_mut().page_out(n, &**pages, distance);
            reason = done
                .reason
                .map(|reason| format!("{reason}: {}", pages.describe()));
        }
        let mut bytes = self.bytes();
        while bytes > budget {
            let Some((id, fused)) = self.keyframes.pop_first() else {
                break;
            };
            bytes -= fused.view.bytes();
            self.settled = Some(id);
        }
        if bytes <= budget {
            return None;
        }
        let n = self.n_too_many();
        let gone = self.voxels.blocks_mut().forget(n, distance);
        self.dirty.extend(gone.iter().map(|b| b.truncate()));
        let reason = reason.unwrap_or_else(|| "there is no place for it on disk".to_owned());
        (!gone.is_empty()).then_some(VolumeError::Forgotten {
            n: gone.len(),
            reason,
        })
    }

    /// Blocks that are to leave memory, so that a while passes until the next ones must; near ones stay.
    fn n_too_many(&self) -> usize {
        let budget = self.budget();
        let over = self.bytes().saturating_sub(budget - budget / 8);
        let n_in_memory = self.voxels.blocks().n_in_memory();
        let least = budget / 4 / BLOCK_BYTES;
        over.div_ceil(BLOCK_BYTES)
            .min(n_in_memory.saturating_sub(least))
    }

    /// Columns that were forgotten come back where the camera does.
    fn remember(&mut self) {
        let focus = self.focus().truncate();
        let room = &mut self.room;
        if room.tiles.is_empty() || (focus - room.looked_at).abs().max_element() < REMEMBERED / 4 {
            return;
        }
        room.looked_at = focus;
        let near = |tile: &IVec2| (*tile - focus).abs().max_element() <= REMEMBERED;
        self.dirty.extend(room.tiles.extract_if(near));
    }

    /// Looks for the ground while there is none, and again when many more keyframes have come; where it leans against z, the level frame turns
    /// and all that can move is fused anew.
    fn find_level(&mut self) {
        let n_views = self.keyframes.len();
        let is_due = self.ground.is_none()
            || n_views as f64 >= MORE_VIEWS * self.n_views_at_level as f64
            || n_views < self.n_views_at_level / 2;
        if !is_due || n_views == 0 {
            return;
        }
        let every = n_views.div_ceil(GROUND_VIEWS);
        let mut points = Vec::new();
        for fused in self.keyframes.values().step_by(every) {
            let far = self.params.max_range / fused.target.scale;
            let stride = fused.view.n_pixels().div_ceil(GROUND_POINTS);
            let near = fused.view.points(stride).filter(|p| p.z <= far);
            points.extend(near.map(|p| fused.target.transform_point(p)));
        }
        let points = spread_out(&points);
        // Where the map frame is not level, cameras that are held upright say more.
        let cameras = self.keyframes.values();
        let up: DVec3 = cameras.map(|k| k.target.rotation * DVec3::NEG_Y).sum();
        let seed = n_views as u64;
        let ground = GroundPlane::find(&points, DVec3::Z, seed);
        let ground = ground.or_else(|| GroundPlane::find(&points, up.normalize_or(DVec3::Z), seed));
        let Some(ground) = ground else {
            return;
        };
        self.n_views_at_level = n_views;
        let is_level = ground.tilt_deg(DVec3::Z) <= MAX_TILT_DEG;
        let level = if is_level {
            DQuat::IDENTITY
        } else {
            ground.level_from_map()
        };
        let turned = level * self.level_from_map.inverse() * DVec3::Z;
        let is_turned = turned.angle_between(DVec3::Z).to_degrees() > MAX_LEVEL_ERROR_DEG;
        if is_turned {
            self.level_from_map = level;
        }
        let voxel = (ground.height / self.params.resolution).floor() as i32;
        let columns = Columns::above(voxel);
        if self.ground.is_none() || (columns.foot - self.columns.foot).abs() > 4 {
            self.columns = columns;
            let all = self.voxels.indices().into_iter();
            self.dirty.extend(all.map(|b| b.truncate()));
        }
        self.ground = Some(ground);
    }
}

/// One point of each cell, in their order, and not too many.
fn spread_out(points: &[DVec3]) -> Vec<DVec3> {
    let mut taken = HashSet::new();
    let cell = |p: &DVec3| (*p / GROUND_CELL).floor().as_ivec3();
    let mut kept: Vec<DVec3> = points
        .iter()
        .copied()
        .filter(|p| taken.insert(cell(p)))
        .collect();
    let every = kept.len().div_ceil(MAX_GROUND_POINTS).max(1);
    if every > 1 {
        kept = kept.into_iter().step_by(every).collect();
    }
    kept
}
