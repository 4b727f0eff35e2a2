//! A grid -> the two files that Nav2's map_server loads: a PGM image and a YAML page about it.

use crate::grid::{FREE, Grid, OCCUPIED};

/// What map_saver writes, and its thresholds.
const FREE_PIXEL: u8 = 254;
const OCCUPIED_PIXEL: u8 = 0;
const UNKNOWN_PIXEL: u8 = 205;

/// A binary PGM, the row of the highest y first.
pub fn pgm(grid: &Grid) -> Vec<u8> {
    let (width, height) = (grid.extent.width as usize, grid.extent.height as usize);
    let mut bytes = format!("P5\n{width} {height}\n255\n").into_bytes();
    for row in grid.cells.chunks(width.max(1)).rev() {
        bytes.extend(row.iter().map(|cell| match *cell {
            FREE => FREE_PIXEL,
            OCCUPIED => OCCUPIED_PIXEL,
            _ => UNKNOWN_PIXEL,
        }));
    }
    bytes
}

/// The page for an image of that name beside it.
pub fn yaml(grid: &Grid, image: &str) -> String {
    let origin = grid.origin();
    // Quoted as JSON is: a name may hold anything.
    let quoted = image.replace('\\', "\\\\").replace('"', "\\\"");
    format!(
        "image: \"{quoted}\"\nmode: trinary\nresolution: {:.6}\norigin: [{:.6}, {:.6}, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        grid.resolution, origin.x, origin.y
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{Extent, UNKNOWN};
    use glam::IVec2;

    #[test]
    fn the_highest_row_comes_first() {
        let grid = Grid {
            extent: Extent {
                first: IVec2::new(-128, 256),
                width: 2,
                height: 2,
            },
            resolution: 0.05,
            cells: vec![FREE, OCCUPIED, UNKNOWN, FREE],
            is_cropped: false,
        };
        assert_eq!(pgm(&grid), b"P5\n2 2\n255\n\xcd\xfe\xfe\x00");
        let yaml = yaml(&grid, "house.pgm");
        assert!(yaml.contains("origin: [-6.400000, 12.800000, 0]"), "{yaml}");
        assert!(yaml.contains("resolution: 0.050000"));
    }
}
