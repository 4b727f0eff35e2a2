//! Lamps, sun and sky of a scene, and the grids that hold what falls on each face.

use glam::{DVec2, DVec3, Vec2, Vec3};

use crate::noise::fractal;
use crate::paint::{Rgb, mix, rgb};

/// A shining rectangle; it shines to the side of `half_u x half_v`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lamp {
    pub(crate) centre: DVec3,
    pub(crate) half_u: DVec3,
    pub(crate) half_v: DVec3,
    pub(crate) colour: Rgb,
}

#[derive(Debug)]
pub(crate) struct Light {
    pub(crate) lamps: Vec<Lamp>,
    /// Unit vector to the sun and its strength.
    pub(crate) sun: Option<(DVec3, Rgb)>,
    /// From directions where nothing stands.
    pub(crate) sky: Rgb,
    /// What comes back from a neighbour, in shares of its colour.
    pub(crate) bounce: Rgb,
    /// Distance at which a neighbour gives half of what a far one gives: how far corners darken.
    pub(crate) reach: f64,
    /// Wished distance between the nodes of a grid.
    pub(crate) texel: f64,
}

/// Light at the nodes of a face, rows first.
#[derive(Debug, Clone)]
pub(crate) struct Grid {
    pub(crate) n_u: usize,
    pub(crate) n_v: usize,
    pub(crate) light: Vec<Vec3>,
}

/// Sky with clouds, for rays that meet nothing.
pub(crate) fn backdrop(direction: DVec3) -> Rgb {
    let up = direction.z.max(0.02);
    let on_clouds = Vec2::new((direction.x / up) as f32, (direction.y / up) as f32) * 0.8;
    let clouds = fractal(on_clouds, 77, 5, 0.02 / up as f32);
    let blue = mix(rgb(0xC8_DCEC), rgb(0x5A_8CC8), up as f32);
    mix(blue, rgb(0xF6_F4F0), (0.35 + 1.2 * clouds).clamp(0.0, 1.0))
}

impl Grid {
    /// Light at a place in [-1, 1]^2, between nodes linearly.
    pub(crate) fn sample(&self, scaled: DVec2) -> Vec3 {
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
    pub(crate) fn blurred(self) -> Self {
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
