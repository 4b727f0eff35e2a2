//! Signed distances -> a mesh of the surface.
//!
//! Surface nets: a vertex in each cube of eight voxels that the surface goes through, at the middle of the points where it cuts the cube's edges, and
//! a quadrilateral around each edge that it cuts (Gibson, "Constrained Elastic Surface Nets", 1998). Marching cubes cuts the same edges and needs
//! about twice the triangles.

use std::collections::{HashMap, HashSet};

use glam::{DVec3, IVec3};

use crate::blocks::SIDE;
use crate::voxels::Voxels;

/// Level frame, metres.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    pub vertices: Vec<[f32; 3]>,
    /// Counter-clockwise as seen from the free side.
    pub triangles: Vec<[u32; 3]>,
}

/// Corners of a cube of voxels, and the twelve edges between them.
const CORNERS: [IVec3; 8] = [
    IVec3::new(0, 0, 0),
    IVec3::new(1, 0, 0),
    IVec3::new(0, 1, 0),
    IVec3::new(1, 1, 0),
    IVec3::new(0, 0, 1),
    IVec3::new(1, 0, 1),
    IVec3::new(0, 1, 1),
    IVec3::new(1, 1, 1),
];
const EDGES: [(usize, usize); 12] = [
    (0, 1),
    (2, 3),
    (4, 5),
    (6, 7),
    (0, 2),
    (1, 3),
    (4, 6),
    (5, 7),
    (0, 4),
    (1, 5),
    (2, 6),
    (3, 7),
];

/// The surface of all voxels that know their distance.
pub fn mesh(voxels: &Voxels) -> Mesh {
    mesh_of(voxels, &voxels.indices())
}

/// The surface in the blocks that a box touches.
pub fn mesh_in(voxels: &Voxels, low: DVec3, high: DVec3) -> Mesh {
    // A surface between two blocks belongs to the lower one.
    let indices = voxels.indices_in(low, high, 1);
    // Cubes reach into the next blocks. Those that are on disk are read once.
    let near = |block: &IVec3| {
        let block = *block;
        (0..27).map(move |i| block + IVec3::new(i % 3, i / 3 % 3, i / 9) - 1)
    };
    let wanted: HashSet<IVec3> = indices.iter().flat_map(near).collect();
    mesh_of(&voxels.part(wanted.into_iter()), &indices)
}

fn mesh_of(voxels: &Voxels, indices: &[IVec3]) -> Mesh {
    let mut mesh = Mesh::default();
    let mut vertex_of: HashMap<IVec3, u32> = HashMap::new();
    for block in indices {
        for at in cells_of(*block) {
            if let Some(vertex) = vertex(voxels, at) {
                vertex_of.insert(at, mesh.vertices.len() as u32);
                mesh.vertices.push(vertex.as_vec3().to_array());
            }
        }
    }
    for block in indices {
        for at in cells_of(*block) {
            add_faces(voxels, at, &vertex_of, &mut mesh.triangles);
        }
    }
    mesh
}

/// Voxels of a block.
fn cells_of(block: IVec3) -> impl Iterator<Item = IVec3> {
    (0..SIDE * SIDE * SIDE)
        .map(move |i| block * SIDE + IVec3::new(i % SIDE, i / SIDE % SIDE, i / (SIDE * SIDE)))
}

/// In the cube from voxel `at` to the next ones; `None` where the surface does not go through it, or it is not all known.
fn vertex(voxels: &Voxels, at: IVec3) -> Option<DVec3> {
    let mut distances = [0.0; 8];
    for (distance, corner) in distances.iter_mut().zip(CORNERS) {
        *distance = voxels.voxel(at + corner).distance(voxels.truncation)?;
    }
    let mut sum = DVec3::ZERO;
    let mut n = 0;
    for (a, b) in EDGES {
        let (from, to) = (distances[a], distances[b]);
        if (from < 0.0) != (to < 0.0) {
            let share = from / (from - to);
            sum += CORNERS[a].as_dvec3().lerp(CORNERS[b].as_dvec3(), share);
            n += 1;
        }
    }
    (n > 0).then(|| (at.as_dvec3() + 0.5 + sum / f64::from(n)) * voxels.size)
}

/// Around the edges from voxel `at` to the next along each axis.
fn add_faces(
    voxels: &Voxels,
    at: IVec3,
    vertex_of: &HashMap<IVec3, u32>,
    triangles: &mut Vec<[u32; 3]>,
) {
    let inside = |at: IVec3| {
        let distance = voxels.voxel(at).distance(voxels.truncation);
        distance.map(|distance| distance < 0.0)
    };
    let Some(here) = inside(at) else { return };
    for axis in 0..3 {
        let step = IVec3::AXES[axis];
        let (u, v) = (IVec3::AXES[(axis + 1) % 3], IVec3::AXES[(axis + 2) % 3]);
        if inside(at + step).is_none_or(|there| there == here) {
            continue;
        }
        let around = [at - u - v, at - v, at, at - u].map(|cube| vertex_of.get(&cube).copied());
        let [Some(a), Some(b), Some(c), Some(d)] = around else {
            continue;
        };
        // Inside here, free there: the face looks along the axis.
        if here {
            triangles.extend([[a, b, c], [a, c, d]]);
        } else {
            triangles.extend([[a, c, b], [a, d, c]]);
        }
    }
}

impl Mesh {
    /// A binary PLY; `colours` per vertex, sRGB.
    pub fn ply(&self, colours: &[[u8; 3]]) -> Vec<u8> {
        let header = format!(
            "ply\nformat binary_little_endian 1.0\ncomment metres, z up\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face {}\nproperty list uchar uint vertex_indices\nend_header\n",
            self.vertices.len(),
            self.triangles.len()
        );
        let mut bytes = header.into_bytes();
        for (vertex, colour) in self.vertices.iter().zip(colours) {
            for value in vertex {
                bytes.extend_from_slice(&value.to_le_bytes());
            }
            bytes.extend_from_slice(colour);
        }
        for triangle in &self.triangles {
            bytes.push(3);
            for index in triangle {
                bytes.extend_from_slice(&index.to_le_bytes());
            }
        }
        bytes
    }
}
