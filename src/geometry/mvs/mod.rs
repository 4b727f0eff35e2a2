//! Posed pictures -> dense depth: plane sweep with ZNCC, semi-global matching, cross-view verification.
//!
//! Knows nothing of how the poses came about. Lengths are in whatever unit the poses use.

mod colours;
mod consistency;
mod edges;
pub mod gpu;
mod grey;
mod light;
mod matcher;
pub mod neighbours;
mod planes;
mod sgm;
pub mod state;
mod sweep;
#[cfg(test)]
mod tests;
mod zncc;

use std::sync::Arc;

pub use consistency::Tolerance;

use crate::camera::Intrinsics;
use crate::config::MvsParams;
use crate::frame::{DepthMap, RgbImage};
use crate::pose::Rigid;

/// A picture and where it was taken from.
#[derive(Debug, Clone)]
pub struct MvsView {
    pub image: Arc<RgbImage>,
    /// May be stated for another size of the same picture.
    pub intrinsics: Intrinsics,
    pub world_from_cam: Rigid,
}

/// Depth of one view before any other view has confirmed it. Not to be shown or mapped.
#[derive(Debug, Clone)]
pub struct RawDepth {
    /// Of the depth map, not of the picture that it was made from.
    pub intrinsics: Intrinsics,
    /// z-depth; 0 = no value.
    pub depth: Vec<f32>,
    /// ZNCC of the depth's plane, 0 to 1.
    pub score: Vec<f32>,
    /// How far the best plane stands out from the second best, 0 to 1.
    pub margin: Vec<f32>,
}

/// Depth of `reference` by matching it against `sources`, between the planes `near` and `far`, on the CPU.
///
/// Empty (all 0) where nothing can be told: no usable source, no parallax, an impossible range.
pub fn sweep(
    reference: &MvsView,
    sources: &[&MvsView],
    (near, far): (f64, f64),
    params: &MvsParams,
) -> RawDepth {
    let reference = Prepared::new(reference, params);
    let sources = prepared(sources, params);
    let sources: Vec<&Prepared> = sources.iter().collect();
    match Task::new(&reference, &sources, (near, far), params) {
        Some(task) => task.raw_depth(task.winners_on_cpu()),
        None => RawDepth::empty(reference.intrinsics),
    }
}

fn prepared(views: &[&MvsView], params: &MvsParams) -> Vec<Prepared> {
    let views = views.iter();
    views.map(|view| Prepared::new(view, params)).collect()
}

/// Keeps the depths that at least `params.min_views` of `others` agree with; all other confidences are 0.
pub fn verify(
    reference: (&MvsView, &RawDepth),
    others: &[(&MvsView, &RawDepth)],
    params: &MvsParams,
) -> DepthMap {
    let others: Vec<(Rigid, &RawDepth)> = others
        .iter()
        .map(|(view, raw)| (view.world_from_cam, *raw))
        .collect();
    consistency::verify((reference.0.world_from_cam, reference.1), &others, params)
}

/// For each pixel of `reference` how many of `others` agree with its depth, and how many see through it.
pub fn votes(
    reference: (Rigid, &RawDepth),
    others: &[(Rigid, &RawDepth)],
    tolerance: Tolerance,
) -> Vec<[u8; 2]> {
    consistency::votes(reference, others, tolerance)
}

/// What matching needs of a view: grey, at the size of the depth map.
#[derive(Debug, Clone)]
struct Prepared {
    grey: grey::Grey,
    /// The same picture at up to twice the size, for what is narrower than a window.
    fine: grey::Grey,
    intrinsics: Intrinsics,
    world_from_cam: Rigid,
}

impl Prepared {
    fn new(view: &MvsView, params: &MvsParams) -> Self {
        let grey = grey::Grey::of_image(&view.image, params);
        let fine = grey.finer(&view.image);
        let intrinsics = view
            .intrinsics
            .resized(grey.width as u32, grey.height as u32);
        Self {
            grey,
            fine,
            intrinsics,
            world_from_cam: view.world_from_cam,
        }
    }

    fn is_usable(&self) -> bool {
        let unit = (self.world_from_cam.rotation.length_squared() - 1.0).abs() < 1e-3;
        self.world_from_cam.is_finite()
            && unit
            && self.intrinsics.is_plausible()
            && self.grey.width >= MIN_SIDE_PX
            && self.grey.height >= MIN_SIDE_PX
    }
}

/// Two matching windows; smaller pictures hold no depth worth having.
const MIN_SIDE_PX: usize = 2 * zncc::WINDOW;

/// A sweep that can tell something: a reference with planes, and sources that see parallax between them.
#[derive(Debug)]
struct Task<'a> {
    reference: &'a Prepared,
    warps: Vec<sweep::Warp<'a>>,
    planes: planes::Planes,
}

impl<'a> Task<'a> {
    /// `None`: nothing can be told.
    fn new(
        reference: &'a Prepared,
        sources: &[&'a Prepared],
        (near, far): (f64, f64),
        params: &MvsParams,
    ) -> Option<Self> {
        let range_fits = near.is_finite() && far.is_finite() && near > 0.0 && far > near * 1.000_1;
        if !range_fits || !reference.is_usable() {
            return None;
        }
        let planes = planes::Planes {
            inverse_near: 1.0 / near,
            inverse_far: 1.0 / far,
            n: params.n_depths.max(3),
        };
        let (sources, mut warps): (Vec<&Prepared>, Vec<sweep::Warp<'_>>) = sources
            .iter()
            .filter(|source| source.is_usable())
            .filter_map(|source| Some((*source, sweep::Warp::new(reference, source, &planes)?)))
            .take(params.n_sources)
            .unzip();
        (!warps.is_empty()).then(|| {
            let lights = light::Lighting::of(reference, &sources, &planes);
            for (warp, lighting) in warps.iter_mut().zip(lights) {
                warp.shown = lighting.shown(&reference.grey);
                warp.light = lighting.overall;
            }
            Self {
                reference,
                warps,
                planes,
            }
        })
    }

    fn winners_on_cpu(&self) -> sgm::Winners {
        let costs = sweep::matching_costs(
            &self.reference.grey,
            &self.warps,
            &self.planes,
            zncc::OWN_SHARE,
        );
        sgm::best_planes(&self.reference.grey, &costs, self.planes.n)
    }

    fn raw_depth(&self, winners: sgm::Winners) -> RawDepth {
        let depths = winners.plane.iter().map(|plane| self.planes.depth(*plane));
        let mut depth: Vec<f32> = depths.collect();
        edges::settle(self.reference, &self.warps, &mut depth);
        colours::settle(self.reference, &mut depth);
        RawDepth {
            intrinsics: self.reference.intrinsics,
            depth,
            score: winners.score,
            margin: winners.margin,
        }
    }
}

impl RawDepth {
    fn empty(intrinsics: Intrinsics) -> Self {
        let n = intrinsics.width_px as usize * intrinsics.height_px as usize;
        Self {
            intrinsics,
            depth: vec![0.0; n],
            score: vec![0.0; n],
            margin: vec![0.0; n],
        }
    }
}
