//! Signed distances to surfaces in blocks of voxels, as sums that a keyframe can be taken out of again.
//!
//! Truncated signed distance fields as in Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996; blocks found by
//! their index as in Niessner et al., "Real-time 3D Reconstruction at Scale using Voxel Hashing", 2013. Sums are whole numbers: what is put in and
//! taken out again leaves nothing behind, and the order does not matter.

use std::sync::Arc;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use crate::blocks::{Block, Blocks, N_VOXELS, SIDE, Voxel};
use crate::view::DepthView;
use splat_types::transform::Similarity;

/// Steps of a distance within the truncation.
const STEPS: f32 = 256.0;
/// Where depth counts in full, metres; it counts less in proportion to its distance beyond.
const FULL_WEIGHT_RANGE: f32 = 1.0;
/// Behind a surface that is seen at a flat angle, at most so many truncations along the axis.
const MAX_BEHIND: f32 = 3.0;
/// A pixel whose neighbour has less of its depth lies at an edge.
const MAX_STEP: f32 = 0.92;
/// Free space counts so much less than a surface.
const FREE_SHARE: u32 = 2;
/// Nothing that weighs less is a surface, or free: one look at 2.5 m with full trust, two at 5 m.
const MIN_SURFACE_WEIGHT: u32 = 24;
const MIN_FREE_WEIGHT: u32 = 8;
/// Blocks near one keyframe; 32 MiB of indices.
pub const MAX_CANDIDATES: u64 = 2_000_000;

/// What is known of a voxel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    Unknown,
    /// Its middle is at most `SURFACE_SHARE` of a voxel from a surface.
    Surface,
    /// Before a surface.
    Free,
    /// Behind a surface.
    Inside,
}

/// Voxels: a plane across an axis always has a middle within half a voxel; more closes the gaps of slanted ones.
const SURFACE_SHARE: f32 = 0.6;

/// Block by block; voxel (x, y, z) of the whole has its middle at (x + 0.5, y + 0.5, z + 0.5) times `size`.
#[derive(Debug, Clone)]
pub struct Voxels {
    /// Metres.
    pub size: f64,
    /// Metres.
    pub truncation: f64,
    blocks: Blocks,
}

/// The voxels of one block.
#[derive(Debug, Clone)]
pub struct BlockView<'a> {
    voxels: &'a Voxels,
    block: Arc<Block>,
}

impl BlockView<'_> {
    /// Eight voxels above each other, from below; `x`, `y` within the block.
    pub fn states(&self, x: i32, y: i32) -> [State; SIDE as usize] {
        std::array::from_fn(|z| {
            let at = offset(IVec3::new(x, y, z as i32));
            self.voxels.state(self.block[at])
        })
    }
}

/// Whether a keyframe is put in or taken out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    Add,
    Remove,
}

impl Voxel {
    /// Metres to the nearest surface, positive before it; `None` where too little was seen.
    #[inline]
    pub fn distance(self, truncation: f64) -> Option<f64> {
        (self.weight >= MIN_FREE_WEIGHT)
            .then(|| f64::from(self.sum) / (f64::from(self.weight) * f64::from(STEPS)) * truncation)
    }
}

impl Voxels {
    pub fn new(size: f64, truncation: f64) -> Self {
        Self {
            size,
            truncation,
            blocks: Blocks::default(),
        }
    }

    pub fn n_blocks(&self) -> usize {
        self.blocks.len()
    }

    pub fn bytes(&self) -> usize {
        self.blocks.bytes()
    }

    /// All blocks, in the order of their indices.
    pub fn indices(&self) -> Vec<IVec3> {
        let mut all: Vec<IVec3> = self.blocks.indices().collect();
        all.sort_unstable_by_key(|b| [b.x, b.y, b.z]);
        all
    }

    /// Those that a box touches, in the same order; so many blocks more on its lower sides.
    pub fn indices_in(&self, low: DVec3, high: DVec3, more_below: i32) -> Vec<IVec3> {
        let edge = self.size * f64::from(SIDE);
        let first = (low / edge).floor() - f64::from(more_below);
        let last = (high / edge).floor();
        let mut all = self.indices();
        all.retain(|block| {
            let block = block.as_dvec3();
            block.cmpge(first).all() && block.cmple(last).all()
        });
        all
    }

    pub fn voxel(&self, at: IVec3) -> Voxel {
        let index = at.div_euclid(IVec3::splat(SIDE));
        let block = self.blocks.get(index);
        block.map_or(Voxel::default(), |block| block[offset(at - index * SIDE)])
    }

    pub fn block(&self, index: IVec3) -> Option<BlockView<'_>> {
        let block = self.blocks.get(index)?;
        Some(BlockView {
            voxels: self,
            block,
        })
    }

    /// Some blocks, all of them in memory.
    pub(crate) fn part(&self, indices: impl Iterator<Item = IVec3>) -> Self {
        let mut part = Self::new(self.size, self.truncation);
        for index in indices {
            if let Some(block) = self.blocks.get(index) {
                part.blocks.insert(index, block);
            }
        }
        part
    }

    pub(crate) fn blocks_mut(&mut self) -> &mut Blocks {
        &mut self.blocks
    }

    pub(crate) fn blocks(&self) -> &Blocks {
        &self.blocks
    }

    pub fn state(&self, voxel: Voxel) -> State {
        let share = SURFACE_SHARE * self.size as f32 / self.truncation as f32;
        let bound = share * STEPS * voxel.weight as f32;
        let sum = voxel.sum as f32;
        if sum.abs() <= bound && voxel.weight >= MIN_SURFACE_WEIGHT {
            State::Surface
        } else if sum > bound && voxel.weight >= MIN_FREE_WEIGHT {
            State::Free
        } else if sum < -bound {
            State::Inside
        } else {
            State::Unknown
        }
    }

    /// Blocks that the view may see within `range` metres; `Err`: how many, where those are too many.
    pub fn candidates(
        &self,
        view: &DepthView,
        level_from_cam: &Similarity,
        range: f64,
    ) -> Result<Vec<IVec3>, u64> {
        let metres = level_from_cam.scale;
        let far = (view.farthest() * metres + self.truncation).min(range + self.truncation);
        let k = &view.intrinsics;
        let corner = |u: u32, v: u32| {
            let ray = k.ray_in_cam(glam::DVec2::new(f64::from(u), f64::from(v)));
            level_from_cam.transform_point(ray * (far / metres))
        };
        let eye = level_from_cam.translation;
        let corners = [
            eye,
            corner(0, 0),
            corner(k.width_px, 0),
            corner(0, k.height_px),
            corner(k.width_px, k.height_px),
        ];
        let edge = self.size * f64::from(SIDE);
        let low = corners.iter().fold(eye, |a, b| a.min(*b)) - DVec3::splat(edge / 2.0);
        let high = corners.iter().fold(eye, |a, b| a.max(*b)) + DVec3::splat(edge / 2.0);
        let (low, high) = ((low / edge).floor(), (high / edge).floor());
        let sides = high - low + 1.0;
        let n = sides.x * sides.y * sides.z;
        let reach = low.abs().max(high.abs()).max_element();
        if !(n <= MAX_CANDIDATES as f64 && reach < f64::from(i32::MAX / 64)) {
            return Err(if n.is_finite() { n as u64 } else { u64::MAX });
        }
        let (low, high) = (low.as_ivec3(), high.as_ivec3());
        let frustum = Frustum::new(view, level_from_cam, edge * 0.87, far);
        let mut found = Vec::new();
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                for x in low.x..=high.x {
                    let index = IVec3::new(x, y, z);
                    let middle = (index.as_dvec3() + 0.5) * edge;
                    if frustum.reaches(middle) {
                        found.push(index);
                    }
                }
            }
        }
        Ok(found)
    }

    /// Puts a view in, or takes it out as it was put in -> blocks that have changed.
    pub fn change(
        &mut self,
        view: &DepthView,
        level_from_cam: &Similarity,
        range: f64,
        change: Change,
    ) -> Result<Vec<IVec3>, u64> {
        let candidates = self.candidates(view, level_from_cam, range)?;
        let caster = Caster::new(self, view, level_from_cam, range);
        let found: Vec<(IVec3, Box<Block>)> = candidates
            .par_iter()
            .with_min_len(64)
            .filter_map(|index| Some((*index, caster.contribution(*index)?)))
            .collect();
        let mut changed = Vec::with_capacity(found.len());
        for (index, contribution) in found {
            self.merge(index, &contribution, change);
            changed.push(index);
        }
        Ok(changed)
    }

    fn merge(&mut self, index: IVec3, own: &Block, change: Change) {
        let block = self.blocks.get_mut(index);
        match change {
            Change::Add => {
                for (voxel, own) in block.iter_mut().zip(own) {
                    voxel.sum = voxel.sum.saturating_add(own.sum);
                    voxel.weight = voxel.weight.saturating_add(own.weight);
                }
            }
            Change::Remove => {
                for (voxel, own) in block.iter_mut().zip(own) {
                    voxel.sum = voxel.sum.saturating_sub(own.sum);
                    voxel.weight = voxel.weight.saturating_sub(own.weight);
                    if voxel.weight == 0 {
                        // Of a block that was lost, what is left of the sum would say something.
                        voxel.sum = 0;
                    }
                }
                if block.iter().all(|voxel| voxel.weight == 0) {
                    self.blocks.remove(index);
                }
            }
        }
    }
}

fn offset(within: IVec3) -> usize {
    ((within.z * SIDE + within.y) * SIDE + within.x) as usize
}

/// The view's pyramid, widened by the radius of a block.
struct Frustum {
    cam_from_level: glam::DMat3,
    eye: DVec3,
    /// Inward normals of the four sides, in the camera's frame.
    sides: [DVec3; 4],
    radius: f64,
    far: f64,
}

impl Frustum {
    fn new(view: &DepthView, level_from_cam: &Similarity, radius: f64, far: f64) -> Self {
        let k = &view.intrinsics;
        let ray = |u: u32, v: u32| k.ray_in_cam(glam::DVec2::new(f64::from(u), f64::from(v)));
        let (w, h) = (k.width_px, k.height_px);
        let corners = [ray(0, 0), ray(w, 0), ray(w, h), ray(0, h)];
        Self {
            cam_from_level: glam::DMat3::from_quat(level_from_cam.rotation.inverse()),
            eye: level_from_cam.translation,
            sides: std::array::from_fn(|i| corners[i].cross(corners[(i + 1) % 4]).normalize()),
            radius,
            far,
        }
    }

    fn reaches(&self, middle: DVec3) -> bool {
        let p = self.cam_from_level * (middle - self.eye);
        p.z > -self.radius
            && p.z < self.far + self.radius
            && self.sides.iter().all(|side| side.dot(p) > -self.radius)
    }
}

/// One view's share of the sums.
struct Caster<'a> {
    view: &'a DepthView,
    /// Metres.
    eye: DVec3,
    cam_from_level: glam::Mat3,
    /// Metres a unit of the map.
    metres: f32,
    size: f64,
    truncation: f32,
    range: f32,
    focal: [f32; 2],
    middle: [f32; 2],
}

impl<'a> Caster<'a> {
    fn new(voxels: &Voxels, view: &'a DepthView, level_from_cam: &Similarity, range: f64) -> Self {
        let k = &view.intrinsics;
        Self {
            view,
            eye: level_from_cam.translation,
            cam_from_level: glam::DMat3::from_quat(level_from_cam.rotation.inverse()).as_mat3(),
            metres: level_from_cam.scale as f32,
            size: voxels.size,
            truncation: voxels.truncation as f32,
            range: range as f32,
            focal: [k.fx as f32, k.fy as f32],
            middle: [k.cx as f32, k.cy as f32],
        }
    }

    /// `None`: nothing of this block was seen.
    fn contribution(&self, index: IVec3) -> Option<Box<Block>> {
        // Relative to the eye, so that single precision is enough a kilometre away.
        let corner = (index * SIDE).as_dvec3() + 0.5;
        let corner = self.cam_from_level * (corner * self.size - self.eye).as_vec3();
        let step = self.size as f32;
        let axes = [0, 1, 2].map(|axis| self.cam_from_level.col(axis) * step);
        let mut own: Option<Box<Block>> = None;
        for z in 0..SIDE {
            for y in 0..SIDE {
                let row = corner + axes[1] * y as f32 + axes[2] * z as f32;
                for x in 0..SIDE {
                    if let Some(voxel) = self.voxel(row + axes[0] * x as f32) {
                        let block =
                            own.get_or_insert_with(|| Box::new([Voxel::default(); N_VOXELS]));
                        block[offset(IVec3::new(x, y, z))] = voxel;
                    }
                }
            }
        }
        own
    }

    /// Of a voxel whose middle lies at `p` in the camera's frame, metres.
    #[inline]
    fn voxel(&self, p: Vec3) -> Option<Voxel> {
        if p.z <= self.truncation.min(0.05) || p.z > self.range {
            return None;
        }
        let u = self.focal[0] * p.x / p.z + self.middle[0];
        let v = self.focal[1] * p.y / p.z + self.middle[1];
        let k = &self.view.intrinsics;
        if !(u >= 0.0 && v >= 0.0 && u < k.width_px as f32 && v < k.height_px as f32) {
            return None;
        }
        let seen = self.view.seen(u as usize, v as usize)?;
        let behind = p.z - seen.z * self.metres;
        let distance = -behind * seen.slant;
        if distance < -self.truncation || behind > MAX_BEHIND * self.truncation {
            return None;
        }
        // Something thin may stand between this pixel's ray and the voxel.
        let nearest = seen.nearest * self.metres;
        let is_edge = nearest < MAX_STEP * seen.z * self.metres;
        if (distance >= self.truncation || is_edge) && p.z > nearest {
            return None;
        }
        let weight = seen.trust as f32 * (FULL_WEIGHT_RANGE / p.z).min(1.0);
        // Farther behind the surface it is less and less known, down to nothing at the truncation (voxblox).
        let voxel = self.size as f32;
        let fading = (self.truncation + distance) / (self.truncation - voxel);
        let weight = (weight * fading.min(1.0)) as u32;
        if weight == 0 && distance < -voxel {
            return None;
        }
        let weight = weight.max(1);
        let (steps, weight) = if distance >= self.truncation {
            (STEPS, (weight / FREE_SHARE).max(1))
        } else {
            ((distance / self.truncation * STEPS).round(), weight)
        };
        Some(Voxel {
            sum: steps as i32 * weight as i32,
            weight,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec2};
    use splat_types::camera::Intrinsics;
    use splat_types::depth::DepthMap;

    const CAMERA: Intrinsics = Intrinsics {
        width_px: 96,
        height_px: 72,
        fx: 80.0,
        fy: 80.0,
        cx: 48.0,
        cy: 36.0,
    };

    /// A wall across the axis.
    fn wall(z: f32) -> DepthView {
        let n = 96 * 72;
        let depth = DepthMap {
            width_px: 96,
            height_px: 72,
            depth: vec![z; n],
            confidence: vec![1.0; n],
        };
        DepthView::new(&depth, &CAMERA)
    }

    fn at(translation: DVec3, angle: f64) -> Similarity {
        Similarity {
            scale: 1.0,
            rotation: DQuat::from_rotation_y(angle),
            translation,
        }
    }

    #[test]
    fn distances_are_those_to_a_wall() {
        let mut voxels = Voxels::new(0.05, 0.2);
        let pose = at(DVec3::ZERO, 0.0);
        voxels.change(&wall(2.0), &pose, 5.0, Change::Add).unwrap();
        for (z, wanted) in [(38, 0.075), (40, -0.025), (41, -0.075), (20, 0.2)] {
            let found = voxels.voxel(IVec3::new(1, -2, z)).distance(0.2).unwrap();
            assert!((found - wanted).abs() < 0.002, "{z}: {found}");
        }
        assert_eq!(
            voxels.voxel(IVec3::new(0, 0, 50)).distance(0.2),
            None,
            "unknown behind it"
        );
    }

    #[test]
    fn a_view_that_is_taken_out_leaves_nothing() {
        let mut voxels = Voxels::new(0.05, 0.2);
        let kept = at(DVec3::new(0.1, 0.0, 0.0), 0.2);
        voxels.change(&wall(1.7), &kept, 5.0, Change::Add).unwrap();
        let before: Vec<_> = voxels
            .indices()
            .into_iter()
            .map(|i| voxels.blocks.get(i))
            .collect();
        let other = at(DVec3::new(-0.3, 0.2, 0.4), -0.4);
        for change in [Change::Add, Change::Remove] {
            voxels.change(&wall(2.2), &other, 5.0, change).unwrap();
        }
        let after: Vec<_> = voxels
            .indices()
            .into_iter()
            .map(|i| voxels.blocks.get(i))
            .collect();
        assert_eq!(before, after);
        voxels
            .change(&wall(1.7), &kept, 5.0, Change::Remove)
            .unwrap();
        assert_eq!(voxels.n_blocks(), 0);
    }

    #[test]
    fn candidates_hold_all_that_changes() {
        let mut voxels = Voxels::new(0.1, 0.4);
        let pose = at(DVec3::new(0.3, -0.2, 0.1), 0.7);
        let changed = voxels.change(&wall(3.0), &pose, 5.0, Change::Add).unwrap();
        // By brute force, pixel by pixel: the block of each point of the wall.
        for row in 0..72 {
            for column in 0..96 {
                let pixel = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
                let point = pose.transform_point(CAMERA.ray_in_cam(pixel) * 3.0);
                let block = (point / 0.8).floor().as_ivec3();
                assert!(changed.contains(&block), "{point}");
            }
        }
    }

    #[test]
    fn far_away_and_fine_grained_is_bounded() {
        let voxels = Voxels::new(1e-6, 4e-6);
        let pose = at(DVec3::ZERO, 0.0);
        assert!(voxels.candidates(&wall(2.0), &pose, 5.0).is_err());
        let voxels = Voxels::new(0.05, 0.2);
        let far = at(DVec3::splat(1e12), 0.0);
        assert!(voxels.candidates(&wall(2.0), &far, 5.0).is_err());
        let away = at(DVec3::new(1000.0, 0.0, 0.0), 0.0);
        let found = voxels.candidates(&wall(2.0), &away, 5.0).unwrap();
        assert!(!found.is_empty() && found.len() < 2000);
    }
}
