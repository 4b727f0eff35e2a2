//! A GPU that is lost while a map is made: at every call of the engine, and for real.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use crate::gpu_runs::gpu_engine;
use crate::hooked::{Hooked, Hooks};
use splat_engine::cpu::engine::CpuEngine;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_engine::wgpu::engine::WgpuEngine;
use splat_mapper::node::engines::{Engines, Kind};
use splat_mapper::node::job::{Job, Outcome};
use splat_mapper::node::save_map::{MapFile, SaveError, save_map};
use splat_mapper::node::stop::Stop;
use splat_mapper::node::{open_source, pipeline, run_dir};
use splat_mapper::params::params::Params;
use splat_mapper::params::settings::Settings;
use splat_slam::mapper::map_file::checkpoint::{self, Checkpoint};
use splat_types::snapshot::Snapshot;
use splat_types::splats::splats::Splats;
use splat_types::time::Stopwatch;

/// Of `settings`.
const N_STEPS: u64 = 120;
const INPUT: &str = "synthetic:room?frames=12&width=64&height=48&speed=5";
/// Longer than mapping may stand still for a lost device.
const MAX_STANDSTILL_SECS: f64 = 5.0;

/// Where a device is lost: at its call number `n`, or at the `n`-th call of one kind. Autosave and snapshots go by the
/// clock, so that only the latter names the same call in every run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum LostAt {
    Call(u64),
    CallOf(&'static str, u64),
}

/// A device that is lost at a call, and stays lost.
#[derive(Debug)]
struct Lost {
    lost_at: LostAt,
    /// Calls that count so far.
    n_calls: AtomicU64,
    /// The call that met the loss.
    met: Arc<Mutex<Option<&'static str>>>,
}

impl Hooks for Lost {
    fn before(&self, _: &CpuEngine, call: &'static str) -> Result<(), EngineError> {
        let (counts, lost_at) = match self.lost_at {
            LostAt::Call(n) => (true, n),
            LostAt::CallOf(kind, n) => (kind == call, n),
        };
        let n = self.n_calls.fetch_add(counts.into(), Ordering::Relaxed) + u64::from(counts);
        if n <= lost_at {
            return Ok(());
        }
        self.met.lock().unwrap().get_or_insert(call);
        Err(EngineError::DeviceLost {
            adapter: "faulty".to_owned(),
            reason: format!("unplugged at {:?}", self.lost_at),
        })
    }
}

type Met = Arc<Mutex<Option<&'static str>>>;

/// The first engine is lost at a call, the others are not.
fn engines_losing(lost_at: LostAt) -> (Engines, Met) {
    let met = Met::default();
    let first = Mutex::new(Some(Lost {
        lost_at,
        n_calls: AtomicU64::new(0),
        met: Arc::clone(&met),
    }));
    let engines = Engines::of(move |_, _| {
        let engine: Box<dyn Engine> = match first.lock().unwrap().take() {
            Some(hooks) => Box::new(Hooked {
                inner: CpuEngine::new(),
                hooks,
            }),
            None => Box::new(CpuEngine::new()),
        };
        Ok(engine)
    });
    (engines, met)
}

fn settings(sets: &[&str]) -> Settings {
    let mut settings = Settings::shipped();
    let usual = [
        "geometry=known",
        "backend=wgpu",
        "sequential=true",
        "deterministic=false",
        "map.steps=120",
        "select.all=true",
        "map.max_side=64",
        "map.seeds_per_keyframe=60",
        "map.max_keyframes_in_ram=8",
        "map.pose=shared",
        "map.transient=0.9",
        "map.epipolar_weight=0.001",
        "map.mcmc=true",
        "map.mcmc_start=20",
        "map.mcmc_every=20",
        "map.autosave_secs=0.01",
        "map.snapshot_secs=0.05",
        "select.batch_size=3",
        "select.batch_overlap=1",
    ];
    for setting in usual.iter().chain(sets) {
        settings.merge_setting(setting).unwrap();
    }
    settings
}

fn job(params: Params, engines: Engines, out: &Path) -> Job {
    Job {
        source: open_source::open(INPUT, &params.source, params.seed).unwrap(),
        params,
        is_live: false,
        stop: Stop::default(),
        out: Some(out.to_owned()),
        output: None,
        engines,
    }
}

/// Maps into `out` and finishes the run directory.
fn run(settings: &Settings, engines: Engines, out: &Path) -> Outcome {
    let job = job(settings.params().unwrap(), engines, out);
    let mut outcome = pipeline::run(job, &mut |_| ()).unwrap();
    run_dir::finish(
        &mut outcome,
        settings,
        None,
        (Some(out), INPUT),
        &mut |_| {},
    )
    .unwrap();
    outcome
}

fn read_back(path: &Path) -> Checkpoint {
    checkpoint::read(path).unwrap_or_else(|error| panic!("the map file is whole: {error}"))
}

/// Writes down every call.
#[derive(Debug, Default)]
struct Counted(Arc<Mutex<Vec<&'static str>>>);

impl Hooks for Counted {
    fn before(&self, _: &CpuEngine, call: &'static str) -> Result<(), EngineError> {
        self.0.lock().unwrap().push(call);
        Ok(())
    }
}

/// The calls of a run without a fault.
fn calls_of(settings: &Settings, out: &Path) -> Vec<&'static str> {
    let calls = Arc::new(Mutex::new(Vec::new()));
    let counted = Arc::clone(&calls);
    let engines = Engines::of(move |_, _| {
        Ok(Box::new(Hooked {
            inner: CpuEngine::new(),
            hooks: Counted(Arc::clone(&counted)),
        }))
    });
    let outcome = run(settings, engines, out);
    assert_eq!((outcome.error, outcome.n_engine_faults), (None, 0));
    assert_eq!(outcome.map.n_steps(), N_STEPS);
    calls.lock().unwrap().clone()
}

/// Where to lose the device: at the first and at the last call of each kind, and at `n` calls spread over all.
fn losses(calls: &[&'static str], n: usize) -> BTreeSet<LostAt> {
    let kinds: BTreeSet<&'static str> = calls.iter().copied().collect();
    let of_kinds = kinds.iter().flat_map(|kind| {
        let n_calls = calls.iter().filter(|call| *call == kind).count() as u64;
        [LostAt::CallOf(kind, 0), LostAt::CallOf(kind, n_calls - 1)]
    });
    let spread = (0..n).map(|k| LostAt::Call((k * calls.len() / n) as u64));
    of_kinds.chain(spread).collect()
}

/// Runs that are lost at one call each, over a map file that is there already.
fn lose_everywhere(policy: &str, n_runs: usize, check: impl Fn(&Outcome, &Checkpoint, LostAt)) {
    let settings = settings(&[&format!("engine.on_device_lost={policy}")]);
    let whole = tempfile::tempdir().unwrap();
    let calls = calls_of(&settings, whole.path());
    let old = whole.path().join("map.splatmap");
    let n_old = read_back(&old).snapshot.splats.len();
    assert!(n_old > 0, "the run without a fault makes a map");
    let mut met = BTreeSet::new();
    for lost_at in losses(&calls, n_runs) {
        let out = tempfile::tempdir().unwrap();
        let path = out.path().join("map.splatmap");
        std::fs::copy(&old, &path).unwrap();
        let (engines, call) = engines_losing(lost_at);
        let outcome = run(&settings, engines, out.path());
        met.extend(*call.lock().unwrap());
        let is_old = std::fs::read(&path).unwrap() == std::fs::read(&old).unwrap();
        let found = read_back(&path);
        assert!(
            is_old || !found.snapshot.splats.is_empty(),
            "lost at {lost_at:?}: an emptier file"
        );
        check(&outcome, &found, lost_at);
    }
    let kinds: BTreeSet<&str> = calls.iter().copied().collect();
    assert!(kinds.len() >= 12, "{kinds:?}");
    assert_eq!(met, kinds, "kinds of calls that met the loss");
}

#[test]
fn a_device_that_is_lost_at_any_call_leaves_the_map_file_whole_and_mapping_goes_on() {
    lose_everywhere("restart", 24, |outcome, found, lost_at| {
        assert!(outcome.n_engine_faults <= 1);
        if outcome.n_engine_faults == 1 && outcome.error.is_none() {
            assert_eq!(outcome.map.n_steps(), N_STEPS, "lost at {lost_at:?}");
            assert_eq!(outcome.snapshot.poses.len(), found.snapshot.poses.len());
            assert!(outcome.snapshot.poses.len() >= 6, "lost at {lost_at:?}");
        }
        let Some(error) = &outcome.error else { return };
        if outcome.n_engine_faults == 0 {
            // Lost behind the last step, while quality is measured: the map is whole, and the figures are missing.
            assert_eq!(
                outcome.map.n_steps(),
                N_STEPS,
                "lost at {lost_at:?}: {error}"
            );
            assert!(!found.snapshot.splats.is_empty(), "lost at {lost_at:?}");
        } else {
            // Only before the first batch is in the map is there nothing to go on from.
            assert!(error.contains("there was no map yet"), "{error}");
            assert!(outcome.map.n_steps() == 0, "lost at {lost_at:?}");
        }
    });
}

#[test]
fn a_run_that_is_to_stop_ends_with_the_error_and_the_last_good_state() {
    lose_everywhere("stop", 12, |outcome, found, lost_at| {
        if outcome.n_engine_faults == 0 {
            return;
        }
        let error = outcome.error.as_deref().unwrap_or_default();
        assert!(
            error.contains("unplugged"),
            "lost at {lost_at:?}: {error:?}"
        );
        if !outcome.snapshot.splats.is_empty() {
            assert_eq!(found.snapshot.splats, outcome.snapshot.splats);
        }
    });
}

#[test]
fn a_deterministic_replay_stops_and_a_second_loss_within_a_minute_does_too() {
    let out = tempfile::tempdir().unwrap();
    let (engines, _) = engines_losing(LostAt::Call(150));
    let outcome = run(&settings(&["deterministic=true"]), engines, out.path());
    let error = outcome.error.unwrap();
    assert!(error.contains("the replay is deterministic"), "{error}");
    let report = std::fs::read_to_string(out.path().join("report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    assert_eq!(report["engine_faults"], 1);
    assert!(report["error"].as_str().unwrap().contains("unplugged"));

    let out = tempfile::tempdir().unwrap();
    let engines = Engines::of(|_, _| {
        Ok(Box::new(Hooked {
            inner: CpuEngine::new(),
            hooks: Lost {
                lost_at: LostAt::Call(220),
                n_calls: AtomicU64::new(0),
                met: Met::default(),
            },
        }))
    });
    let outcome = run(&settings(&[]), engines, out.path());
    assert_eq!(outcome.n_engine_faults, 2);
    let error = outcome.error.unwrap();
    assert!(error.contains("second loss"), "{error}");
    assert!(
        !read_back(&out.path().join("map.splatmap"))
            .snapshot
            .splats
            .is_empty()
    );
}

fn bare(splats: Splats) -> Checkpoint {
    let snapshot = Snapshot {
        map_id: [7; 16],
        epoch: 0,
        revision: 1,
        stamp: Default::default(),
        scale: Default::default(),
        poses: Vec::new(),
        splat_ids: Arc::new((0..splats.len() as u32).collect()),
        splats: Arc::new(splats),
    };
    Checkpoint::of(snapshot, 1, 2)
}

fn splats_in_a_row(n: usize) -> Splats {
    Splats {
        means: (0..n).map(|ix| [ix as f32, 0.5, 2.0]).collect(),
        log_scales: vec![[-2.0; 3]; n],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![0.5; n],
        sh: vec![0.1; 48 * n],
        sh_degree: 3,
        anchors: vec![0; n],
    }
}

#[test]
fn a_map_without_splats_replaces_no_file_but_one_without() {
    let folder = tempfile::tempdir().unwrap();
    let full = splats_in_a_row(8);
    let (empty, whole) = (bare(Splats::default()), bare(full.clone()));
    let path = folder.path().join("map.splatmap");
    let ply = folder.path().join("map.ply");
    for _ in 0..2 {
        save_map(MapFile::Checkpoint(&empty), &path).unwrap();
        save_map(MapFile::Ply(&empty.snapshot.splats), &ply).unwrap();
    }
    save_map(MapFile::Checkpoint(&whole), &path).unwrap();
    save_map(MapFile::Ply(&full), &ply).unwrap();
    let before = [&path, &ply].map(|path| std::fs::read(path).unwrap());
    for (file, path) in [
        (MapFile::Checkpoint(&empty), &path),
        (MapFile::Ply(&empty.snapshot.splats), &ply),
    ] {
        let refused = save_map(file, path);
        assert!(
            matches!(refused, Err(SaveError::Empty { .. })),
            "{refused:?}"
        );
    }
    assert_eq!(
        before,
        [&path, &ply].map(|path| std::fs::read(path).unwrap())
    );
}

/// Loses its real device at a call, which then fails by itself.
#[derive(Debug)]
struct Unplugged {
    at: u64,
    n_calls: AtomicU64,
    since: Arc<Mutex<Option<Stopwatch>>>,
}

impl Hooks<WgpuEngine> for Unplugged {
    fn before(&self, inner: &WgpuEngine, _: &'static str) -> Result<(), EngineError> {
        if self.n_calls.fetch_add(1, Ordering::Relaxed) == self.at {
            inner.lose_device();
            *self.since.lock().unwrap() = Some(Stopwatch::start());
        }
        Ok(())
    }
}

#[test]
fn a_node_goes_on_within_seconds_when_its_gpu_is_lost_for_real() {
    for policy in ["restart", "cpu"] {
        let settings = settings(&[
            &format!("engine.on_device_lost={policy}"),
            "map.steps=60",
            "map.epipolar_weight=0",
        ]);
        let since = Arc::new(Mutex::new(None::<Stopwatch>));
        let back = Arc::new(Mutex::new(Vec::<(Kind, f64)>::new()));
        let (lost, opened) = (Arc::clone(&since), Arc::clone(&back));
        let engines = Engines::of(move |kind, _| {
            let elapsed = lost.lock().unwrap().as_ref().map(Stopwatch::secs);
            let engine: Box<dyn Engine> = match (elapsed, kind) {
                (None, _) => Box::new(Hooked {
                    inner: gpu_engine(),
                    hooks: Unplugged {
                        at: 80,
                        n_calls: AtomicU64::new(0),
                        since: Arc::clone(&lost),
                    },
                }),
                (Some(_), Kind::Cpu) => Box::new(CpuEngine::new()),
                (Some(_), _) => Box::new(gpu_engine()),
            };
            // Counts until there is an engine to go on with.
            if let Some(watch) = lost.lock().unwrap().as_ref() {
                opened.lock().unwrap().push((kind, watch.secs()));
            }
            Ok(engine)
        });
        let out = tempfile::tempdir().unwrap();
        let outcome = run(&settings, engines, out.path());
        assert_eq!((outcome.error, outcome.n_engine_faults), (None, 1));
        assert_eq!(outcome.map.n_steps(), 60);
        let back = back.lock().unwrap();
        let [(kind, secs)] = back[..] else {
            panic!("{policy}: opened {back:?}");
        };
        assert_eq!(kind == Kind::Cpu, policy == "cpu");
        assert!(secs < MAX_STANDSTILL_SECS, "{policy}: {secs} s");
        assert!(
            !read_back(&out.path().join("map.splatmap"))
                .snapshot
                .splats
                .is_empty()
        );
    }
}
