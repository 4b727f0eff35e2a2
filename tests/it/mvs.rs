//! Dense depth by structure from motion and stereo: how much is kept, and how far off it is.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};

use crate::hard_images::{hall, stroll};
use crate::hard_world::{Flaws, LENS, Paint, depth, film};
use crate::scenes::scene;
use crate::sfm::{Shown, keyframe, params, shown};
use splat_geometry::answer::View;
use splat_geometry::model::GeometryModel;
use splat_geometry::sfm::estimator::Sfm;
use splat_synth::settings::{SceneKind, SynthSettings};
use splat_synth::take::Take;
use splat_types::frame::{Batch, Keyframe};
use splat_types::transform::Rigid;

/// What the model has said of each keyframe at the end, and where keyframes saw which landmark.
struct Given {
    views: BTreeMap<u32, View>,
    observations: BTreeMap<u32, Vec<(u32, DVec2)>>,
}

fn reported(shown: &Shown, changes: &[&str]) -> Given {
    let params = params(changes);
    let mut sfm = Sfm::new(&params.sfm, &params.mvs, 1).unwrap();
    let mut reported = Given {
        views: BTreeMap::new(),
        observations: BTreeMap::new(),
    };
    let mut take = |batch: splat_geometry::answer::GeometryBatch| {
        for view in batch.views {
            reported.views.insert(view.keyframe_id, view);
        }
        for revision in batch.revised {
            let Some(view) = reported.views.get_mut(&revision.keyframe_id) else {
                continue;
            };
            view.submap_from_cam = revision.submap_from_cam;
            view.intrinsics = revision.intrinsics;
        }
        for seen in batch.observations {
            let landmarks = seen.landmarks.iter();
            let landmarks = landmarks
                .map(|seen| (seen.id, DVec2::from(seen.pixel.map(f64::from))))
                .collect();
            reported.observations.insert(seen.keyframe_id, landmarks);
        }
    };
    for (id, keyframes) in batches(&shown.keyframes, 8, 3).into_iter().enumerate() {
        let batch = Batch {
            id: id as u32,
            n_shared: if id == 0 { 0 } else { 3 },
            keyframes,
        };
        take(sfm.infer(&batch).unwrap());
    }
    take(sfm.finish().unwrap());
    reported
}

fn batches(keyframes: &[Arc<Keyframe>], size: usize, shared: usize) -> Vec<Vec<Arc<Keyframe>>> {
    let starts = (0..keyframes.len().saturating_sub(shared)).step_by(size - shared);
    starts
        .map(|from| keyframes[from..(from + size).min(keyframes.len())].to_vec())
        .collect()
}

/// Errors of the kept pixels, relative, sorted; and the share of pixels kept. `truth` gives the exact depth of a
/// keyframe at a size.
fn against_truth(
    reported: &Given,
    shown: &Shown,
    truth: &dyn Fn(u32, [u32; 2]) -> Vec<f64>,
) -> (Vec<f64>, f64) {
    let scale = scale_of(reported, shown);
    let (mut errors, mut all) = (Vec::new(), 0);
    for (id, view) in &reported.views {
        let truth = truth(*id, [view.depth.width_px, view.depth.height_px]);
        all += truth.len();
        for (q, truth) in truth.into_iter().enumerate() {
            let found = view.depth.depth[q];
            if view.depth.confidence[q] > 0.0 {
                errors.push((f64::from(found) * scale / truth - 1.0).abs());
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    let kept = errors.len() as f64 / f64::from(all as u32);
    (errors, kept)
}

/// Metres per unit: mean distance of the cameras from their mean, true and found.
fn scale_of(reported: &Given, shown: &Shown) -> f64 {
    let spread = |places: Vec<DVec3>| {
        let mean = places.iter().sum::<DVec3>() / places.len() as f64;
        places.iter().map(|p| p.distance(mean)).sum::<f64>()
    };
    let truth = reported.views.keys().map(|id| shown.truth[*id as usize]);
    let found = reported.views.values().map(|view| view.submap_from_cam);
    spread(truth.map(|p| p.translation).collect()) / spread(found.map(|p| p.translation).collect())
}

/// Errors of the depth maps at the landmarks, which are triangulated here from where they were seen.
fn against_landmarks(reported: &Given) -> Vec<f64> {
    let mut seen: BTreeMap<u32, Vec<(u32, DVec2)>> = BTreeMap::new();
    for (id, landmarks) in &reported.observations {
        for (landmark, pixel) in landmarks {
            seen.entry(*landmark).or_default().push((*id, *pixel));
        }
    }
    let mut errors = Vec::new();
    for observations in seen.values().filter(|observations| observations.len() >= 3) {
        let rays: Vec<(DVec3, DVec3)> = observations
            .iter()
            .map(|(id, pixel)| {
                let view = &reported.views[id];
                let direction = view.submap_from_cam.rotation * view.intrinsics.ray_in_cam(*pixel);
                (view.submap_from_cam.translation, direction.normalize())
            })
            .collect();
        let Some(point) = nearest_point(&rays) else {
            continue;
        };
        for (id, pixel) in observations {
            let view = &reported.views[id];
            let own = view.submap_from_cam.inverse().transform_point(point).z;
            let (w, h) = (view.depth.width_px, view.depth.height_px);
            let x = (pixel.x / f64::from(view.intrinsics.width_px) * f64::from(w)) as u32;
            let y = (pixel.y / f64::from(view.intrinsics.height_px) * f64::from(h)) as u32;
            let q = (y.min(h - 1) * w + x.min(w - 1)) as usize;
            if view.depth.confidence[q] > 0.0 {
                errors.push((f64::from(view.depth.depth[q]) / own - 1.0).abs());
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    errors
}

/// The point nearest to all rays; `None` where they are almost parallel or pass it far off.
fn nearest_point(rays: &[(DVec3, DVec3)]) -> Option<DVec3> {
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for (from, along) in rays {
        let across = DMat3::IDENTITY
            - DMat3::from_cols(*along * along.x, *along * along.y, *along * along.z);
        a += across;
        b += across * *from;
    }
    let point = a.inverse() * b;
    let widest = rays
        .iter()
        .map(|r| r.1.angle_between(rays[0].1).to_degrees())
        .fold(0.0, f64::max);
    let passes = |(from, along): &(DVec3, DVec3)| (point - *from).angle_between(*along) < 0.004;
    (point.is_finite() && widest >= 3.0 && rays.iter().all(passes)).then_some(point)
}

fn quantile(sorted: &[f64], share: f64) -> f64 {
    sorted[(share * (sorted.len() - 1) as f64) as usize]
}

/// Median error at most 0.5 %; at least `least` of the pixels kept, at most `far_off` of those off by more than 5 %.
#[track_caller]
fn holds(name: &str, (errors, kept): (Vec<f64>, f64), [least, far_off]: [f64; 2]) {
    let beyond = errors.iter().filter(|e| **e > 0.05).count() as f64 / errors.len() as f64;
    let median = quantile(&errors, 0.5);
    eprintln!("{name}: kept {kept:.3}, median {median:.5}, beyond 5 %: {beyond:.4}");
    assert!(
        kept >= least && median <= 0.005 && beyond <= far_off,
        "{name}: {kept} kept, median {median}, {beyond} beyond 5 %"
    );
}

#[test]
fn a_hall_is_measured_to_half_a_percent() {
    let shown = film(&hall(Paint::Varied), &stroll(), Flaws::default(), LENS);
    let reported = reported(&shown, &["sfm.max_side=400", "sfm.max_features=1000"]);
    let truth = |id: u32, [w, h]: [u32; 2]| {
        depth(
            &hall(Paint::Varied),
            &shown.truth[id as usize],
            &LENS.resized(w, h),
        )
    };
    holds(
        "hall",
        against_truth(&reported, &shown, &truth),
        [0.75, 0.02],
    );
}

#[test]
fn synthetic_scenes_are_measured_to_half_a_percent() {
    for (scene, bounds) in [
        (SceneKind::Facade, [0.8, 0.01]),
        (SceneKind::Room, [0.7, 0.02]),
    ] {
        let settings = SynthSettings {
            width_px: 480,
            height_px: 360,
            n_frames: 60,
            noise: 1.0,
            ..SynthSettings::of(scene)
        };
        let take = Take::new(settings).unwrap();
        let lens = take.settings().lens().intrinsics;
        let ids: Vec<u32> = (0..12).map(|i| 3 * i).collect();
        let keyframes = ids.iter().enumerate().map(|(id, ix)| {
            let rgb_image = take.image(*ix);
            let image = image::RgbImage::from_raw(480, 360, rgb_image.pixels).unwrap();
            keyframe(id as u32, f64::from(*ix), &image, 480, &lens, true)
        });
        let shown = Shown {
            keyframes: keyframes.collect(),
            truth: ids.iter().map(|ix| take.pose(*ix)).collect(),
        };
        let reported = reported(&shown, &["sfm.max_side=480", "sfm.max_features=1000"]);
        assert!(
            reported.views.len() >= 11,
            "{scene:?}: {} registered",
            reported.views.len()
        );
        let truth = |id: u32, [w, h]: [u32; 2]| {
            let depth = take.depth(ids[id as usize], &lens.resized(w, h)).depth;
            depth.into_iter().map(f64::from).collect()
        };
        holds(
            &format!("{scene:?}"),
            against_truth(&reported, &shown, &truth),
            bounds,
        );
    }
}

#[test]
fn three_quarters_of_the_fox_are_kept_and_fit_its_landmarks() {
    let Some(folder) = scene("fox") else { return };
    let shown = shown(&folder, 640, 1, true);
    let reported = reported(&shown, &[]);
    let errors = against_landmarks(&reported);
    let (kept, all) = reported.views.values().fold((0, 0), |(kept, all), view| {
        let n = view.depth.confidence.iter().filter(|c| **c > 0.0).count();
        (kept + n, all + view.depth.confidence.len())
    });
    let kept = kept as f64 / f64::from(all as u32);
    let median = quantile(&errors, 0.5);
    eprintln!(
        "fox: kept {kept:.3}, median {median:.5} of {} observations",
        errors.len()
    );
    assert!(
        errors.len() > 5000 && kept >= 0.75 && median <= 0.005,
        "{kept} {median}"
    );
}

#[test]
fn depth_is_where_the_surface_is_and_not_behind_the_camera() {
    // The truth itself, so that the tests above measure what they say.
    let pose = Rigid::IDENTITY;
    let truth = depth(&hall(Paint::Varied), &pose, &LENS);
    let centre = truth[(150 * 400 + 200) as usize];
    assert!((centre - 7.0).abs() < 1e-9, "{centre}");
}
