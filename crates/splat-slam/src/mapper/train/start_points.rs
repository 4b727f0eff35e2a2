//! Sparse points of a scene -> its first splats, as keyframes come that have them in view.
//!
//! As 3D Gaussian Splatting starts (Kerbl et al. 2023, section 5.1): a round splat at each point, in its colour, as large as
//! the points are apart.

use glam::DVec3;

use crate::mapper::parts::Parts;
use crate::mapper::train::nearest::spacings;
use splat_engine::densify::logit;
use splat_engine::error::EngineError;
use splat_types::camera::Intrinsics;
use splat_types::sparse_point::SparsePoint;
use splat_types::splats::splats::{SH_C0, Splats};
use splat_types::transform::{Rigid, Similarity};

/// Opacity of a splat at the start (3DGS).
const OPACITY: f32 = 0.1;
/// Least spacing as a share of the middle one: points in one place must not become splats without size.
const MIN_SPACING: f64 = 1e-3;
/// Spacing of points that are all in one place, or of one point alone, as a share of the distance to the camera.
const LONELY_SPACING: f64 = 0.01;

#[derive(Debug, Clone, Copy)]
struct StartPoint {
    point: SparsePoint,
    /// In the unit of the scene's poses; 0: unknown.
    spacing: f64,
    /// Keyframe that has brought it into the map; `None`: it waits.
    brought_by: Option<u32>,
}

/// Points of the scene, and which keyframes have brought them into the map.
#[derive(Debug, Default)]
pub(crate) struct StartPoints {
    points: Vec<StartPoint>,
    has_warned: bool,
}

/// A keyframe that brings the points that it has in view.
#[derive(Debug, Clone, Copy)]
struct Bringer<'a> {
    keyframe_id: u32,
    intrinsics: &'a Intrinsics,
    gt_from_cam: &'a Rigid,
    world_from_gt: &'a Similarity,
}

impl StartPoints {
    pub(crate) fn new(points: Vec<SparsePoint>) -> Self {
        let places: Vec<DVec3> = points.iter().map(|point| point.position_in_gt).collect();
        let spacings = spacings(&places);
        let mut sorted = spacings.clone();
        sorted.sort_by(f64::total_cmp);
        let least = MIN_SPACING * sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
        let points = points.into_iter().zip(spacings);
        Self {
            points: points
                .map(|(point, spacing)| StartPoint {
                    point,
                    spacing: spacing.max(least),
                    brought_by: None,
                })
                .collect(),
            has_warned: false,
        }
    }

    /// Points of keyframes that are in the map no longer wait again: after a fault.
    pub(crate) fn release(&mut self, is_registered: impl Fn(u32) -> bool) {
        for point in &mut self.points {
            point.brought_by = point.brought_by.filter(|id| is_registered(*id));
        }
    }

    /// Points that a fresh keyframe has in view become splats that belong to it; of more than there is room for an even part,
    /// and the rest waits for the next one. Keyframes that are held out bring none.
    pub(crate) fn bring(&mut self, map: &mut Parts<'_>, fresh: &[u32]) -> Result<(), EngineError> {
        let world_from_gt = map.keyframes.world_from_submap(&map.engine.poses()?);
        for id in fresh {
            let registered = map.keyframes.registered().get(id);
            let Some(registered) = registered.filter(|registered| !registered.is_held_out) else {
                continue;
            };
            let bringer = Bringer {
                keyframe_id: *id,
                intrinsics: &registered.intrinsics,
                gt_from_cam: &registered.submap_from_cam,
                world_from_gt: &world_from_gt,
            };
            let seen = self.seen_from(&bringer);
            let cap = map.splats.cap(map.params, map.keyframes, map.engine);
            let room = cap.saturating_sub(map.engine.len());
            let chosen = evenly(&seen, room);
            if chosen.len() < seen.len() && !self.has_warned {
                tracing::warn!(
                    "keyframe {id} has {} of the scene's points in view, there is room for {room}: the rest waits; raise map.max_splats for more; said once",
                    seen.len()
                );
                self.has_warned = true;
            }
            let train = &map.params.train;
            let splats = self.splats(&chosen, &bringer, train.start_scale, train.sh_degree);
            map.splats.append(&splats, map.engine)?;
            for ix in &chosen {
                self.points[*ix].brought_by = Some(*id);
            }
            tracing::debug!(keyframe_id = id, n = chosen.len(), "splats from points");
        }
        Ok(())
    }

    /// Indices of the points that wait and are in the image, ascending.
    fn seen_from(&self, bringer: &Bringer<'_>) -> Vec<usize> {
        let cam_from_gt = bringer.gt_from_cam.inverse();
        let (width, height) = (
            f64::from(bringer.intrinsics.width_px),
            f64::from(bringer.intrinsics.height_px),
        );
        let is_seen = |point: &StartPoint| {
            let in_cam = cam_from_gt.transform_point(point.point.position_in_gt);
            let pixel = bringer.intrinsics.project(in_cam);
            pixel.is_some_and(|p| p.x >= 0.0 && p.y >= 0.0 && p.x < width && p.y < height)
        };
        let waiting = (0..self.points.len()).filter(|ix| self.points[*ix].brought_by.is_none());
        waiting.filter(|ix| is_seen(&self.points[*ix])).collect()
    }

    fn splats(&self, chosen: &[usize], bringer: &Bringer<'_>, scale: f32, sh_degree: u8) -> Splats {
        let mut splats = Splats {
            sh_degree,
            ..Splats::default()
        };
        let stride = splats.sh_stride();
        for ix in chosen {
            let StartPoint { point, spacing, .. } = self.points[*ix];
            let spacing = if spacing > 0.0 {
                spacing
            } else {
                LONELY_SPACING
                    * point
                        .position_in_gt
                        .distance(bringer.gt_from_cam.translation)
            };
            let mean = bringer.world_from_gt.transform_point(point.position_in_gt);
            let scale = spacing * bringer.world_from_gt.scale * f64::from(scale);
            splats.means.push(mean.as_vec3().to_array());
            splats
                .log_scales
                .push([scale.max(f64::MIN_POSITIVE).ln() as f32; 3]);
            splats.quats.push([1.0, 0.0, 0.0, 0.0]);
            splats.opacity_logits.push(logit(OPACITY));
            let base = point.rgb.map(|c| (f32::from(c) / 255.0 - 0.5) / SH_C0);
            splats.sh.extend(base);
            splats.sh.resize(splats.sh.len() + stride - 3, 0.0);
            splats.anchors.push(bringer.keyframe_id);
        }
        splats
    }
}

/// At most `n` of them, in order.
fn evenly(all: &[usize], n: usize) -> Vec<usize> {
    if all.len() <= n {
        return all.to_vec();
    }
    (0..n).map(|k| all[k * all.len() / n]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(position: [f64; 3], rgb: [u8; 3]) -> SparsePoint {
        SparsePoint {
            position_in_gt: position.into(),
            rgb,
            error_px: 0.5,
            n_images: 3,
        }
    }

    fn bringer<'a>(gt_from_cam: &'a Rigid, world_from_gt: &'a Similarity) -> Bringer<'a> {
        const LENS: Intrinsics = Intrinsics {
            width_px: 100,
            height_px: 80,
            fx: 50.0,
            fy: 50.0,
            cx: 50.0,
            cy: 40.0,
        };
        Bringer {
            keyframe_id: 7,
            intrinsics: &LENS,
            gt_from_cam,
            world_from_gt,
        }
    }

    #[test]
    fn a_point_becomes_a_round_splat_of_its_colour_as_large_as_points_are_apart() {
        let corners = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0]];
        let all = corners.map(|[x, y]| point([x - 1.5, y - 1.5, 4.0], [255, 0, 128]));
        let start = StartPoints::new(all.to_vec());
        let world_from_gt = Similarity {
            scale: 2.0,
            translation: DVec3::X,
            ..Similarity::IDENTITY
        };
        let bringer = bringer(&Rigid::IDENTITY, &world_from_gt);
        let seen = start.seen_from(&bringer);
        assert_eq!(seen, [0, 1, 2, 3]);
        let splats = start.splats(&[1], &bringer, 0.5, 1);
        splats.assert_consistent();
        assert_eq!(splats.means, [[4.0, -3.0, 8.0]]);
        // Squared distances 9, 9 and 18; twice the unit, half the scale.
        let expected = 12.0_f32.sqrt().ln();
        assert!((splats.log_scales[0][2] - expected).abs() < 1e-6);
        let color = |c: usize| 0.5 + SH_C0 * splats.sh[c];
        assert!((color(0) - 1.0).abs() < 1e-6 && color(1).abs() < 1e-6);
        assert_eq!((splats.sh.len(), splats.anchors[0]), (12, 7));
        assert!((splats.opacity_logits[0] - (0.1_f32 / 0.9).ln()).abs() < 1e-6);
    }

    #[test]
    fn points_wait_until_a_keyframe_sees_them_and_again_when_it_is_lost() {
        let positions = [
            [0.0, 0.0, 2.0],
            [0.0, 0.0, -2.0],
            [3.0, 0.0, 2.0],
            [0.1, 0.0, 2.0],
        ];
        let all = positions.map(|p| point(p, [9; 3]));
        let mut start = StartPoints::new(all.to_vec());
        let ahead = bringer(&Rigid::IDENTITY, &Similarity::IDENTITY);
        assert_eq!(start.seen_from(&ahead), [0, 3]);
        start.points[0].brought_by = Some(4);
        start.points[3].brought_by = Some(7);
        assert!(start.seen_from(&ahead).is_empty());
        start.release(|id| id == 4);
        assert_eq!(start.seen_from(&ahead), [3], "keyframe 7 is lost");
        assert_eq!(evenly(&[1, 3, 5, 7, 9], 2), [1, 5]);
        assert_eq!(evenly(&[1, 3], 2), [1, 3]);
        assert!(evenly(&[1, 3], 0).is_empty());
    }

    #[test]
    fn points_in_one_place_have_a_size_all_the_same() {
        let start = StartPoints::new(vec![point([0.0, 0.0, 2.0], [9; 3]); 5]);
        let bringer = bringer(&Rigid::IDENTITY, &Similarity::IDENTITY);
        let splats = start.splats(&[0], &bringer, 1.0, 0);
        assert!((splats.log_scales[0][0] - 0.02_f32.ln()).abs() < 1e-6);
    }
}
