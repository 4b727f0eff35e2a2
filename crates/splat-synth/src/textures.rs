//! Paint: (place on a face) -> linear colour. Everything is generated from hashes, nothing is stored.
//!
//! Each face gets its own seed, so that no two surfaces look the same. Materials of building parts are in
//! `surfaces.rs` and `joinery.rs`, woven and grown things in `ornaments.rs`, paintings and writing in `paintings.rs` and
//! `prints.rs`.

use glam::Vec2;

use crate::paint::{Painting, Rgb, Spot, flat};
use crate::{joinery, ornaments, paintings, prints, surfaces};

#[derive(Debug, Clone, Copy)]
pub(crate) enum Paint {
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
    Painting(Painting),
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

impl Paint {
    /// Light that the place sends back (or out, when it glows) under unit illumination.
    pub(crate) fn colour(&self, spot: &Spot) -> Rgb {
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
            Self::Painting(painting) => paintings::painting(painting, spot),
            Self::Spine(colour) => prints::spine(colour, spot),
            Self::Label { ground, ink, text } => prints::label(ground, ink, text, spot),
            Self::Pane => surfaces::pane(spot),
            Self::Glow(colour) => colour,
            Self::View => paintings::view(spot),
            Self::Drawers {
                wood,
                rows,
                columns,
            } => joinery::drawers(wood, rows, columns, spot),
            Self::Panelled(colour) => joinery::panelled(colour, spot),
        }
    }

    /// Shining things are not lit and cast no shadow.
    pub(crate) fn glows(&self) -> bool {
        matches!(self, Self::Glow(_) | Self::View)
    }
}
