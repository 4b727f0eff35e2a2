//! The embedded sequence makes the map that the node makes of the same frames, and says what happened on the way.

use splat_engine::cpu::engine::CpuEngine;
use splat_mapper::node::engines::Engines;
use splat_mapper::node::job::Job;
use splat_mapper::node::stop::Stop;
use splat_mapper::node::{open_source, pipeline};
use splat_mapper::params::params::Params;
use splat_mapper::params::settings::Settings;
use splat_slam::slam::{Finished, MapEvent, Slam, SlamEvent, SlamParams};
use splat_types::snapshot::Scale;
use splat_types::splats::layout::map_sha256;

use crate::ground_truth::known;

const INPUT: &str = "synthetic:room?frames=24&width=96&height=72&speed=3";
const N_FRAMES: u64 = 24;

fn params() -> Params {
    let mut settings = Settings::shipped();
    for setting in [
        "geometry=ground_truth",
        "backend=cpu",
        "deterministic=true",
        "sequential=true",
        "train.steps=80",
        "train.max_side=96",
        "train.seeds_per_keyframe=120",
        "select.batch_size=4",
        "select.batch_overlap=1",
        "map.holdout=5",
    ] {
        settings.merge_setting(setting).unwrap();
    }
    settings.params().unwrap()
}

/// Frames pushed one by one.
fn embedded(params: &Params) -> (Finished, Vec<SlamEvent>) {
    let mut source = open_source::open(INPUT, &params.source, params.seed).unwrap();
    let model = known(params.ground_truth.clone(), source.truth_extent());
    let parts = SlamParams {
        select: params.select.clone(),
        track: params.track.clone(),
        mapper: params.mapper(),
        seed: params.seed,
        n_frames: Some(N_FRAMES),
    };
    let engine = Box::new(CpuEngine::new());
    let mut slam = Slam::new(parts, Box::new(model), engine, Scale::GIVEN);
    let mut events = Vec::new();
    while let Some(frame) = source.next() {
        events.extend(slam.push(frame).unwrap());
    }
    let mut finished = slam.finish().unwrap();
    events.append(&mut finished.events);
    (finished, events)
}

#[test]
fn pushed_frames_make_the_map_of_the_node() {
    let params = params();
    let (mut finished, events) = embedded(&params);
    let job = Job {
        source: open_source::open(INPUT, &params.source, params.seed).unwrap(),
        params,
        is_live: false,
        stop: Stop::default(),
        out: None,
        output: None,
        engines: Engines::of(|_, _| Ok(Box::new(CpuEngine::new()))),
    };
    let node = pipeline::run(job, &mut |_| ()).unwrap();
    assert_eq!(node.error, None);
    let snapshot = finished.mapper.snapshot().unwrap();
    assert!(snapshot.splats.len() > 500, "{}", snapshot.splats.len());
    assert_eq!(
        map_sha256(&snapshot.splats),
        map_sha256(&node.snapshot.splats)
    );
    assert_eq!(snapshot.poses, node.snapshot.poses);

    let tracked = events.iter().filter_map(|event| match event {
        SlamEvent::Tracked(tracked) => Some(tracked.seq),
        _ => None,
    });
    assert!(tracked.eq(0..N_FRAMES), "every frame has an event");
    let keyframes = events.iter().filter_map(|event| match event {
        SlamEvent::Keyframe(id) => Some(*id),
        _ => None,
    });
    let registered = events.iter().filter_map(|event| match event {
        SlamEvent::Map(MapEvent::Registered(id)) => Some(*id),
        _ => None,
    });
    let keyframes: Vec<u32> = keyframes.collect();
    assert!(keyframes.len() >= 8, "{keyframes:?}");
    assert_eq!(registered.collect::<Vec<_>>(), keyframes);
    assert_eq!(finished.tracks.frames.len() as u64, N_FRAMES);
}
