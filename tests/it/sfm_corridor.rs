//! Structure from motion in a corridor: most of each image lies on one wall, and has little texture.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::sfm_live::keyframes_of;
use splat_geometry::sfm::estimator::Sfm;
use splat_geometry::similarity;
use splat_mapper::params::settings::Settings;
use splat_types::frame::{Batch, Keyframe};
use splat_types::transform::{Rigid, extent};

const SCENE: &str = "synthetic:endless?frames=400&rate=30&width=320&height=240";
/// Frames from one keyframe to the next.
const EVERY: usize = 4;

/// Poses of the keyframes of each submap at the end.
pub(crate) fn submaps(keyframes: &[Arc<Keyframe>]) -> BTreeMap<u32, BTreeMap<u32, Rigid>> {
    let params = Settings::shipped().params().unwrap();
    let mut model = Sfm::new(&params.sfm, &params.mvs, 1).unwrap();
    let mut found = BTreeMap::new();
    let mut reports = Vec::new();
    for (id, new) in keyframes.chunks(5).enumerate() {
        reports.push(model.sparse(&Batch {
            id: id as u32,
            n_shared: 0,
            keyframes: new.to_vec(),
        }));
    }
    reports.push(model.finish_sparse());
    for report in reports {
        let views = report.views.iter();
        let views = views.map(|v| (v.keyframe_id, (v.submap, v.submap_from_cam)));
        let revised = report.revised.iter();
        let revised = revised.map(|r| (r.keyframe_id, (r.submap, r.submap_from_cam)));
        found.extend(views.chain(revised));
    }
    let mut submaps: BTreeMap<u32, BTreeMap<u32, Rigid>> = BTreeMap::new();
    for (id, (submap, pose)) in found {
        submaps.entry(submap).or_default().insert(id, pose);
    }
    submaps
}

/// RMSE after the best similarity, as a share of the way's extent; of (true, found).
pub(crate) fn position_error(pairs: &[(Rigid, Rigid)]) -> f64 {
    let places: Vec<_> = pairs
        .iter()
        .map(|(t, o)| (t.translation, o.translation))
        .collect();
    let fit = similarity::of_points(&places).unwrap();
    let off = |(t, o): &(_, _)| fit.transform_point(*o).distance_squared(*t);
    let rmse = (places.iter().map(off).sum::<f64>() / places.len() as f64).sqrt();
    rmse / extent(&places.iter().map(|p| p.0).collect::<Vec<_>>())
}

/// By how much a keyframe looks, or lies, in another direction from the first one at most. A straight way fits any other:
/// this shows the wrong one of a wall's two motions.
fn turned_deg(pairs: &[(Rigid, Rigid)]) -> f64 {
    let (truth, found) = pairs[0];
    let turned = pairs[1..].iter().map(|(t, o)| {
        let (t, o) = (truth.inverse() * *t, found.inverse() * *o);
        let looks = t.angle_to(&o);
        looks.max(t.translation.angle_between(o.translation))
    });
    turned.fold(0.0, f64::max).to_degrees()
}

#[test]
fn a_wall_is_seen_from_where_the_camera_was_and_few_features_suffice() {
    let keyframes = keyframes_of(SCENE, EVERY);
    let submaps = submaps(&keyframes);
    for (submap, poses) in &submaps {
        let truth = |id: &u32| keyframes[*id as usize].frame.truth.unwrap();
        let pairs: Vec<(Rigid, Rigid)> =
            poses.iter().map(|(id, pose)| (truth(id), *pose)).collect();
        let (rmse, turned) = (position_error(&pairs), turned_deg(&pairs));
        let n = poses.len();
        eprintln!(
            "submap {submap}: {n} keyframes, ATE {rmse:.4}, directions off by {turned:.2} deg"
        );
        assert!(
            rmse < 0.01 && turned < 2.0,
            "submap {submap}: {rmse}, {turned} deg"
        );
    }
    let largest = submaps.values().map(BTreeMap::len).max().unwrap();
    assert!(
        4 * largest >= 3 * keyframes.len(),
        "{largest} of {}",
        keyframes.len()
    );
}

/// Two rooms by a hand that shakes, 15 frames a second: blurred by up to 20 px, noisy, the first keyframes before a wall of prints.
/// One of the two motions of that wall, 11 degrees wrong, explains more matches than the right one.
const BLURRED: &str =
    "synthetic:house?frames=70&width=400&height=300&rate=15&shake=3&blur=0.8&noise=4";

#[test]
fn blurred_images_before_a_wall_start_no_wrong_submap() {
    let keyframes = keyframes_of(BLURRED, 2);
    let submaps = submaps(&keyframes);
    let mut n_registered = 0;
    for (submap, poses) in &submaps {
        let truth = |id: &u32| keyframes[*id as usize].frame.truth.unwrap();
        let pairs: Vec<(Rigid, Rigid)> =
            poses.iter().map(|(id, pose)| (truth(id), *pose)).collect();
        let rmse = position_error(&pairs);
        let (first, n) = (pairs[0], poses.len());
        let turns = pairs.iter().map(|(t, o)| {
            let (t, o) = (first.0.inverse() * *t, first.1.inverse() * *o);
            t.angle_to(&o).to_degrees()
        });
        let turned = turns.fold(0.0, f64::max);
        eprintln!("submap {submap}: {n} keyframes, ATE {rmse:.4}, turned by {turned:.2} deg");
        n_registered += n;
        // Less than a hand's breadth of way is no measure of anything.
        if n >= 5 {
            assert!(rmse < 0.02, "submap {submap}: {rmse}");
        }
        assert!(turned < 5.0, "submap {submap}: {turned} deg");
    }
    let share = n_registered as f64 / keyframes.len() as f64;
    assert!(share >= 0.6, "{n_registered} of {}", keyframes.len());
}
