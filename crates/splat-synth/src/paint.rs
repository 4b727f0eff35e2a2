//! Colours, and a place on a face that is to be painted.

use glam::{Vec2, Vec3};

use crate::noise::{edge, fractal, hash, nearest_point, pick, unit};

/// Linear colour; 1 is white paper.
pub(crate) type Rgb = Vec3;

/// A place on a face.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Spot {
    /// Metres from the centre of the face, v up.
    pub(crate) uv: Vec2,
    pub(crate) half: Vec2,
    /// Size of a sample on the surface in metres.
    pub(crate) footprint: f32,
    pub(crate) face: u8,
    pub(crate) seed: u32,
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum Painting {
    Blocks,
    Landscape,
    Circles,
    Page,
    Glass,
    Contours,
    Chart,
    Triangles,
    Clock,
    Map,
}

/// Linear colour of an sRGB hex triple.
pub(crate) fn rgb(hex: u32) -> Rgb {
    let channel = |shift: u32| {
        let value = ((hex >> shift) & 255) as f32 / 255.0;
        if value <= 0.04045 {
            value / 12.92
        } else {
            ((value + 0.055) / 1.055).powf(2.4)
        }
    };
    Vec3::new(channel(16), channel(8), channel(0))
}

/// A saturated colour of the colour wheel; `hue` in [0, 1).
pub(crate) fn hue(hue: f32, saturation: f32, value: f32) -> Rgb {
    let channel = |shift: f32| {
        let wheel = ((hue + shift).fract() * 6.0 - 3.0).abs() - 1.0;
        value * (1.0 - saturation * (1.0 - wheel.clamp(0.0, 1.0)))
    };
    let srgb = Vec3::new(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0));
    srgb.powf(2.2)
}

/// A palette of printed and dyed things: warm and cool, light and dark.
pub(crate) fn palette(n: u32) -> Rgb {
    const COLOURS: [u32; 16] = [
        0xB5_3A2E, 0x1F_4E79, 0xE0_A030, 0x2F_6B4F, 0xEB_E3D0, 0x6A_3552, 0xD9_7B4A, 0x24_2B38,
        0x8F_B3C4, 0xC4_3F6B, 0x5E_7A32, 0xF2_D25C, 0x38_8087, 0x8A_5A3C, 0xD8_D3E0, 0x44_4F9C,
    ];
    rgb(COLOURS[(n % 16) as usize])
}

pub(crate) fn mix(a: Rgb, b: Rgb, share: f32) -> Rgb {
    a + (b - a) * share
}

/// Clouds over four octaves plus grain: what keeps a painted surface from being one number.
pub(crate) fn flat(colour: Rgb, spot: &Spot) -> Rgb {
    let broad = fractal(spot.uv * 6.0, spot.seed, 4, spot.footprint * 6.0);
    let fine = fractal(spot.uv * 90.0, spot.seed ^ 1, 3, spot.footprint * 90.0);
    let mut shade = 1.0 + 0.12 * broad + 0.14 * fine;
    // Scuffs and dents: small spots, each its own size and depth.
    let scale = 22.0;
    let dent = nearest_point(spot.uv * scale, spot.seed ^ 2);
    let radius = 0.03 + 0.12 * pick(dent.id, 3);
    if unit(hash(dent.id)) < 0.4 {
        let covered = edge(dent.distance, radius, spot.footprint * scale);
        shade *= 1.0 - covered * (0.15 + 0.35 * pick(dent.id, 4));
    }
    colour * shade
}
