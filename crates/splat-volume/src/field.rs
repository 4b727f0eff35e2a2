//! Points -> distances to the nearest surface, and their gradients.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::blocks::SIDE;
use crate::distance::lower_envelope;
use crate::voxels::{State, Voxels};

/// Voxels around the points of one question: 128 MiB of distances.
const MAX_VOXELS: i64 = 1 << 25;
/// Within this share of the truncation the volume's own distance counts, which is finer than a voxel.
const NEAR: f64 = 0.9;

/// Of one point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distance {
    /// Metres, negative behind a surface; at most what was asked for.
    pub metres: f64,
    /// Of unit length, along which the distance grows; zero where there is none.
    pub gradient: DVec3,
    /// Somebody has seen the place.
    pub is_known: bool,
}

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FieldError {
    #[error("point {index} is not finite: {point}")]
    NotFinite { index: usize, point: DVec3 },
    #[error(
        "the points lie in {n} voxels, more than {MAX_VOXELS}: ask for those that are near each other"
    )]
    TooFarApart { n: i64 },
}

/// Distances from the middles of surface voxels in a box of the level frame, in voxels, exact (Felzenszwalb and Huttenlocher 2012).
struct Field {
    low: IVec3,
    size: IVec3,
    /// x fastest; infinite where there is no surface in the box.
    distances: Vec<f32>,
}

/// Points of the level frame, metres -> their distances, up to `max` metres.
pub fn distances(voxels: &Voxels, points: &[DVec3], max: f64) -> Result<Vec<Distance>, FieldError> {
    let not_finite = points.iter().position(|point| !point.is_finite());
    if let Some(index) = not_finite {
        let point = points[index];
        return Err(FieldError::NotFinite { index, point });
    }
    if points.is_empty() {
        return Ok(Vec::new());
    }
    let field = Field::around(voxels, points, max)?;
    let found = points
        .par_iter()
        .map(|point| field.distance(voxels, *point, max));
    Ok(found.collect())
}

/// In a box of `size` voxels from voxel `low` on: at their middles, x fastest, then y.
pub fn box_distances(
    voxels: &Voxels,
    low: IVec3,
    size: IVec3,
    max: f64,
) -> Result<Vec<Distance>, FieldError> {
    let middles: Vec<DVec3> = (0..size.z)
        .flat_map(|z| (0..size.y).map(move |y| (y, z)))
        .flat_map(|(y, z)| (0..size.x).map(move |x| IVec3::new(x, y, z)))
        .map(|at| ((low + at).as_dvec3() + 0.5) * voxels.size)
        .collect();
    distances(voxels, &middles, max)
}

impl Field {
    fn around(voxels: &Voxels, points: &[DVec3], max: f64) -> Result<Self, FieldError> {
        let margin = DVec3::splat(max + 2.0 * voxels.size);
        let low = points.iter().fold(points[0], |a, b| a.min(*b)) - margin;
        let high = points.iter().fold(points[0], |a, b| a.max(*b)) + margin;
        let sides = ((high - low) / voxels.size).ceil() + 1.0;
        let n = sides.x * sides.y * sides.z;
        let reach = low.abs().max(high.abs()).max_element() / voxels.size;
        if !(n <= MAX_VOXELS as f64 && reach < f64::from(i32::MAX / 4)) {
            return Err(FieldError::TooFarApart { n: n as i64 });
        }
        let (low, size) = ((low / voxels.size).floor().as_ivec3(), sides.as_ivec3());
        let mut sites = vec![f32::INFINITY; n as usize];
        let (first, last) = (
            low.div_euclid(IVec3::splat(SIDE)),
            (low + size).div_euclid(IVec3::splat(SIDE)),
        );
        for z in first.z..=last.z {
            for y in first.y..=last.y {
                for x in first.x..=last.x {
                    mark(voxels, IVec3::new(x, y, z), (low, size), &mut sites);
                }
            }
        }
        // Along one axis after the other; three turns bring the axes back.
        let mut sides = [size.x as usize, size.y as usize, size.z as usize];
        for _ in 0..3 {
            sites.par_chunks_mut(sides[0]).for_each(lower_envelope);
            sites = turned(&sites, sides);
            sides.rotate_left(1);
        }
        sites
            .par_iter_mut()
            .for_each(|squared| *squared = squared.sqrt());
        Ok(Self {
            low,
            size,
            distances: sites,
        })
    }

    /// Metres, without a sign, between the middles of eight voxels.
    fn unsigned(&self, voxel: f64, point: DVec3) -> f64 {
        let at = point / voxel - 0.5 - self.low.as_dvec3();
        let corner = at.floor().clamp(DVec3::ZERO, (self.size - 2).as_dvec3());
        let share = (at - corner).clamp(DVec3::ZERO, DVec3::ONE);
        let corner = corner.as_ivec3();
        let value = |x: i32, y: i32, z: i32| {
            let at = corner + IVec3::new(x, y, z);
            let row = (at.z * self.size.y + at.y) as usize * self.size.x as usize;
            f64::from(self.distances[row + at.x as usize])
        };
        let along_x = |y: i32, z: i32| value(0, y, z) * (1.0 - share.x) + value(1, y, z) * share.x;
        let along_y = |z: i32| along_x(0, z) * (1.0 - share.y) + along_x(1, z) * share.y;
        (along_y(0) * (1.0 - share.z) + along_y(1) * share.z) * voxel
    }

    fn distance(&self, voxels: &Voxels, point: DVec3, max: f64) -> Distance {
        let voxel = voxels.voxel((point / voxels.size).floor().as_ivec3());
        let state = voxels.state(voxel);
        let own = voxel.distance(voxels.truncation);
        let near = own.filter(|own| own.abs() < NEAR * voxels.truncation);
        let is_inside = near.map_or(state == State::Inside, |own| own < 0.0);
        let unsigned = self.unsigned(voxels.size, point);
        let sign = if is_inside { -1.0 } else { 1.0 };
        let metres = near.unwrap_or(sign * unsigned);
        let step = voxels.size / 2.0;
        let slope = DVec3::from_array(DVec3::AXES.map(|axis| {
            let ahead = self.unsigned(voxels.size, point + axis * step);
            ahead - self.unsigned(voxels.size, point - axis * step)
        }));
        let gradient = (sign * slope).normalize_or_zero();
        Distance {
            metres: if metres.is_finite() {
                metres.clamp(-max, max)
            } else {
                max
            },
            gradient: if unsigned < max && gradient.is_finite() {
                gradient
            } else {
                DVec3::ZERO
            },
            is_known: state != State::Unknown,
        }
    }
}

/// Surface voxels of a block, as far as they lie in the box, are sites.
fn mark(voxels: &Voxels, block: IVec3, (low, size): (IVec3, IVec3), sites: &mut [f32]) {
    let Some(view) = voxels.block(block) else {
        return;
    };
    for y in 0..SIDE {
        for x in 0..SIDE {
            for (z, state) in view.states(x, y).into_iter().enumerate() {
                let at = block * SIDE + IVec3::new(x, y, z as i32) - low;
                let is_within = at.min_element() >= 0 && at.cmplt(size).all();
                if state == State::Surface && is_within {
                    let row = (at.z * size.y + at.y) as usize * size.x as usize;
                    sites[row + at.x as usize] = 0.0;
                }
            }
        }
    }
}

/// Axes x, y, z -> y, z, x.
fn turned(values: &[f32], [nx, ny, nz]: [usize; 3]) -> Vec<f32> {
    let mut turned = vec![0.0; values.len()];
    turned
        .par_chunks_mut(ny * nz)
        .enumerate()
        .for_each(|(x, plane)| {
            for (at, value) in plane.iter_mut().enumerate() {
                *value = values[at * nx + x];
            }
        });
    turned
}
