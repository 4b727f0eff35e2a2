//! Odometry of wheels in structure from motion: parts that share no view, and wheels that slip.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::sfm_corridor::{position_error, submaps};
use crate::sfm_live::keyframes_of;
use splat_types::frame::Keyframe;
use splat_types::transform::Rigid;

/// Four corridors that have benches, plants, doors and fire extinguishers of one make. In the middle the light is out.
const GAP: &str = "synthetic:corridor?frames=120&width=320&height=240&speed=0.8&blackout=2.5&odometry=0.01&noise=2";
/// The same with light, and wheels that slip for two seconds.
const SLIP: &str =
    "synthetic:corridor?frames=100&width=320&height=240&speed=0.8&odometry=0.01&slip=0.3&noise=2";
/// Frames from one keyframe to the next.
const EVERY: usize = 2;

fn truth(keyframes: &[Arc<Keyframe>], id: u32) -> Rigid {
    keyframes[id as usize].frame.truth.unwrap()
}

fn pairs(keyframes: &[Arc<Keyframe>], poses: &BTreeMap<u32, Rigid>) -> Vec<(Rigid, Rigid)> {
    let pair = |(id, pose): (&u32, &Rigid)| (truth(keyframes, *id), *pose);
    poses.iter().map(pair).collect()
}

fn way(keyframes: &[Arc<Keyframe>]) -> f64 {
    let places = keyframes.iter().map(|k| k.frame.truth.unwrap().translation);
    let places: Vec<_> = places.collect();
    places.windows(2).map(|two| two[0].distance(two[1])).sum()
}

fn extent(keyframes: &[Arc<Keyframe>]) -> f64 {
    let places = keyframes.iter().map(|k| k.frame.truth.unwrap().translation);
    splat_types::transform::extent(&places.collect::<Vec<_>>())
}

fn without_odometry(keyframes: &[Arc<Keyframe>]) -> Vec<Arc<Keyframe>> {
    let without = |keyframe: &Arc<Keyframe>| {
        let mut keyframe = Keyframe::clone(keyframe);
        keyframe.frame.odometry = None;
        Arc::new(keyframe)
    };
    keyframes.iter().map(without).collect()
}

#[test]
fn parts_that_share_no_view_are_joined_by_odometry_and_not_by_things_of_one_make() {
    let keyframes = keyframes_of(GAP, EVERY);
    let apart = submaps(&without_odometry(&keyframes));
    for (submap, poses) in &apart {
        let error = position_error(&pairs(&keyframes, poses));
        eprintln!(
            "without odometry: submap {submap}, {} keyframes, {error:.4}",
            poses.len()
        );
        assert!(error < 0.02, "submap {submap} is {error} off");
    }
    assert!(
        apart.len() >= 2,
        "what is seen in two corridors is no one place"
    );
    let joined = submaps(&keyframes);
    let largest = joined.values().max_by_key(|poses| poses.len()).unwrap();
    let n_light = apart.values().map(BTreeMap::len).sum::<usize>();
    assert!(largest.len() >= n_light, "{} of {n_light}", largest.len());
    let off = position_error(&pairs(&keyframes, largest)) * extent(&keyframes);
    eprintln!("joined: {off:.3} m of {:.1} m", way(&keyframes));
    assert!(off < 0.03 * way(&keyframes), "{off} m");
}

#[test]
fn wheels_that_slip_do_not_move_the_map() {
    let keyframes = keyframes_of(SLIP, EVERY);
    let error = |keyframes: &[Arc<Keyframe>]| {
        let submaps = submaps(keyframes);
        let largest = submaps.values().max_by_key(|poses| poses.len()).unwrap();
        assert_eq!(largest.len(), keyframes.len());
        position_error(&pairs(keyframes, largest))
    };
    let (with, without) = (error(&keyframes), error(&without_odometry(&keyframes)));
    eprintln!("slip: {with:.4} with odometry, {without:.4} without");
    assert!(with < 0.02, "{with}");
}

/// What becomes of odometry after the middle of the recording, by the number of the keyframe and what it was.
type Fault = fn(usize, &[Rigid]) -> Option<Rigid>;

const FAULTS: [(&str, Fault); 4] = [
    ("unplugged", |_, _| None),
    ("frozen", |ix, track| Some(track[ix.min(track.len() / 2)])),
    ("20 % too long", |ix, track| {
        let from = track.len() / 2;
        let base = track[from.min(ix)];
        let mut step = base.inverse() * track[ix];
        step.translation *= 1.2;
        Some(base * step)
    }),
    // Two keyframes are 0.2 s apart.
    ("0.1 s late", |ix, track| {
        let step = track[ix - 1].inverse() * track[ix];
        let late = Rigid::new(
            glam::DQuat::IDENTITY.slerp(step.rotation, 0.5),
            step.translation * 0.5,
        );
        Some(track[ix - 1] * late)
    }),
];

#[test]
fn odometry_that_fails_in_the_middle_does_not_move_the_map() {
    let keyframes = keyframes_of(SLIP, EVERY);
    let track: Vec<Rigid> = keyframes
        .iter()
        .map(|k| k.frame.odometry.unwrap())
        .collect();
    for (name, fault) in FAULTS {
        let faulty: Vec<Arc<Keyframe>> = (0..)
            .zip(&keyframes)
            .map(|(ix, keyframe)| {
                let mut keyframe = Keyframe::clone(keyframe);
                if 2 * ix > track.len() {
                    keyframe.frame.odometry = fault(ix, &track);
                }
                Arc::new(keyframe)
            })
            .collect();
        let submaps = submaps(&faulty);
        let largest = submaps.values().max_by_key(|poses| poses.len()).unwrap();
        assert_eq!(largest.len(), keyframes.len(), "{name}");
        let error = position_error(&pairs(&keyframes, largest));
        eprintln!("{name}: {error:.4}");
        assert!(error < 0.02, "{name}: {error}");
    }
}
