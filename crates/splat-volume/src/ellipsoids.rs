//! Splats that depth confirms -> ellipsoids that a planner keeps clear of.
//!
//! Planners on splats (Splat-Nav, Chen et al. 2024; SAFER-Splat, Chen et al. 2024) take each splat for its 1-sigma ellipsoid and do not look at its
//! opacity. A map under training holds splats that float in free space and others that are nearly transparent, so what goes out is chosen first:
//! by opacity, by how many keyframes' depth shows a surface there, and, for long ones, by the voxels that they lie in.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::view::DepthView;
use crate::voxels::Voxels;
use splat_types::splats::splats::Splats;
use splat_types::transform::Similarity;

/// Semi-axes in standard deviations: of a Gaussian in space 90 % lie within 2.5 sigma.
pub const K_SIGMA: f64 = 2.5;
/// What lets more light through is no obstacle.
pub const MIN_OPACITY: f64 = 0.3;
/// Keyframes whose depth shows a surface at the splat.
pub const MIN_OBSERVATIONS: u32 = 3;
/// Longer semi-axes, metres, are believed only along surfaces of the volume.
const MAX_UNVERIFIED: f64 = 1.0;
/// Of a long axis, as a share, along a surface.
const MIN_VERIFIED_SHARE: f64 = 0.8;
/// Depth agrees with a splat within a voxel, or this share of the depth, whichever is more.
const AGREEMENT: f64 = 0.02;
/// Splats that are looked at together, in the order that they were seeded in.
const GROUP: usize = 256;

/// A keyframe as it lies in the volume.
#[derive(Debug, Clone)]
pub struct FusedKeyframe {
    pub id: u32,
    pub level_from_cam: Similarity,
    pub view: Arc<DepthView>,
}

/// Level frame, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct Ellipsoid {
    pub splat_id: u32,
    pub mean: DVec3,
    /// Turns the own axes into the level frame.
    pub rotation: DQuat,
    /// `K_SIGMA` times the root of variance along the axis plus `position_sigma` squared.
    pub semi_axes: DVec3,
    pub opacity: f64,
    /// Keyframes whose depth shows a surface there.
    pub observations: u32,
    /// The newest of them.
    pub last_keyframe: u32,
    /// Root mean square of how far their surfaces lie from the mean, metres.
    pub position_sigma: f64,
}

/// Where ellipsoids are wanted, in the level frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    pub low: DVec3,
    pub high: DVec3,
}

impl Region {
    pub fn around(middle: DVec3, half: f64) -> Self {
        Self {
            low: middle - half,
            high: middle + half,
        }
    }

    pub fn middle(&self) -> DVec3 {
        (self.low + self.high) / 2.0
    }

    fn holds(&self, point: DVec3) -> bool {
        point.cmpge(self.low).all() && point.cmple(self.high).all()
    }
}

/// What splats are compared with.
#[derive(Debug, Clone, Copy)]
pub struct Scene<'a> {
    pub voxels: &'a Voxels,
    pub keyframes: &'a [FusedKeyframe],
    /// Metres; depth beyond it was not fused.
    pub max_range: f64,
}

/// The middle of a splat lies in the region -> its ellipsoid, if depth confirms it; in the order of their ids. `ids`: one per splat.
pub fn ellipsoids(
    scene: &Scene<'_>,
    splats: &Splats,
    ids: &[u32],
    level_from_world: &Similarity,
    region: &Region,
) -> Vec<Ellipsoid> {
    let wanted: Vec<(usize, DVec3)> = (0..splats.len().min(ids.len()))
        .filter(|ix| splats.is_finite(*ix) && opacity(splats, *ix) >= MIN_OPACITY)
        .map(|ix| (ix, level_from_world.transform_point(mean(splats, ix))))
        .filter(|(_, mean)| region.holds(*mean))
        .collect();
    let groups = wanted.par_chunks(GROUP);
    groups
        .flat_map_iter(|group| {
            let near = scene.near(group);
            let of_splat = move |(ix, mean): &(usize, DVec3)| {
                let support = scene.support(&near, *mean)?;
                let ellipsoid = support.ellipsoid(splats, *ix, ids[*ix], level_from_world, *mean);
                scene.is_plausible(&ellipsoid).then_some(ellipsoid)
            };
            group.iter().filter_map(of_splat).collect::<Vec<_>>()
        })
        .collect()
}

/// What `keep_nearest` has left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LeftOut {
    pub n: usize,
    /// Metres from the place to the nearest of them; infinite where there is none.
    pub from: f64,
}

/// Keeps the nearest `n` to a place, in the order of their ids.
pub fn keep_nearest(ellipsoids: &mut Vec<Ellipsoid>, place: DVec3, n: usize) -> LeftOut {
    let left_out = ellipsoids.len().saturating_sub(n);
    let mut from = f64::INFINITY;
    if left_out > 0 {
        let distance = |e: &Ellipsoid| e.mean.distance_squared(place);
        let by = |a: &Ellipsoid, b: &Ellipsoid| distance(a).total_cmp(&distance(b));
        let (_, next, _) = ellipsoids.select_nth_unstable_by(n, by);
        from = distance(next).sqrt();
        ellipsoids.truncate(n);
        ellipsoids.sort_unstable_by_key(|ellipsoid| ellipsoid.splat_id);
    }
    LeftOut { n: left_out, from }
}

pub(crate) fn mean(splats: &Splats, ix: usize) -> DVec3 {
    DVec3::from_array(splats.means[ix].map(f64::from))
}

pub(crate) fn opacity(splats: &Splats, ix: usize) -> f64 {
    1.0 / (1.0 + f64::from(-splats.opacity_logits[ix]).exp())
}

/// (what turns the own axes into the level frame, standard deviations along them in metres)
pub(crate) fn own_axes(
    splats: &Splats,
    ix: usize,
    level_from_world: &Similarity,
) -> (DQuat, DVec3) {
    let [w, x, y, z] = splats.quats[ix].map(f64::from);
    let own = DQuat::from_xyzw(x, y, z, w);
    let is_sound = own.length_squared() > 0.0;
    let own = if is_sound { own } else { DQuat::IDENTITY };
    let sigmas = splats.log_scales[ix].map(|log| f64::from(log).exp() * level_from_world.scale);
    let rotation = level_from_world.rotation * own.normalize();
    (rotation.normalize(), DVec3::from_array(sigmas))
}

/// Depth that agrees with a splat.
#[derive(Debug, Clone, Copy, Default)]
struct Support {
    observations: u32,
    last_keyframe: u32,
    /// Of distances between surface and mean, square metres.
    sum_of_squares: f64,
}

impl Scene<'_> {
    /// Keyframes that may see any of the splats.
    fn near(&self, group: &[(usize, DVec3)]) -> Vec<&FusedKeyframe> {
        let infinite = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let (low, high) = group.iter().fold(infinite, |(low, high), (_, mean)| {
            (low.min(*mean), high.max(*mean))
        });
        let middle = (low + high) / 2.0;
        let radius = high.distance(low) / 2.0;
        let sees = |keyframe: &&FusedKeyframe| {
            let pose = &keyframe.level_from_cam;
            let p = pose.rotation.inverse() * (middle - pose.translation);
            p.z > -radius && p.length() < self.max_range * 2.0 + radius
        };
        self.keyframes.iter().filter(sees).collect()
    }

    /// `None`: too few keyframes show a surface there.
    fn support(&self, keyframes: &[&FusedKeyframe], mean: DVec3) -> Option<Support> {
        let mut support = Support::default();
        for keyframe in keyframes {
            let pose = &keyframe.level_from_cam;
            let p = pose.rotation.inverse() * (mean - pose.translation);
            if p.z <= 0.05 || p.z > self.max_range {
                continue;
            }
            let k = &keyframe.view.intrinsics;
            let (u, v) = (k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
            let is_inside =
                u >= 0.0 && v >= 0.0 && u < f64::from(k.width_px) && v < f64::from(k.height_px);
            if !is_inside {
                continue;
            }
            let Some(seen) = keyframe.view.seen(u as usize, v as usize) else {
                continue;
            };
            let off = (p.z - f64::from(seen.z) * pose.scale) * f64::from(seen.slant);
            if off.abs() <= self.voxels.size.max(AGREEMENT * p.z) {
                support.observations += 1;
                support.last_keyframe = support.last_keyframe.max(keyframe.id);
                support.sum_of_squares += off * off;
            }
        }
        (support.observations >= MIN_OBSERVATIONS).then_some(support)
    }

    /// A splat that is longer than anything that was measured there is a flaw of the map, not an obstacle.
    fn is_plausible(&self, ellipsoid: &Ellipsoid) -> bool {
        let axes = ellipsoid.semi_axes;
        (0..3).filter(|k| axes[*k] > MAX_UNVERIFIED).all(|k| {
            let axis = ellipsoid.rotation * DVec3::AXES[k];
            let reach = axes[k] / K_SIGMA;
            let n = (2.0 * reach / self.voxels.size).ceil().clamp(1.0, 1000.0) as u32;
            let on_surface = (0..=n).filter(|i| {
                let share = 2.0 * f64::from(*i) / f64::from(n) - 1.0;
                let place = ellipsoid.mean + axis * (reach * share);
                let voxel = self
                    .voxels
                    .voxel((place / self.voxels.size).floor().as_ivec3());
                let distance = voxel.distance(self.voxels.truncation);
                distance.is_some_and(|metres| metres.abs() <= 1.5 * self.voxels.size)
            });
            on_surface.count() as f64 >= MIN_VERIFIED_SHARE * f64::from(n + 1)
        })
    }
}

impl Support {
    fn ellipsoid(
        &self,
        splats: &Splats,
        ix: usize,
        splat_id: u32,
        level_from_world: &Similarity,
        mean: DVec3,
    ) -> Ellipsoid {
        let variance = self.sum_of_squares / f64::from(self.observations);
        let (rotation, sigmas) = own_axes(splats, ix, level_from_world);
        Ellipsoid {
            splat_id,
            mean,
            rotation,
            semi_axes: sigmas.map(|s| K_SIGMA * (s * s + variance).sqrt()),
            opacity: opacity(splats, ix),
            observations: self.observations,
            last_keyframe: self.last_keyframe,
            position_sigma: variance.sqrt(),
        }
    }
}

impl Ellipsoid {
    /// From its surface, metres; at most 0 for points within. The nearest point of an ellipsoid solves one equation in one unknown (Eberly, "Distance
    /// from a Point to an Ellipse, an Ellipsoid, or a Hyperellipsoid", 2013), which is bisected here.
    pub fn distance(&self, point: DVec3) -> f64 {
        let y = (self.rotation.inverse() * (point - self.mean)).abs();
        let e = self.semi_axes.max(DVec3::splat(1e-9));
        if (y / e).length_squared() <= 1.0 {
            return 0.0;
        }
        // x_k = e_k^2 y_k / (e_k^2 + t) lies on the surface for one t > 0: sum of (e_k y_k / (e_k^2 + t))^2 = 1.
        let squared = e * e;
        let excess = |t: f64| (e * y / (squared + t)).length_squared() - 1.0;
        let (mut low, mut high) = (0.0, e.max_element() * y.length());
        for _ in 0..60 {
            let middle = f64::midpoint(low, high);
            if excess(middle) > 0.0 {
                low = middle;
            } else {
                high = middle;
            }
        }
        (y - squared * y / (squared + high)).length()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distance_to_an_ellipsoid_is_that_to_its_nearest_point() {
        let ellipsoid = Ellipsoid {
            splat_id: 1,
            mean: DVec3::new(0.3, -0.2, 0.5),
            rotation: DQuat::from_rotation_x(0.6) * DQuat::from_rotation_z(-0.4),
            semi_axes: DVec3::new(0.4, 0.1, 0.02),
            opacity: 0.9,
            observations: 3,
            last_keyframe: 7,
            position_sigma: 0.0,
        };
        // By brute force, over points of the surface.
        let surface: Vec<DVec3> = (0..2000)
            .flat_map(|i| {
                let polar = std::f64::consts::PI * f64::from(i) / 2000.0;
                (0..1000).map(move |j| {
                    let round = std::f64::consts::TAU * f64::from(j) / 1000.0;
                    let (sin, cos) = polar.sin_cos();
                    DVec3::new(sin * round.cos(), sin * round.sin(), cos)
                })
            })
            .map(|unit| ellipsoid.mean + ellipsoid.rotation * (unit * ellipsoid.semi_axes))
            .collect();
        for point in [
            DVec3::new(1.0, 0.4, 0.2),
            DVec3::new(0.3, -0.2, 0.9),
            DVec3::new(-0.4, -0.6, 0.45),
        ] {
            let nearest = surface.iter().map(|s| s.distance(point));
            let nearest = nearest.fold(f64::INFINITY, f64::min);
            let found = ellipsoid.distance(point);
            assert!((found - nearest).abs() < 1e-3, "{point}: {found} {nearest}");
        }
        assert!(ellipsoid.distance(ellipsoid.mean) <= 0.0);
        assert!(ellipsoid.distance(DVec3::splat(1e6)) > 1e6);
    }
}
