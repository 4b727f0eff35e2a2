//! Uncalibrated and unordered images: small batches on their own, the whole set without its order.

use rand::SeedableRng;
use rand::seq::SliceRandom;

use crate::hard_images::{hall, stroll};
use crate::hard_world::{Flaws, LENS, Paint, film};
use crate::scenes::scene;
use crate::sfm::{Shown, intrinsics, run, shown};

const BATCH: usize = 6;

/// Share registered over all windows of `BATCH` images, and the worst focal length as a ratio to the true one.
fn windows(name: &str, shown: &Shown, focal_px: f64, changes: &[&str]) -> (f64, f64) {
    let (mut registered, mut all) = (0, 0);
    let mut worst = 0.0_f64;
    for from in (0..=shown.keyframes.len() - BATCH).step_by(BATCH) {
        let window = shown.part(from..from + BATCH).without_calibration();
        let figures = run(&window, changes);
        eprintln!(
            "{name} {from}: focal {:.3}, {figures:?}",
            figures.focal_px / focal_px
        );
        registered += figures.registered;
        all += BATCH;
        if figures.registered > 0 {
            worst = worst.max((figures.focal_px / focal_px - 1.0).abs());
        }
    }
    (registered as f64 / f64::from(all as u32), worst)
}

#[test]
fn six_images_of_the_fox_are_enough_for_poses_and_focal_length() {
    let Some(folder) = scene("fox") else { return };
    let shown = shown(&folder, 640, 1, false);
    let width = f64::from(shown.keyframes[0].frame.image.width_px);
    let lens = intrinsics(&folder);
    let focal_px = lens.fx * width / f64::from(lens.width_px);
    let (share, worst) = windows("fox", &shown, focal_px, &[]);
    assert!(
        share >= 0.95 && worst <= 0.05,
        "{share} registered, focal {worst}"
    );
}

#[test]
fn six_images_of_a_hall_are_enough_for_poses_and_focal_length() {
    let shown = film(&hall(Paint::Varied), &stroll(), Flaws::default(), LENS);
    let changes = ["sfm.max_side=400", "sfm.max_features=1000"];
    let (share, worst) = windows("hall", &shown, LENS.fx, &changes);
    assert!(
        share >= 0.95 && worst <= 0.05,
        "{share} registered, focal {worst}"
    );
}

#[test]
fn a_fox_without_order_and_calibration_is_registered_whole() {
    let Some(folder) = scene("fox") else { return };
    let shown = shown(&folder, 480, 1, false);
    let mut order: Vec<usize> = (0..shown.keyframes.len()).collect();
    order.shuffle(&mut rand_pcg::Pcg32::seed_from_u64(4));
    let width = f64::from(shown.keyframes[0].frame.image.width_px);
    let lens = intrinsics(&folder);
    let focal = lens.fx * width / f64::from(lens.width_px);
    let figures = run(&shown.in_order(&order), &["sfm.max_side=480"]);
    eprintln!(
        "fox shuffled: focal {:.4}, {figures:?}",
        figures.focal_px / focal
    );
    assert_eq!(
        (figures.registered, figures.submaps),
        (50, 1),
        "{figures:?}"
    );
    assert!(figures.ate_percent <= 0.2, "{figures:?}");
    assert!(
        (figures.focal_px / focal - 1.0).abs() <= 0.015,
        "{figures:?}"
    );
}
