//! A grid for planners -> the message that draws it on the ground.

use std::io::Cursor;

use base64::Engine as _;
use glam::{DQuat, DVec2, IVec2};
use image::{ImageFormat, Rgba, RgbaImage};
use serde_json::json;

use splat_volume::grid::{FREE, Grid, OCCUPIED};

/// Longer side of the image: of a larger grid every n-th cell is drawn.
const MAX_SIDE: i32 = 1024;
const FREE_COLOUR: [u8; 4] = [70, 190, 120, 110];
const OCCUPIED_COLOUR: [u8; 4] = [220, 60, 50, 220];

/// `height`: of the ground in the grid's frame, metres. `None` where nothing is known.
pub(crate) fn grid(grid: &Grid, map_from_grid: DQuat, height: f64) -> Option<String> {
    let (first, last) = grid.known()?;
    let size = last - first + 1;
    let every = (size.max_element() + MAX_SIDE - 1) / MAX_SIDE;
    let drawn = (size + every - 1) / every;
    let image = RgbaImage::from_fn(drawn.x as u32, drawn.y as u32, |x, y| {
        // The highest y is on top.
        let cell = first + IVec2::new(x as i32, drawn.y - 1 - y as i32) * every;
        Rgba(match grid.cell(cell) {
            FREE => FREE_COLOUR,
            OCCUPIED => OCCUPIED_COLOUR,
            _ => [0; 4],
        })
    });
    let mut png = Vec::new();
    image
        .write_to(&mut Cursor::new(&mut png), ImageFormat::Png)
        .ok()?;
    let corner: DVec2 = first.as_dvec2() * grid.resolution;
    let q = map_from_grid;
    let message = json!({
        "type": "grid",
        "name": "grid",
        "rotation": [q.x, q.y, q.z, q.w],
        "translation": (q * corner.extend(height)).to_array(),
        "resolution": grid.resolution * f64::from(every),
        "width": drawn.x,
        "height": drawn.y,
        "png": base64::engine::general_purpose::STANDARD.encode(png),
    });
    Some(message.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_volume::grid::{Extent, UNKNOWN};

    #[test]
    fn the_corner_lies_where_the_first_known_cell_does() {
        let mut all = Grid {
            extent: Extent {
                first: IVec2::new(-128, 0),
                width: 128,
                height: 128,
            },
            resolution: 0.05,
            cells: vec![UNKNOWN; 128 * 128],
            is_cropped: false,
        };
        assert_eq!(grid(&all, DQuat::IDENTITY, 0.0), None);
        all.cells[10 * 128 + 28] = FREE;
        all.cells[12 * 128 + 30] = OCCUPIED;
        let said = grid(&all, DQuat::IDENTITY, -1.5).unwrap();
        let said: serde_json::Value = serde_json::from_str(&said).unwrap();
        assert_eq!((&said["width"], &said["height"]), (&json!(3), &json!(3)));
        assert_eq!(said["translation"], json!([-5.0, 0.5, -1.5]));
        let png = base64::engine::general_purpose::STANDARD
            .decode(said["png"].as_str().unwrap())
            .unwrap();
        let image = image::load_from_memory(&png).unwrap().to_rgba8();
        assert_eq!(image.get_pixel(2, 0).0, OCCUPIED_COLOUR);
        assert_eq!(image.get_pixel(0, 2).0, FREE_COLOUR);
        assert_eq!(image.get_pixel(1, 1).0, [0; 4]);
    }
}
