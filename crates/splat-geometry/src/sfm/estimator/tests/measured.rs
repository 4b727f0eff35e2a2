//! The same points with the distances that a depth sensor measures.

use super::*;
use crate::sfm::updates::SparseView;
use splat_types::snapshot::ScaleSource;

/// 1/m: of a sensor that is off by 5 cm at 5 m.
const SIGMA: f64 = 0.002;

/// Distances times `factor`, with the sensor's noise; every seventh is wrong and every fifth missing.
fn sensor(factor: f64) -> impl FnMut(usize, &[f64]) -> Option<FeatureDepths> {
    let mut rng = Pcg32::seed_from_u64(31);
    move |_, depths: &[f64]| {
        let inverse = |(ix, depth): (usize, &f64)| {
            let noise: f64 = (0..3).map(|_| rng.random_range(-SIGMA..SIGMA)).sum();
            match ix {
                ix if ix % 5 == 0 => 0.0,
                ix if ix % 7 == 0 => 0.6 / depth,
                _ => 1.0 / (factor * depth) + noise,
            }
        };
        Some(FeatureDepths {
            inverse: depths
                .iter()
                .enumerate()
                .map(inverse)
                .map(|v| v as f32)
                .collect(),
            sigma_inverse: SIGMA,
            common_error: 0.01,
            source: ScaleSource::Depth,
        })
    }
}

/// Largest distance between a camera and its true place, both relative to the first camera, in metres.
fn worst_error_m(out: &SparseBatch, truth: &[Rigid]) -> f64 {
    let mut views: Vec<&SparseView> = out.views.iter().collect();
    views.sort_by_key(|view| view.keyframe_id);
    let first = views[0];
    let true_first = truth[first.keyframe_id as usize].inverse();
    let off = |view: &&SparseView| {
        let own = first.submap_from_cam.inverse() * view.submap_from_cam;
        let exact = true_first * truth[view.keyframe_id as usize];
        own.translation.distance(exact.translation)
    };
    views.iter().map(off).fold(0.0, f64::max)
}

/// All registered views as the scene has them at the end.
fn all(sfm: &Sfm) -> SparseBatch {
    SparseBatch {
        views: (0..sfm.scene.views.len())
            .filter_map(|ix| updates::view(&sfm.scene, ix))
            .collect(),
        ..SparseBatch::default()
    }
}

#[test]
fn measured_depth_gives_the_metre() {
    let mut world = cloud();
    let truth = arc(12, -25.0, 25.0);
    let (sfm, _) = run_measuring(&mut world, &truth, Some(camera()), sensor(1.0));
    let out = all(&sfm);
    assert_eq!(out.views.len(), 12);
    assert!(sfm.scene.submaps[0].is_metric);
    let worst = worst_error_m(&out, &truth);
    assert!(worst < 0.015, "{worst} m off on 4.4 m");
}

#[test]
fn a_camera_that_only_turns_is_registered_by_what_is_measured() {
    let turned = |i: i32| {
        let angle = f64::from(i) * 2.0_f64.to_radians();
        Rigid::new(DQuat::from_rotation_y(angle), DVec3::ZERO)
    };
    let truth: Vec<Rigid> = (0..12).map(turned).collect();
    let (_, alone) = run(&mut cloud(), &truth, Some(camera()));
    assert!(alone.note.unwrap().starts_with(NO_PARALLAX));
    let (sfm, _) = run_measuring(&mut cloud(), &truth, Some(camera()), sensor(1.0));
    let out = all(&sfm);
    assert_eq!(out.views.len(), 12);
    let worst = worst_error_m(&out, &truth);
    assert!(worst < 0.02, "{worst} m off without having moved");
}

#[test]
fn a_sensor_that_starts_to_be_wrong_is_left_out_and_taken_back() {
    let truth = arc(18, -35.0, 35.0);
    let (mut right, mut wrong) = (sensor(1.0), sensor(1.2));
    let measure = |id: usize, depths: &[f64]| {
        if (6..12).contains(&id) {
            wrong(id, depths)
        } else {
            right(id, depths)
        }
    };
    let (sfm, _) = run_measuring(&mut cloud(), &truth, Some(camera()), measure);
    let out = all(&sfm);
    assert_eq!(out.views.len(), 18);
    assert_eq!(sfm.scene.n_wrong_depths, 6);
    let is_believed = |id: usize| sfm.scene.views[id].measured.is_some();
    let believed: Vec<usize> = (0..18).filter(|id| is_believed(*id)).collect();
    assert_eq!(believed, [0, 1, 2, 3, 4, 5, 12, 13, 14, 15, 16, 17]);
    let worst = worst_error_m(&out, &truth);
    assert!(worst < 0.02, "{worst} m");
}

#[test]
fn a_submap_without_depth_gets_the_metre_when_depth_comes() {
    let truth = arc(18, -35.0, 35.0);
    let mut later = sensor(1.0);
    let measure = |id: usize, depths: &[f64]| later(id, depths).filter(|_| id >= 6);
    let (sfm, _) = run_measuring(&mut cloud(), &truth, Some(camera()), measure);
    let out = all(&sfm);
    assert_eq!(out.views.len(), 18);
    assert!(sfm.scene.submaps[0].is_metric);
    let worst = worst_error_m(&out, &truth);
    assert!(worst < 0.03, "{worst} m");
}
