//! Splats around the vertices of a mesh -> its colours.

use std::collections::HashMap;

use glam::{DMat3, DVec3, IVec3};
use rayon::prelude::*;

use crate::ellipsoids::{mean, opacity, own_axes};
use crate::mesh::Mesh;
use splat_types::splats::splats::{SH_C0, Splats};
use splat_types::transform::Similarity;

/// Of vertices that no splat is near.
const NO_COLOUR: [u8; 3] = [128; 3];
/// Splats with less do not count.
const MIN_OPACITY: f64 = 0.05;
/// Splats of one cell that are looked at, the most opaque ones.
const MAX_IN_CELL: usize = 64;

/// A splat as a colour in space.
struct Blob {
    mean: DVec3,
    /// Turns metres into standard deviations along the own axes; those are widened by half of a voxel, since that is how far a vertex may lie off.
    whiten: DMat3,
    opacity: f64,
    colour: DVec3,
}

/// sRGB of each vertex: the mean over splats near it, by opacity and by how near they are in their own standard deviations. `voxel`: metres.
pub fn colours(
    mesh: &Mesh,
    voxel: f64,
    splats: &Splats,
    level_from_world: &Similarity,
) -> Vec<[u8; 3]> {
    let edge = 2.0 * voxel;
    let cell_of = |place: DVec3| (place / edge).floor().as_ivec3();
    let mut cells: HashMap<IVec3, Vec<Blob>> = HashMap::new();
    // Only where vertices are: maps are larger than what is asked for.
    let vertex = |at: &[f32; 3]| DVec3::from_array(at.map(f64::from));
    for place in mesh.vertices.iter().map(vertex) {
        for near in around(cell_of(place)) {
            cells.entry(near).or_default();
        }
    }
    for ix in 0..splats.len() {
        if !splats.is_finite(ix) || opacity(splats, ix) < MIN_OPACITY {
            continue;
        }
        let place = level_from_world.transform_point(mean(splats, ix));
        if let Some(cell) = cells.get_mut(&cell_of(place)) {
            cell.push(Blob::new(splats, ix, level_from_world, voxel));
        }
    }
    for cell in cells.values_mut().filter(|c| c.len() > MAX_IN_CELL) {
        cell.sort_by(|a, b| b.opacity.total_cmp(&a.opacity));
        cell.truncate(MAX_IN_CELL);
    }
    let vertices = mesh.vertices.par_iter();
    vertices
        .map(|at| {
            let place = vertex(at);
            let near = around(cell_of(place)).filter_map(|cell| cells.get(&cell));
            colour(near.flatten(), place)
        })
        .collect()
}

fn around(cell: IVec3) -> impl Iterator<Item = IVec3> {
    (0..27).map(move |i| cell + IVec3::new(i % 3, i / 3 % 3, i / 9) - 1)
}

fn colour<'a>(blobs: impl Iterator<Item = &'a Blob>, place: DVec3) -> [u8; 3] {
    let (mut sum, mut total) = (DVec3::ZERO, 0.0);
    for blob in blobs {
        let away = (blob.whiten * (place - blob.mean)).length_squared();
        let weight = blob.opacity * (-0.5 * away).exp();
        sum += weight * blob.colour;
        total += weight;
    }
    if total < 1e-12 {
        return NO_COLOUR;
    }
    (sum / total)
        .to_array()
        .map(|share| (255.0 * share).round().clamp(0.0, 255.0) as u8)
}

impl Blob {
    fn new(splats: &Splats, ix: usize, level_from_world: &Similarity, voxel: f64) -> Self {
        let (rotation, sigmas) = own_axes(splats, ix, level_from_world);
        let wide = sigmas.map(|s| (s * s + voxel * voxel / 4.0).sqrt());
        let at = ix * splats.sh_stride();
        let sh = [0, 1, 2].map(|k| f64::from(splats.sh[at + k]));
        Self {
            mean: level_from_world.transform_point(mean(splats, ix)),
            whiten: DMat3::from_diagonal(1.0 / wide) * DMat3::from_quat(rotation.inverse()),
            opacity: opacity(splats, ix),
            colour: DVec3::from_array(sh) * f64::from(SH_C0) + 0.5,
        }
    }
}
