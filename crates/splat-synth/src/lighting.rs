//! Solids under lamps and a sky -> the light on every face, computed once per scene on coarse grids: lamps with soft
//! shadows, sky, and what neighbours send back. Contact shadows come of the same rays.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use crate::geometry::Ray;
use crate::light::{Grid, Light};
use crate::noise::{hash, pick};
use crate::props::Props;
use crate::scene::Scene;
use crate::solid::Solid;

/// Ambient rays per node; a blur over neighbours hides the rest of the noise.
const N_AMBIENT: u32 = 32;
/// Shadow rays per lamp and node, squared.
const N_SHADOW: u32 = 3;
const MAX_NODES: f64 = 160.0;
/// Nodes keep off the rim of their face, where neighbours would cover them wholly.
const RIM: f64 = 0.012;

/// The scene with the light of all lamps and the sky on its faces; that of the sun is found at every sample.
pub(crate) fn lit(props: Props, light: Light) -> Scene {
    let mut scene = Scene::unlit(props, light);
    let grids = scene.light.bake(&scene);
    for (solid, grids) in scene.solids.iter_mut().zip(grids) {
        solid.grids = grids;
    }
    scene
}

impl Light {
    fn bake(&self, scene: &Scene) -> Vec<Vec<Grid>> {
        scene
            .solids
            .par_iter()
            .map(|solid| self.bake_solid(scene, solid))
            .collect()
    }

    fn bake_solid(&self, scene: &Scene, solid: &Solid) -> Vec<Grid> {
        if solid.paint.glows() {
            return Vec::new();
        }
        let face_grid = |face: u8| {
            let half = solid.placed.face_half(face);
            let count =
                |half: f64| ((2.0 * half / self.texel).ceil().clamp(1.0, MAX_NODES)) as usize + 1;
            let (n_u, n_v) = (count(half.x), count(half.y));
            let rim = (DVec2::splat(RIM) / half).min(DVec2::splat(0.3));
            let light = (0..n_u * n_v)
                .into_par_iter()
                .map(|ix| {
                    let share = |i: usize, n: usize| 2.0 * i as f64 / (n - 1) as f64 - 1.0;
                    let scaled =
                        DVec2::new(share(ix % n_u, n_u), share(ix / n_u, n_v)) * (DVec2::ONE - rim);
                    let (point, normal) = solid.placed.point_on_face(face, scaled);
                    let seed = hash(
                        solid.seed ^ (ix as u32).wrapping_mul(8).wrapping_add(u32::from(face)),
                    );
                    self.gather(scene, point + normal * 1e-3, normal, seed)
                })
                .collect();
            Grid { n_u, n_v, light }.blurred().blurred()
        };
        (0..solid.placed.n_faces()).map(face_grid).collect()
    }

    fn gather(&self, scene: &Scene, point: DVec3, normal: DVec3, seed: u32) -> Vec3 {
        self.ambient(scene, point, normal, seed) + self.lamplight(scene, point, normal, seed)
    }

    /// Mean over the half space above the face, weighted by the cosine.
    fn ambient(&self, scene: &Scene, point: DVec3, normal: DVec3, seed: u32) -> Vec3 {
        let tangent = normal.any_orthonormal_vector();
        let bitangent = normal.cross(tangent);
        let start = f64::from(pick(seed, 1));
        let mut sum = Vec3::ZERO;
        for n in 0..N_AMBIENT {
            // Points of a golden spiral on the disk, lifted to the hemisphere, are cosine weighted.
            let radius_squared = (f64::from(n) + 0.5) / f64::from(N_AMBIENT);
            let (sin, cos) = (TAU * (start + f64::from(n) * 0.618_033_988_75)).sin_cos();
            let out = radius_squared.sqrt();
            let direction =
                (tangent * cos + bitangent * sin) * out + normal * (1.0 - radius_squared).sqrt();
            let ray = Ray {
                origin: point,
                direction,
            };
            sum += match scene.meet(&ray, f64::MAX) {
                None => self.sky,
                Some(hit) => {
                    let near = (hit.distance / (hit.distance + self.reach)) as f32;
                    scene.solids[hit.solid_ix].mean * self.bounce * near
                }
            };
        }
        sum / N_AMBIENT as f32
    }

    fn lamplight(&self, scene: &Scene, point: DVec3, normal: DVec3, seed: u32) -> Vec3 {
        let mut sum = Vec3::ZERO;
        for (lamp_ix, lamp) in self.lamps.iter().enumerate() {
            let across = lamp.half_u.cross(lamp.half_v);
            let area = 4.0 * across.length();
            let facing = across / across.length();
            let mut arriving = 0.0;
            for n in 0..N_SHADOW * N_SHADOW {
                let jitter =
                    |axis: u32| f64::from(pick(seed, 100 * (lamp_ix as u32 + 1) + 2 * n + axis));
                let share = |cell: u32, axis: u32| {
                    2.0 * (f64::from(cell) + jitter(axis)) / f64::from(N_SHADOW) - 1.0
                };
                let (u, v) = (share(n % N_SHADOW, 0), share(n / N_SHADOW, 1));
                let on_lamp = lamp.centre + lamp.half_u * u + lamp.half_v * v;
                let to_lamp = on_lamp - point;
                let distance = to_lamp.length().max(0.1);
                let direction = to_lamp / distance;
                let (leaves, lands) = (-facing.dot(direction), normal.dot(direction));
                if leaves <= 0.0 || lands <= 0.0 {
                    continue;
                }
                if !scene.is_covered(
                    &Ray {
                        origin: point,
                        direction,
                    },
                    distance - 0.02,
                ) {
                    arriving += leaves * lands * area / (distance * distance);
                }
            }
            sum += lamp.colour * (arriving / f64::from(N_SHADOW * N_SHADOW)) as f32;
        }
        sum
    }
}
