//! Paint: (place on a face) -> linear colour. Everything is made up from hashes, nothing is stored.
//!
//! Each face gets its own seed, so that no two surfaces look the same. Materials of building parts are in
//! `surfaces.rs` and `joinery.rs`, woven and grown things in `ornaments.rs`, pictures and writing in `pictures.rs` and
//! `prints.rs`.

use glam::{Vec2, Vec3};

use super::noise::{fractal, hash, nearest_point, pick, unit};
use super::{joinery, ornaments, pictures, prints, surfaces};

/// Linear colour; 1 is white paper.
pub(super) type Rgb = Vec3;

/// A place on a face.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot {
    /// Metres from the centre of the face, v up.
    pub(super) uv: Vec2,
    pub(super) half: Vec2,
    /// Size of a sample on the surface in metres.
    pub(super) footprint: f32,
    pub(super) face: u8,
    pub(super) seed: u32,
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Paint {
    /// One colour with the small unevenness of painted things.
    Flat(Rgb),
    Plaster(Rgb),
    /// Running bond: brick colour, mortar colour, size of one brick.
    Bricks {
        brick: Rgb,
        mortar: Rgb,
        size: Vec2,
    },
    /// Boards along u: two colours between which they vary, length and width.
    Planks {
        light: Rgb,
        dark: Rgb,
        size: Vec2,
    },
    /// Squares of strips that lie crosswise.
    Parquet {
        light: Rgb,
        dark: Rgb,
    },
    /// Square tiles in two colours.
    Tiles {
        first: Rgb,
        second: Rgb,
        size: f32,
    },
    /// Stone chips of many colours in a ground.
    Terrazzo {
        ground: Rgb,
        size: f32,
    },
    Wood(Rgb),
    Metal(Rgb),
    Asphalt,
    Ceiling,
    Bark,
    Wallpaper {
        ground: Rgb,
        first: Rgb,
        second: Rgb,
    },
    Fabric {
        first: Rgb,
        second: Rgb,
        width: f32,
    },
    Rug {
        first: Rgb,
        second: Rgb,
    },
    Leaf(Rgb),
    Fruit(Rgb),
    Picture(Picture),
    Spine(Rgb),
    Label {
        ground: Rgb,
        ink: Rgb,
        text: &'static str,
    },
    /// A window seen from outside.
    Pane,
    /// Shines by itself: colour and strength.
    Glow(Rgb),
    /// A window seen from inside: the bright world behind the glass.
    View,
    Drawers {
        wood: Rgb,
        rows: u8,
        columns: u8,
    },
    Panelled(Rgb),
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Picture {
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

impl Paint {
    /// Light that the place sends back (or out, when it glows) under unit illumination.
    pub(super) fn colour(&self, spot: &Spot) -> Rgb {
        match *self {
            Self::Flat(colour) => flat(colour, spot),
            Self::Plaster(colour) => surfaces::plaster(colour, spot),
            Self::Bricks {
                brick,
                mortar,
                size,
            } => surfaces::bricks(brick, mortar, size, spot),
            Self::Planks { light, dark, size } => joinery::planks(light, dark, size, spot),
            Self::Parquet { light, dark } => joinery::parquet(light, dark, spot),
            Self::Tiles {
                first,
                second,
                size,
            } => surfaces::tiles(first, second, size, spot),
            Self::Terrazzo { ground, size } => surfaces::terrazzo(ground, size, spot),
            Self::Wood(colour) => joinery::wood(colour, spot.uv, spot),
            Self::Metal(colour) => surfaces::metal(colour, spot),
            Self::Asphalt => surfaces::asphalt(spot),
            Self::Ceiling => surfaces::ceiling(spot),
            Self::Bark => surfaces::bark(spot),
            Self::Wallpaper {
                ground,
                first,
                second,
            } => ornaments::wallpaper([ground, first, second], spot),
            Self::Fabric {
                first,
                second,
                width,
            } => ornaments::fabric(first, second, width, spot),
            Self::Rug { first, second } => ornaments::rug(first, second, spot),
            Self::Leaf(colour) => ornaments::leaf(colour, spot),
            Self::Fruit(colour) => ornaments::fruit(colour, spot),
            Self::Picture(picture) => pictures::picture(picture, spot),
            Self::Spine(colour) => prints::spine(colour, spot),
            Self::Label { ground, ink, text } => prints::label(ground, ink, text, spot),
            Self::Pane => surfaces::pane(spot),
            Self::Glow(colour) => colour,
            Self::View => pictures::view(spot),
            Self::Drawers {
                wood,
                rows,
                columns,
            } => joinery::drawers(wood, rows, columns, spot),
            Self::Panelled(colour) => joinery::panelled(colour, spot),
        }
    }

    /// Shining things are not lit and cast no shadow.
    pub(super) fn glows(&self) -> bool {
        matches!(self, Self::Glow(_) | Self::View)
    }
}

/// Linear colour of an sRGB hex triple.
pub(super) fn rgb(hex: u32) -> Rgb {
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
pub(super) fn hue(hue: f32, saturation: f32, value: f32) -> Rgb {
    let channel = |shift: f32| {
        let wheel = ((hue + shift).fract() * 6.0 - 3.0).abs() - 1.0;
        value * (1.0 - saturation * (1.0 - wheel.clamp(0.0, 1.0)))
    };
    let srgb = Vec3::new(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0));
    srgb.powf(2.2)
}

/// A palette of printed and dyed things: warm and cool, light and dark.
pub(super) fn palette(n: u32) -> Rgb {
    const COLOURS: [u32; 16] = [
        0xB5_3A2E, 0x1F_4E79, 0xE0_A030, 0x2F_6B4F, 0xEB_E3D0, 0x6A_3552, 0xD9_7B4A, 0x24_2B38,
        0x8F_B3C4, 0xC4_3F6B, 0x5E_7A32, 0xF2_D25C, 0x38_8087, 0x8A_5A3C, 0xD8_D3E0, 0x44_4F9C,
    ];
    rgb(COLOURS[(n % 16) as usize])
}

pub(super) fn mix(a: Rgb, b: Rgb, share: f32) -> Rgb {
    a + (b - a) * share
}

/// Clouds over four octaves plus grain: what keeps a painted surface from being one number.
pub(super) fn flat(colour: Rgb, spot: &Spot) -> Rgb {
    let broad = fractal(spot.uv * 6.0, spot.seed, 4, spot.footprint * 6.0);
    let fine = fractal(spot.uv * 90.0, spot.seed ^ 1, 3, spot.footprint * 90.0);
    let mut shade = 1.0 + 0.12 * broad + 0.14 * fine;
    // Scuffs and dents: small spots, each its own size and depth.
    let scale = 22.0;
    let dent = nearest_point(spot.uv * scale, spot.seed ^ 2);
    let radius = 0.03 + 0.12 * pick(dent.id, 3);
    if unit(hash(dent.id)) < 0.4 {
        let covered = super::noise::edge(dent.distance, radius, spot.footprint * scale);
        shade *= 1.0 - covered * (0.15 + 0.35 * pick(dent.id, 4));
    }
    colour * shade
}
