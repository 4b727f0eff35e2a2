//! The newest views -> older ones that see the same surface: what new splats change shows there, too.

use glam::DVec2;

use crate::map::SplatMap;
use crate::map::keyframes::Placed;
use crate::map::schedule::N_NEWEST;
use crate::pose::Rigid;

/// Depths of a view that stand for its surface, along each side.
const GRID: usize = 8;
/// Share of a new view's surface that another must see.
const MIN_SHARED: f64 = 0.25;

impl SplatMap {
    /// Looks for them among all views.
    pub(super) fn find_covisible(&mut self) {
        let map_poses = self.engine.poses();
        let first = self.trainable.len().saturating_sub(N_NEWEST);
        let newest = &self.trainable[first..];
        let placed = self.keyframes.placed.values().filter(|p| !p.is_held_out);
        let (new, old): (Vec<&Placed>, Vec<&Placed>) =
            placed.partition(|p| newest.contains(&p.view_ix));
        let sees = |other: &&&Placed| {
            let cam_from_map = map_poses[other.view_ix];
            new.iter().any(|own| {
                let other_from_own = cam_from_map * map_poses[own.view_ix].inverse();
                shared(own, other, &other_from_own) >= MIN_SHARED
            })
        };
        let found = old.iter().filter(sees).map(|p| p.view_ix);
        self.covisible = found.collect();
    }
}

/// Share of the surface of one view that lies in the picture of another.
fn shared(own: &Placed, other: &Placed, other_from_own: &Rigid) -> f64 {
    let (w, h) = (own.depth.width_px as usize, own.depth.height_px as usize);
    let lens = own
        .intrinsics
        .resized(own.depth.width_px, own.depth.height_px);
    let (width, height) = (
        f64::from(other.intrinsics.width_px),
        f64::from(other.intrinsics.height_px),
    );
    let (mut n_all, mut n_seen) = (0.0, 0.0);
    for cell in 0..GRID * GRID {
        let x = (cell % GRID * 2 + 1) * w / (2 * GRID);
        let y = (cell / GRID * 2 + 1) * h / (2 * GRID);
        let Some((depth, _)) = own.depth.verified(y * w + x) else {
            continue;
        };
        n_all += 1.0;
        let in_own = lens.ray_in_cam(DVec2::new(x as f64 + 0.5, y as f64 + 0.5)) * f64::from(depth);
        let landed = other
            .intrinsics
            .project(other_from_own.transform_point(in_own));
        let is_inside = |p: DVec2| p.x >= 0.0 && p.y >= 0.0 && p.x < width && p.y < height;
        n_seen += f64::from(u8::from(landed.is_some_and(is_inside)));
    }
    if n_all > 0.0 { n_seen / n_all } else { 0.0 }
}
