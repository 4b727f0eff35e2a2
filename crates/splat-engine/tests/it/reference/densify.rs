//! d loss / d projected mean -> the norm that densification adds up. docs/GRADIENTS.md, densification.

use super::{Camera, Params, Target, Weights, bin, loss, project, raster, raster_backward};

/// What one step sees of a splat: its index, the gradient in normalised device coordinates.
pub fn screen_gradients(
    params: &Params,
    camera: &Camera,
    target: &Target,
    weights: &Weights,
    sh_degree: u8,
) -> Vec<(usize, [f64; 2])> {
    let size = [
        camera.intrinsics.width_px as usize,
        camera.intrinsics.height_px as usize,
    ];
    let projected = project::project(params, camera, sh_degree);
    let raster = raster::raster(&projected, &bin::order(&projected), size);
    let loss = loss::loss(&raster, target, weights);
    let gradients = raster_backward::raster_backward(&projected, &raster, &loss);
    // x in pixels is width / 2 times x in device coordinates, and something.
    let in_device = |v: &raster_backward::ProjectedGradient| {
        let [x, y] = v.centre_px.into();
        [0.5 * size[0] as f64 * x, 0.5 * size[1] as f64 * y]
    };
    let seen = projected.iter().zip(&gradients);
    seen.map(|(splat, v)| (splat.splat_ix, in_device(v)))
        .collect()
}

/// The loss where the projected mean of the `which`-th visible splat is moved by so much of the device's coordinates.
pub fn loss_with_moved_mean(
    params: &Params,
    camera: &Camera,
    target: &Target,
    weights: &Weights,
    (sh_degree, which, by): (u8, usize, [f64; 2]),
) -> f64 {
    let size = [
        camera.intrinsics.width_px as usize,
        camera.intrinsics.height_px as usize,
    ];
    let mut projected = project::project(params, camera, sh_degree);
    projected[which].centre_px.x += 0.5 * size[0] as f64 * by[0];
    projected[which].centre_px.y += 0.5 * size[1] as f64 * by[1];
    let raster = raster::raster(&projected, &bin::order(&projected), size);
    loss::loss(&raster, target, weights).total
}
