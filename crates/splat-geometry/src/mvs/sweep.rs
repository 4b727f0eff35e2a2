//! Reference and source images -> matching cost of each pixel on each plane of a sweep.
//!
//! Planes are parallel to the reference image. A cost is 1 - score, averaged over the two sources that match
//! best: a point hidden from some sources is still seen by two. A score is the ZNCC over a square window and, for a
//! smaller part, how like the two pixels in its middle are (compare Mei et al., ICCV workshops 2011): a window beside
//! the edge of a thing matches at the depth of the thing, the pixel in its middle need not.

use rayon::prelude::*;

use crate::mvs::luma::Grey;
use crate::mvs::planes::Planes;
use crate::mvs::warp::Warp;
use crate::mvs::zncc::{Statistics, plane_costs};

/// Waits while something that is more urgent than depth is at work.
pub(crate) type GiveWay<'a> = &'a (dyn Fn() + Sync);

/// Cost 0 (perfect) to 255, `[y][x][plane]`. `own_share`: of a score, what the pixel itself says; the rest is ZNCC.
/// `give_way` is called before each plane, some milliseconds apart, and may wait.
pub(crate) fn matching_costs(
    reference: &Grey,
    warps: &[Warp<'_>],
    planes: &Planes,
    own_share: f32,
    give_way: GiveWay<'_>,
) -> Vec<u8> {
    let n_pixels = reference.width * reference.height;
    let statistics = Statistics::of(reference);
    let mut by_plane = vec![0_u8; planes.n * n_pixels];
    by_plane
        .par_chunks_mut(n_pixels)
        .enumerate()
        .for_each(|(plane, costs)| {
            give_way();
            plane_costs(
                reference,
                &statistics,
                warps,
                own_share,
                planes.inverse_depth(plane as f64),
                costs,
            );
        });
    let mut costs = vec![0_u8; planes.n * n_pixels];
    let (width, n_planes) = (reference.width, planes.n);
    costs
        .par_chunks_mut(width * n_planes)
        .enumerate()
        .for_each(|(y, row)| {
            for plane in 0..n_planes {
                let from = &by_plane[plane * n_pixels + y * width..][..width];
                for (into, &cost) in row[plane..].iter_mut().step_by(n_planes).zip(from) {
                    *into = cost;
                }
            }
        });
    costs
}
