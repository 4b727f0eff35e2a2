//! Posed images -> depth of one of them, on the CPU, and what other views say of it.

use crate::mvs::consistency::{self, Tolerance};
use crate::mvs::params::MvsParams;
use crate::mvs::view::{MvsView, Prepared, RawDepth, prepared};
use crate::mvs::{depth_edges, exposure, guided_filter, planes, sgm, sweep, warp, zncc};
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

/// Depth of `reference` by matching it against `sources`, between the planes `near` and `far`, on the CPU.
///
/// Empty (all 0) where nothing can be determined: no usable source, no parallax, an impossible range.
pub fn sweep(
    reference: &MvsView,
    sources: &[&MvsView],
    (near, far): (f64, f64),
    params: &MvsParams,
) -> RawDepth {
    let reference = Prepared::new(reference, params);
    let sources = prepared(sources, params);
    let sources: Vec<&Prepared> = sources.iter().collect();
    match SweepTask::new(&reference, &sources, (near, far), params) {
        Some(task) => task.raw_depth(task.winners_on_cpu()),
        None => RawDepth::empty(reference.intrinsics),
    }
}

/// Keeps the depths that at least `params.min_views` of `others` agree with; all other confidences are 0.
pub fn verify(
    reference: (&MvsView, &RawDepth),
    others: &[(&MvsView, &RawDepth)],
    params: &MvsParams,
) -> DepthMap {
    let others: Vec<(Rigid, &RawDepth)> = others
        .iter()
        .map(|(view, raw)| (view.submap_from_cam, *raw))
        .collect();
    consistency::verify((reference.0.submap_from_cam, reference.1), &others, params)
}

/// For each pixel of `reference` how many of `others` agree with its depth, and how many see through it.
pub fn votes(
    reference: (Rigid, &RawDepth),
    others: &[(Rigid, &RawDepth)],
    tolerance: Tolerance,
) -> Vec<[u8; 2]> {
    consistency::votes(reference, others, tolerance)
}

/// A sweep that can determine something: a reference with planes, and sources that see parallax between them.
#[derive(Debug)]
pub(crate) struct SweepTask<'a> {
    pub(crate) reference: &'a Prepared,
    pub(crate) warps: Vec<warp::Warp<'a>>,
    pub(crate) planes: planes::Planes,
}

impl<'a> SweepTask<'a> {
    /// `None`: nothing can be determined.
    pub(crate) fn new(
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
            n: params.depth_planes.max(3),
        };
        let (sources, mut warps): (Vec<&Prepared>, Vec<warp::Warp<'_>>) = sources
            .iter()
            .filter(|source| source.is_usable())
            .filter_map(|source| Some((*source, warp::Warp::new(reference, source, &planes)?)))
            .take(params.source_views)
            .unzip();
        (!warps.is_empty()).then(|| {
            let lights = exposure::Lighting::of(reference, &sources, &planes);
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

    pub(crate) fn winners_on_cpu(&self) -> sgm::Winners {
        self.winners_giving_way(&|| ())
    }

    pub(crate) fn winners_giving_way(&self, give_way: sweep::GiveWay<'_>) -> sgm::Winners {
        let costs = sweep::matching_costs(
            &self.reference.grey,
            &self.warps,
            &self.planes,
            zncc::OWN_SHARE,
            give_way,
        );
        give_way();
        sgm::best_planes(&self.reference.grey, &costs, self.planes.n)
    }

    pub(crate) fn raw_depth(&self, winners: sgm::Winners) -> RawDepth {
        let depths = winners.plane.iter().map(|plane| self.planes.depth(*plane));
        let mut depth: Vec<f32> = depths.collect();
        depth_edges::settle(self.reference, &self.warps, &mut depth);
        guided_filter::settle(self.reference, &mut depth);
        RawDepth {
            intrinsics: self.reference.intrinsics,
            depth,
            score: winners.score,
            margin: winners.margin,
        }
    }
}

#[cfg(test)]
mod tests;
