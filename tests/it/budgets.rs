//! A long way through a corridor without end: memory stays within its budgets, and what left it comes back.

use std::sync::Arc;

use splat_mapper::clock::Stopwatch;
use splat_mapper::config::{MapParams, Settings};
use splat_mapper::eval::image_metrics::psnr;
use splat_mapper::frame::{Batch, Keyframe};
use splat_mapper::geometry::GeometryModel;
use splat_mapper::geometry::known::Known;
use splat_mapper::map::SplatMap;
use splat_mapper::map::checkpoint;
use splat_mapper::map::schedule::Phase;
use splat_mapper::map::snapshot::Scale;
use splat_mapper::source::Source;
use splat_mapper::source::synthetic::endless::EndlessSource;
use splat_mapper::splat::Engine;
use splat_mapper::splat::cpu::CpuEngine;

use crate::gpu_runs::gpu_engine;

const MAX_SPLATS: usize = 3000;
const MAX_KEYFRAMES: usize = 48;
const BATCH: usize = 10;
/// One keyframe every 10 cm; out for a hundred metres, and back.
const CORRIDOR: &str = "endless?frames=2000&turn=1000&width=64&height=48";
const STEPS_PER_BATCH: u64 = 20;

fn params() -> MapParams {
    MapParams {
        max_splats: MAX_SPLATS,
        max_keyframes_in_ram: MAX_KEYFRAMES,
        seeds_per_keyframe: 150,
        holdout: 0,
        max_side: 64,
        ..Settings::shipped().params().unwrap().map
    }
}

struct Walk {
    source: EndlessSource,
    model: Known,
    map: SplatMap,
    next_id: u32,
    batch_id: u32,
}

impl Walk {
    fn new(corridor: &str, params: MapParams) -> Self {
        Self::on(Box::new(CpuEngine::new()), corridor, params)
    }

    fn on(engine: Box<dyn Engine>, corridor: &str, params: MapParams) -> Self {
        let all = Settings::shipped().params().unwrap();
        let model = Known::new(all.known, (&all.sfm, &all.mvs), Some(1.0), 7).unwrap();
        Self {
            source: EndlessSource::open(corridor).unwrap(),
            model,
            map: SplatMap::new(params, 3, Scale::GIVEN, engine),
            next_id: 0,
            batch_id: 0,
        }
    }

    /// One batch more; `false` at the end.
    fn go(&mut self) -> bool {
        let first = self.next_id;
        let frames: Vec<_> = std::iter::from_fn(|| self.source.next())
            .take(BATCH)
            .collect();
        if frames.is_empty() {
            return false;
        }
        let keyframes: Vec<Arc<Keyframe>> = (first..)
            .zip(frames)
            .map(|(id, frame)| {
                Arc::new(Keyframe {
                    id,
                    frame,
                    age: Stopwatch::start(),
                })
            })
            .collect();
        self.next_id += keyframes.len() as u32;
        let batch = Batch {
            id: self.batch_id,
            n_shared: 0,
            keyframes,
        };
        self.batch_id += 1;
        let geometry = self.model.infer(&batch).unwrap();
        self.map.add(Some(&batch), geometry, None);
        self.map.step(STEPS_PER_BATCH, Phase::Streaming);
        true
    }

    fn quality(&mut self, ids: std::ops::Range<u32>) -> f64 {
        let n = ids.len() as f64;
        let of = |id| {
            let (shown, photo) = self.map.render_keyframe(id).unwrap();
            psnr(&shown.rgb, &photo)
        };
        ids.map(of).sum::<f64>() / n
    }
}

#[test]
fn two_thousand_keyframes_stay_within_their_budgets_and_come_back() {
    let folder = tempfile::tempdir().unwrap();
    let mut walk = Walk::new(CORRIDOR, params());
    let mut before = 0.0;
    let mut most = 0;
    while walk.go() {
        assert!(walk.map.n_splats() <= MAX_SPLATS, "{}", walk.map.n_splats());
        most = most.max(walk.map.n_splats());
        if walk.next_id == 80 {
            before = walk.quality(20..40);
        }
        if walk.next_id == 1000 {
            let budgets = walk.map.budgets();
            assert!(budgets.evicted_splats > 1000, "{budgets:?}");
            assert!(budgets.keyframes_on_disk > 900, "{budgets:?}");
            let shown: Vec<u32> = walk.map.keyframe_ids().into_iter().map(|k| k.0).collect();
            assert!(!shown.contains(&30), "what it shows is on disk");
        }
    }
    let budgets = walk.map.budgets();
    eprintln!("{budgets:?}");
    assert!(budgets.peak_splats <= MAX_SPLATS as u64 && most > MAX_SPLATS / 2);
    assert!(budgets.peak_keyframes_in_ram <= MAX_KEYFRAMES as u64);
    assert!(budgets.restored_splats > 0 && budgets.pictures_lost == 0);
    let after = walk.quality(20..40);
    eprintln!("{before:.2} dB before they left, {after:.2} dB when they were back");
    assert!(after > before - 1.0);

    // The file has what memory has not.
    let path = folder.path().join("map.splatmap");
    walk.map.save(Vec::new(), &path).unwrap();
    let back = checkpoint::read(&path).unwrap();
    let in_all = walk.map.n_splats() as u64 + budgets.splats_on_disk;
    assert_eq!(back.snapshot.splats.len() as u64, in_all);
    assert!(in_all > 2 * MAX_SPLATS as u64, "{in_all}");
    assert_eq!(back.snapshot.poses.len(), 2000);
    check_load(back);
}

/// A saved map that is larger than the budget is held within it, too, and nothing of it is lost.
fn check_load(saved: checkpoint::Checkpoint) {
    let in_all = saved.snapshot.splats.len() as u64;
    let track = Settings::shipped().params().unwrap().track;
    let map = SplatMap::new(params(), 3, Scale::GIVEN, Box::new(CpuEngine::new()));
    let map = map.continued(saved, &track).unwrap();
    let budgets = map.budgets();
    assert!(map.n_splats() <= MAX_SPLATS);
    assert_eq!(map.n_splats() as u64 + budgets.splats_on_disk, in_all);
    assert!(budgets.peak_keyframes_in_ram <= MAX_KEYFRAMES as u64);
}

#[test]
fn moves_of_splats_keep_to_the_cap_as_well() {
    let growing = MapParams {
        mcmc: true,
        mcmc_start: 10,
        mcmc_every: 10,
        growth: 1.5,
        max_splats: 1000,
        ..params()
    };
    let mut walk = Walk::new("endless?frames=300&width=48&height=36", growing);
    while walk.go() {
        assert!(walk.map.n_splats() <= 1000);
    }
    let budgets = walk.map.budgets();
    assert!(
        budgets.peak_splats <= 1000 && budgets.evicted_splats > 0,
        "{budgets:?}"
    );
}

#[test]
fn the_engine_stays_within_its_bytes() {
    let small = MapParams {
        max_gpu_mib: 1,
        max_splats: 1_000_000,
        seeds_per_keyframe: 400,
        max_keyframes_in_ram: 0,
        ..params()
    };
    let mut walk = Walk::new("endless?frames=200&width=64&height=48", small);
    while walk.go() {}
    let budgets = walk.map.budgets();
    eprintln!("{budgets:?}");
    assert!(budgets.peak_engine_mib <= 1.05, "{budgets:?}");
    assert!(budgets.growth_refused > 0, "{budgets:?}");
    assert!(budgets.peak_splats > 300, "{budgets:?}");
}

#[test]
fn on_a_gpu_splats_and_pictures_leave_and_come_back_as_well() {
    let small = MapParams {
        max_gpu_mib: 16,
        max_splats: 500,
        seeds_per_keyframe: 60,
        max_keyframes_in_ram: 12,
        max_side: 48,
        ..params()
    };
    let corridor = "endless?frames=400&turn=200&width=48&height=36";
    let mut walk = Walk::on(Box::new(gpu_engine(true)), corridor, small);
    let mut before = 0.0;
    while walk.go() {
        assert!(walk.map.n_splats() <= 500);
        if walk.next_id == 30 {
            before = walk.quality(5..15);
        }
    }
    let budgets = walk.map.budgets();
    let after = walk.quality(5..15);
    eprintln!("{budgets:?}; {before:.2} dB, then {after:.2} dB");
    assert_eq!(walk.map.fault(), None);
    assert!(budgets.peak_engine_mib <= 16.0 * 1.05, "{budgets:?}");
    assert!(
        budgets.evicted_splats > 0 && budgets.restored_splats > 0,
        "{budgets:?}"
    );
    assert!(budgets.peak_keyframes_in_ram <= 12, "{budgets:?}");
    assert!(after > before - 1.0);
}
