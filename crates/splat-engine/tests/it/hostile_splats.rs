//! What the reference implementation claims of hostile scenes, and that they are worth the time.

use nalgebra::Vector3;

use crate::reference::hostile::{KINDS, camera};
use crate::reference::{Params, bin, project, raster, render};

#[test]
fn no_box_cuts_off_a_pixel_that_its_splat_touches() {
    let mut n_hits = 0;
    for (name, n, make) in KINDS {
        for seed in 0..n.min(6) {
            let scene = make(seed);
            let projected = project::project(&Params::from(&scene.splats), &camera(&scene), 3);
            let order = bin::order(&projected);
            let (width, height) = (
                scene.view.intrinsics.width_px as usize,
                scene.view.intrinsics.height_px as usize,
            );
            let everywhere = raster::raster(&projected, &order, [width, height]);
            let tiles = bin::tiles(&projected, &order, [width, height]);
            let tile = |x: usize, y: usize| {
                &tiles[y / bin::TILE_PX * width.div_ceil(bin::TILE_PX) + x / bin::TILE_PX]
            };
            let by_tiles =
                raster::raster_lists(&projected, |x, y| tile(x, y).as_slice(), [width, height]);
            assert!(
                everywhere.rgb == by_tiles.rgb && everywhere.alpha == by_tiles.alpha,
                "{name} {seed}"
            );
            for (pixel, hits) in everywhere.hits.iter().enumerate() {
                for hit in hits {
                    let splat = &projected[hit.ix];
                    let offset = (raster::pixel_centre(pixel % width, pixel / width)
                        - splat.centre_px)
                        .abs();
                    assert!(
                        offset.x <= splat.radius_px.x && offset.y <= splat.radius_px.y,
                        "{name} {seed} {splat:?}"
                    );
                    n_hits += 1;
                }
            }
        }
    }
    assert!(n_hits > 100_000, "{n_hits}");
}

#[test]
fn the_reference_gives_finite_images_of_hostile_scenes() {
    for (name, n, make) in KINDS {
        for seed in 0..n.min(6) {
            let scene = make(seed);
            let raster = render(&Params::from(&scene.splats), &camera(&scene), 3);
            let values = raster
                .rgb
                .iter()
                .chain(&raster.alpha)
                .chain(&raster.depth_sum);
            assert!(values.copied().all(f64::is_finite), "{name} {seed}");
            assert!(
                raster.alpha.iter().all(|a| (0.0..=1.0).contains(a)),
                "{name} {seed}"
            );
        }
    }
}

#[test]
fn hostile_scenes_show_something() {
    for (name, n, make) in KINDS {
        let lit = (0..n).filter(|&seed| {
            let scene = make(seed);
            render(&Params::from(&scene.splats), &camera(&scene), 3)
                .alpha
                .iter()
                .any(|&alpha| alpha > 0.1)
        });
        let n_lit = lit.count() as u64;
        assert!(
            if name == "no splats" {
                n_lit == 0
            } else {
                2 * n_lit > n
            },
            "{name}: {n_lit} of {n}"
        );
    }
}

#[test]
fn the_sh_basis_is_orthonormal_over_the_sphere() {
    let n = 400;
    let mut gram = [[0.0; 16]; 16];
    for i in 0..n {
        // Midpoint rule in z and longitude is exact enough for degree 6.
        let z = (i as f64 + 0.5) / n as f64 * 2.0 - 1.0;
        for j in 0..16 {
            let angle = f64::from(j) / 16.0 * std::f64::consts::TAU;
            let across = (1.0 - z * z).sqrt();
            let basis =
                project::sh_basis(Vector3::new(across * angle.cos(), across * angle.sin(), z));
            for (row, a) in gram.iter_mut().zip(basis) {
                for (cell, b) in row.iter_mut().zip(basis) {
                    *cell += a * b * 4.0 * std::f64::consts::PI / (16.0 * n as f64);
                }
            }
        }
    }
    for (i, row) in gram.iter().enumerate() {
        for (j, cell) in row.iter().enumerate() {
            assert!(
                (cell - f64::from(u8::from(i == j))).abs() < 2e-4,
                "{i} {j} {cell}"
            );
        }
    }
}
