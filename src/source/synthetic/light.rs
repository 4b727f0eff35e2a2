//! Light that falls on every face, computed once per scene on coarse grids: lamps with soft shadows, sky, and what
//! neighbours send back. Contact shadows come of the same rays. The sun alone is asked for at every sample.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;

use super::geometry::Ray;
use super::noise::{fractal, hash, pick};
use super::scene::{Scene, Solid};
use super::textures::{Rgb, mix, rgb};

/// A shining rectangle; it shines to the side of `half_u x half_v`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lamp {
    pub(super) centre: DVec3,
    pub(super) half_u: DVec3,
    pub(super) half_v: DVec3,
    pub(super) colour: Rgb,
}

#[derive(Debug)]
pub(super) struct Light {
    pub(super) lamps: Vec<Lamp>,
    /// Unit vector to the sun and its strength.
    pub(super) sun: Option<(DVec3, Rgb)>,
    /// From directions where nothing stands.
    pub(super) sky: Rgb,
    /// What comes back from a neighbour, in shares of its colour.
    pub(super) bounce: Rgb,
    /// Distance at which a neighbour gives half of what a far one gives: how far corners darken.
    pub(super) reach: f64,
    /// Wished distance between the nodes of a grid.
    pub(super) texel: f64,
}

/// Light at the nodes of a face, rows first.
#[derive(Debug, Clone)]
pub(super) struct Grid {
    n_u: usize,
    n_v: usize,
    light: Vec<Vec3>,
}

/// Ambient rays per node; a blur over neighbours hides the rest of the noise.
const N_AMBIENT: u32 = 32;
/// Shadow rays per lamp and node, squared.
const N_SHADOW: u32 = 3;
const MAX_NODES: f64 = 160.0;
/// Nodes keep off the rim of their face, where neighbours would cover them wholly.
const RIM: f64 = 0.012;

impl Light {
    pub(super) fn bake(&self, scene: &Scene) -> Vec<Vec<Grid>> {
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

    pub(super) fn sunlight(&self, scene: &Scene, point: DVec3, normal: DVec3) -> Vec3 {
        let Some((direction, colour)) = self.sun else {
            return Vec3::ZERO;
        };
        let lands = normal.dot(direction);
        if lands <= 0.0
            || scene.is_covered(
                &Ray {
                    origin: point + normal * 1e-3,
                    direction,
                },
                f64::MAX,
            )
        {
            return Vec3::ZERO;
        }
        colour * lands as f32
    }
}

/// Sky with clouds, for rays that meet nothing.
pub(super) fn backdrop(direction: DVec3) -> Rgb {
    let up = direction.z.max(0.02);
    let on_clouds = Vec2::new((direction.x / up) as f32, (direction.y / up) as f32) * 0.8;
    let clouds = fractal(on_clouds, 77, 5, 0.02 / up as f32);
    let blue = mix(rgb(0xC8_DCEC), rgb(0x5A_8CC8), up as f32);
    mix(blue, rgb(0xF6_F4F0), (0.35 + 1.2 * clouds).clamp(0.0, 1.0))
}

impl Grid {
    /// Light at a place in [-1, 1]^2, between nodes linearly.
    pub(super) fn sample(&self, scaled: DVec2) -> Vec3 {
        let place = |x: f64, n: usize| {
            let x = ((0.5 * x + 0.5) * (n - 1) as f64).clamp(0.0, (n - 1) as f64);
            let low = (x as usize).min(n - 2);
            (low, (x - low as f64) as f32)
        };
        let (u, share_u) = place(scaled.x, self.n_u);
        let (v, share_v) = place(scaled.y, self.n_v);
        let row =
            |v: usize| self.light[v * self.n_u + u].lerp(self.light[v * self.n_u + u + 1], share_u);
        row(v).lerp(row(v + 1), share_v)
    }

    /// Mean of each node (twice) and its neighbours.
    fn blurred(self) -> Self {
        let (n_u, n_v) = (self.n_u, self.n_v);
        let at = |u: usize, v: usize| self.light[v * n_u + u];
        let light = (0..n_u * n_v)
            .map(|ix| {
                let (u, v) = (ix % n_u, ix / n_u);
                let mut sum = 4.0 * at(u, v);
                sum += at(u.saturating_sub(1), v) + at((u + 1).min(n_u - 1), v);
                sum += at(u, v.saturating_sub(1)) + at(u, (v + 1).min(n_v - 1));
                sum / 8.0
            })
            .collect();
        Self { n_u, n_v, light }
    }
}
