//! 2D Gaussians -> the order they are laid down in, and which 16 x 16 tiles each one's box touches. docs/GRADIENTS.md 3.

use super::project::Projected;

pub const TILE_PX: usize = 16;

/// Near to far by depth as f32, equal depths by index.
pub fn order(projected: &[Projected]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..projected.len()).collect();
    // Stable, and `projected` is in order of splats.
    order.sort_by(|&a, &b| {
        let depth = |ix: usize| projected[ix].mean_in_cam.z as f32;
        depth(a).total_cmp(&depth(b))
    });
    order
}

/// Per tile, row by row, the part of `order` whose box touches it.
pub fn tiles(projected: &[Projected], order: &[usize], size: [usize; 2]) -> Vec<Vec<usize>> {
    let n_tiles = size.map(|side| side.div_ceil(TILE_PX));
    let mut tiles = vec![Vec::new(); n_tiles[0] * n_tiles[1]];
    for &ix in order {
        let [xs, ys] = [0, 1].map(|axis| {
            let (centre, radius) = (projected[ix].centre_px[axis], projected[ix].radius_px[axis]);
            let tile = |edge: f64| (edge / TILE_PX as f64).clamp(0.0, n_tiles[axis] as f64);
            tile(centre - radius).floor() as usize..tile(centre + radius).ceil() as usize
        });
        for y in ys {
            for x in xs.clone() {
                tiles[y * n_tiles[0] + x].push(ix);
            }
        }
    }
    tiles
}
