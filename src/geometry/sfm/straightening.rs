//! Pictures of an uncalibrated camera whose lens bends -> the pinhole that they are straightened to, for stereo and map.
//!
//! A picture is made once; what adjustments change of the lens afterwards goes into the pinhole's focal length, until
//! the straight picture would be visibly wrong.

use std::collections::BTreeMap;

use glam::DVec2;

use super::scene::{Scene, Shot, bent};
use crate::camera::{Intrinsics, Lens};
use crate::source::rectify::Rectifier;

/// Error of the straight pictures in a corner, in pixels of the working picture, from which on they are made again.
const MAX_OFF_PX: f64 = 1.0;

/// How the pictures of uncalibrated shots are straightened; empty for a lens that is a pinhole.
#[derive(Debug, Default)]
pub(super) struct Straight {
    /// By size of the picture: its lens, and the pinhole to which it was straightened.
    pinholes: BTreeMap<(u32, u32), (Lens, Intrinsics)>,
    /// Radial coefficient and working lens when the pictures were made.
    made_with: Option<(f64, Intrinsics)>,
}

impl Straight {
    /// Lens and pinhole of a shot's picture; `None` where the picture is a pinhole's as it is.
    pub(super) fn of(&self, shot: &Shot) -> Option<(Lens, Intrinsics)> {
        let image = &shot.keyframe.frame.image;
        let (lens, pinhole) = self.pinholes.get(&(image.width_px, image.height_px))?;
        let now = shot.lens.resized(image.width_px, image.height_px);
        let since = now.fx / lens.intrinsics.fx;
        (!shot.is_calibrated).then(|| (*lens, pinhole.refocused(since)))
    }
}

/// Whether the lens has moved so far since the matches were verified that others would be. Says so once for each lens.
pub(super) fn links_are_stale(scene: &mut Scene, max_error_px: f64) -> bool {
    let now = scene
        .shots
        .iter()
        .find(|s| !s.is_calibrated)
        .map(|s| s.lens);
    let Some(now) = now else { return false };
    let was = bent(&now, scene.linked_with);
    let is_stale = off_px(&was, &bent(&now, scene.radial)) > max_error_px;
    if is_stale {
        scene.linked_with = scene.radial;
    }
    is_stale
}

/// Chooses pinholes anew where the lens has moved too far. True: pictures told of earlier are out of date.
pub(super) fn straighten_pictures(scene: &mut Scene) -> bool {
    let bends = |s: &&Shot| !s.is_calibrated && s.placed.is_some();
    let Some(now) = scene.shots.iter().find(bends).map(|s| s.lens) else {
        return false;
    };
    let (old_radial, then) = scene.straight.made_with.unwrap_or((0.0, now));
    let off_px = off_px(&bent(&then, old_radial), &bent(&now, scene.radial));
    let is_stale = off_px > MAX_OFF_PX;
    if is_stale {
        tracing::debug!(scene.radial, off_px, "pictures are straightened anew");
        scene.straight = Straight {
            made_with: (scene.radial != 0.0).then_some((scene.radial, now)),
            ..Straight::default()
        };
    }
    let Some((radial, then)) = scene.straight.made_with else {
        return is_stale;
    };
    for shot in scene.shots.iter().filter(bends) {
        let (width, height) = {
            let image = &shot.keyframe.frame.image;
            (image.width_px, image.height_px)
        };
        if scene.straight.pinholes.contains_key(&(width, height)) {
            continue;
        }
        let pinhole = shot.lens.refocused(then.fx / now.fx);
        let lens = bent(&pinhole.resized(width, height), radial);
        if let Some(straight) = Rectifier::new(&lens) {
            let known = &mut scene.straight.pinholes;
            known.insert((width, height), (lens, straight.pinhole));
        }
    }
    is_stale
}

/// How far a picture that was straightened for one lens is off under another, where it is worst. A common change of
/// the focal length is no error.
fn off_px(was: &Lens, now: &Lens) -> f64 {
    let off = |share: f64| {
        let centre = DVec2::new(now.intrinsics.cx, now.intrinsics.cy);
        let ray = |lens: &Lens| lens.ray_in_cam(centre * share).map(|ray| ray.truncate());
        let refocused = ray(was)? * (was.intrinsics.fx / now.intrinsics.fx);
        Some(refocused.distance(ray(now)?) * now.intrinsics.fx)
    };
    // From the corner inwards: beyond its fold a lens says nothing.
    [0.0, 0.25, 0.5]
        .into_iter()
        .filter_map(off)
        .fold(0.0, f64::max)
}
