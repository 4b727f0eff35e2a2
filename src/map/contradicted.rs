//! New views with verified depth -> splats that float before what they see, which go.

use std::sync::Arc;

use glam::DVec3;

use crate::camera::Intrinsics;
use crate::frame::DepthMap;
use crate::map::SplatMap;
use crate::pose::Rigid;

/// A splat lies before the surface if it ends at less than this share of its depth, and on it if its middle is so near.
const BEFORE: f64 = 0.8;
const ON: f64 = 0.12;
/// Sizes of a splat beyond which there is next to nothing of it.
const REACH: f64 = 2.0;
/// New views that see through a splat, while none sees it on its surface.
const MIN_VIEWS: u32 = 2;

struct Witness {
    id: u32,
    cam_from_map: Rigid,
    lens: Intrinsics,
    depth: Arc<DepthMap>,
}

enum Verdict {
    Silent,
    Agrees,
    SeesThrough,
}

impl SplatMap {
    /// Removes splats of older views that several new ones see through.
    pub(super) fn remove_contradicted(&mut self, fresh: &[u32]) {
        let witnesses: Vec<Witness> = fresh.iter().filter_map(|id| self.witness(*id)).collect();
        if witnesses.len() < MIN_VIEWS as usize || self.engine.n_splats() == 0 {
            return;
        }
        let splats = self.engine.splats();
        let keeps = |i: usize| {
            let mean = DVec3::from(splats.means[i].map(f64::from));
            let largest = splats.log_scales[i].into_iter().fold(f32::MIN, f32::max);
            let reach = REACH * f64::from(largest.exp());
            let mut n_through = 0;
            for witness in witnesses.iter().filter(|w| w.id != splats.anchors[i]) {
                match witness.verdict(mean, reach) {
                    Verdict::Agrees => return true,
                    Verdict::SeesThrough => n_through += 1,
                    Verdict::Silent => (),
                }
            }
            n_through < MIN_VIEWS
        };
        let keep: Vec<bool> = (0..splats.len()).map(keeps).collect();
        let n_gone = keep.iter().filter(|k| !**k).count();
        if n_gone > 0 {
            tracing::debug!(n_gone, "splats before what new views see");
            self.engine.retain(&keep);
        }
    }

    fn witness(&mut self, id: u32) -> Option<Witness> {
        let (_, cam_from_map) = self.camera(id)?;
        let placed = self.keyframes.placed.get(&id).filter(|p| !p.is_held_out)?;
        let depth = Arc::clone(&placed.depth);
        Some(Witness {
            id,
            cam_from_map,
            lens: placed.intrinsics.resized(depth.width_px, depth.height_px),
            depth,
        })
    }
}

impl Witness {
    fn verdict(&self, mean: DVec3, reach: f64) -> Verdict {
        let in_cam = self.cam_from_map.transform_point(mean);
        let Some(pixel) = self.lens.project(in_cam) else {
            return Verdict::Silent;
        };
        let (w, h) = (
            f64::from(self.depth.width_px),
            f64::from(self.depth.height_px),
        );
        let is_inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h;
        if !is_inside {
            return Verdict::Silent;
        }
        let at = pixel.y as usize * self.depth.width_px as usize + pixel.x as usize;
        match self.depth.verified(at).map(|found| f64::from(found.0)) {
            Some(depth) if (in_cam.z / depth - 1.0).abs() <= ON => Verdict::Agrees,
            Some(depth) if in_cam.z + reach < BEFORE * depth => Verdict::SeesThrough,
            _ => Verdict::Silent,
        }
    }
}
