//! A painted solid, and the light on its faces.

use glam::{Vec2, Vec3};

use crate::geometry::PlacedShape;
use crate::light::Grid;
use crate::paint::{Rgb, Spot};
use crate::textures::Paint;

#[derive(Debug)]
pub(crate) struct Solid {
    pub(crate) placed: PlacedShape,
    pub(crate) paint: Paint,
    pub(crate) seed: u32,
    /// Colour of the whole, for what it throws on its neighbours.
    pub(crate) mean: Rgb,
    /// One light grid for each face; empty for what shines.
    pub(crate) grids: Vec<Grid>,
}

impl Solid {
    /// Mean over a few places of the largest face.
    pub(crate) fn mean_colour(&self) -> Rgb {
        const N: u32 = 5;
        let face = (0..self.placed.n_faces()).max_by(|a, b| {
            let size = |face: u8| self.placed.face_half(face).element_product();
            size(*a).total_cmp(&size(*b))
        });
        let half = self.placed.face_half(face.unwrap_or(0)).as_vec2();
        let mut sum = Rgb::ZERO;
        for n in 0..N * N {
            let place =
                Vec2::new((n % N) as f32 + 0.5, (n / N) as f32 + 0.5) * (2.0 / N as f32) - 1.0;
            let spot = Spot {
                uv: place * half,
                half,
                footprint: 0.05,
                face: face.unwrap_or(0),
                seed: self.seed,
            };
            sum += self.paint.colour(&spot).clamp(Vec3::ZERO, Vec3::ONE);
        }
        sum / (N * N) as f32
    }
}
