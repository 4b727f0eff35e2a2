//! A long way through a corridor without end: memory stays within its budgets, and what left it comes back.

use std::sync::Arc;

use crate::gpu_runs::gpu_engine;
use splat_engine::cpu::engine::CpuEngine;
use splat_engine::traits::Engine;
use splat_geometry::ground_truth::model::GroundTruthModel;
use splat_geometry::model::GeometryModel;
use splat_io::frame_source::Source;
use splat_mapper::node::page_file::PageFile;
use splat_mapper::node::save_map::{MapFile, save_map};
use splat_mapper::params::settings::Settings;
use splat_slam::mapper::map_file::checkpoint;
use splat_slam::mapper::mapper::Mapper;
use splat_slam::mapper::params::{MapParams, MapperParams, McmcParams, TrainParams};
use splat_slam::mapper::train::schedule::End;
use splat_synth::endless::EndlessSource;
use splat_types::frame::{Batch, Keyframe};
use splat_types::snapshot::Scale;
use splat_types::time::Stopwatch;

const MAX_SPLATS: usize = 3000;
const MAX_KEYFRAMES: usize = 48;
const BATCH: usize = 10;
/// One keyframe every 10 cm; out for a hundred metres, and back.
const CORRIDOR: &str = "endless?frames=2000&turn=1000&width=64&height=48";
const STEPS_PER_BATCH: u64 = 20;

fn params() -> MapperParams {
    MapperParams {
        map: MapParams {
            max_splats: MAX_SPLATS,
            max_resident_keyframes: MAX_KEYFRAMES,
            holdout: 0,
            ..MapParams::default()
        },
        train: TrainParams {
            seeds_per_keyframe: 150,
            max_side: 64,
            ..TrainParams::default()
        },
        ..MapperParams::default()
    }
}

struct Walk {
    source: EndlessSource,
    model: GroundTruthModel,
    map: Mapper,
    next_id: u32,
    batch_id: u32,
}

/// A page file as the node makes it.
fn pages(params: &MapperParams) -> Box<PageFile> {
    Box::new(PageFile::new(None, params.map.max_page_file_mib << 20))
}

impl Walk {
    fn new(corridor: &str, params: MapperParams) -> Self {
        Self::on(Box::new(CpuEngine::new()), corridor, params)
    }

    fn on(engine: Box<dyn Engine>, corridor: &str, params: MapperParams) -> Self {
        let all = Settings::shipped().params().unwrap();
        let model =
            GroundTruthModel::new(all.ground_truth, (&all.sfm, &all.mvs), Some(1.0), 7).unwrap();
        let pages = pages(&params);
        Self {
            source: EndlessSource::open(corridor, &all.source).unwrap(),
            model,
            map: Mapper::new(params, 3, Scale::GIVEN, engine).paging_to(pages),
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
        self.map.add(Some(&batch), &geometry, None).unwrap();
        self.map.step(STEPS_PER_BATCH, End::Unknown).unwrap();
        true
    }

    fn quality(&mut self, ids: std::ops::Range<u32>) -> f64 {
        let n = ids.len() as f64;
        let of = |id| {
            let (shown, photo) = self.map.render_keyframe(id).unwrap().unwrap();
            shown.psnr(&photo)
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
    assert!(budgets.restored_splats > 0 && budgets.images_lost == 0);
    let after = walk.quality(20..40);
    eprintln!("{before:.2} dB before they left, {after:.2} dB when they were back");
    assert!(after > before - 1.0);

    // The file has what memory has not.
    let path = folder.path().join("map.splatmap");
    walk.map.snapshot().unwrap();
    let whole = walk.map.checkpoint(Vec::new());
    save_map(MapFile::Checkpoint(&whole), &path).unwrap();
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
    let map = Mapper::new(params(), 3, Scale::GIVEN, Box::new(CpuEngine::new()))
        .paging_to(pages(&params()));
    let map = map.resume_report(saved, &track).unwrap();
    let budgets = map.budgets();
    assert!(map.n_splats() <= MAX_SPLATS);
    assert_eq!(map.n_splats() as u64 + budgets.splats_on_disk, in_all);
    assert!(budgets.peak_keyframes_in_ram <= MAX_KEYFRAMES as u64);
}

#[test]
fn moves_of_splats_keep_to_the_cap_as_well() {
    let mut growing = params();
    growing.map.max_splats = 1000;
    growing.mcmc = McmcParams {
        enabled: true,
        start: 10,
        every: 10,
        growth: 1.5,
        ..McmcParams::default()
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
    let mut small = params();
    small.map.max_gpu_mib = 1;
    small.map.max_splats = 1_000_000;
    small.map.max_resident_keyframes = 0;
    small.train.seeds_per_keyframe = 400;
    let mut walk = Walk::new("endless?frames=200&width=64&height=48", small);
    while walk.go() {}
    let budgets = walk.map.budgets();
    eprintln!("{budgets:?}");
    assert!(budgets.peak_engine_mib <= 1.05, "{budgets:?}");
    assert!(budgets.growth_refused > 0, "{budgets:?}");
    assert!(budgets.peak_splats > 300, "{budgets:?}");
}

#[test]
fn on_a_gpu_splats_and_images_leave_and_come_back_as_well() {
    let mut small = params();
    small.map.max_gpu_mib = 16;
    small.map.max_splats = 500;
    small.map.max_resident_keyframes = 12;
    small.train.seeds_per_keyframe = 60;
    small.train.max_side = 48;
    let corridor = "endless?frames=400&turn=200&width=48&height=36";
    let mut walk = Walk::on(Box::new(gpu_engine()), corridor, small);
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
    assert!(budgets.peak_engine_mib <= 16.0 * 1.05, "{budgets:?}");
    assert!(
        budgets.evicted_splats > 0 && budgets.restored_splats > 0,
        "{budgets:?}"
    );
    assert!(budgets.peak_keyframes_in_ram <= 12, "{budgets:?}");
    assert!(after > before - 1.0);
}
