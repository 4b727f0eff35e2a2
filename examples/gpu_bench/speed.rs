//! Steps a second, and where their time goes.

use std::hint::black_box;

use splat_engine::cpu::engine::CpuEngine;
use splat_engine::traits::{Device as _, Engine, Trainer as _};
use splat_engine::wgpu::engine::WgpuEngine;
use splat_geometry::mvs::gpu::GpuMatcher;
use splat_geometry::mvs::stereo;
use splat_geometry::mvs::view::MvsView;
use splat_mapper::params::settings::Settings;
use splat_types::time::Stopwatch;

use crate::scene::{mvs_view, settings};
use crate::trained_scene;
use crate::wanted;

const SIZES_PX: [[u32; 2]; 3] = [[270, 480], [518, 388], [1920, 1080]];
const SPLATS: [usize; 3] = [54_000, 300_000, 1_000_000];
/// Steps that are not timed, and for how long steps are.
const N_WARM: usize = 20;
const TIMED_SECS: f64 = 0.7;
/// Steps in a row between two waits: the mapper hands them over in batches.
const BATCH: usize = 16;

/// Prints what the threads of a tile are worth, and subgroups.
pub(crate) fn lanes(all: &[u32]) -> anyhow::Result<()> {
    println!(
        "Steps/s by threads of a tile, 54,000 splats at 270x480 and 300,000 at 1920x1080, sums in order and in any:\n"
    );
    println!("| threads | 270x480 | any order | 1920x1080 | any order |");
    println!("|---|---|---|---|---|");
    for n in all {
        let mut engines = Vec::new();
        for atomics in [false, true] {
            engines.push(WgpuEngine::new(wanted(Some(*n), atomics))?);
        }
        let mut cells = Vec::new();
        for (n_splats, size) in [(54_000, SIZES_PX[0]), (300_000, SIZES_PX[2])] {
            for engine in &mut engines {
                let view_ix = set_up(engine, n_splats, size)?;
                cells.push(format!("{:.0}", rate(engine, view_ix, BATCH)?));
            }
        }
        println!("| {n} | {} |", cells.join(" | "));
    }
    println!();
    Ok(())
}

/// Prints steps a second by size of the map and of the image.
pub(crate) fn sizes(max_splats: usize, gpu_only: bool) -> anyhow::Result<()> {
    println!("Steps/s by splats and image, in rows of {BATCH}; \"alone\": each step waited for:\n");
    println!("| image | splats | sums in order | alone | in any order | MiB | CPU engine |");
    println!("|---|---|---|---|---|---|---|");
    for size in SIZES_PX {
        let mut in_order = WgpuEngine::new(wanted(None, false))?;
        let mut any_order = WgpuEngine::new(wanted(None, true))?;
        for n in SPLATS.into_iter().filter(|n| *n <= max_splats) {
            let view_ix = set_up(&mut in_order, n, size)?;
            let rates = [BATCH, 1].map(|batch| rate(&mut in_order, view_ix, batch));
            let [in_rows, alone] = rates;
            let view_ix = set_up(&mut any_order, n, size)?;
            let any = rate(&mut any_order, view_ix, BATCH)?;
            let on_cpu = if gpu_only || size[0] > 1000 {
                "-".to_owned()
            } else {
                let mut engine = CpuEngine::new();
                let view_ix = set_up(&mut engine, n, size)?;
                format!("{:.1}", rate(&mut engine, view_ix, 1)?)
            };
            println!(
                "| {}x{} | {n} | {:.0} | {:.0} | {any:.0} | {} | {on_cpu} |",
                size[0],
                size[1],
                in_rows?,
                alone?,
                in_order.memory().held_bytes >> 20
            );
        }
    }
    println!();
    Ok(())
}

/// Prints the time of each kernel of a step.
pub(crate) fn kernels(n_splats: usize, size: [u32; 2]) -> anyhow::Result<()> {
    let mut engine = WgpuEngine::new(wanted(None, false))?;
    let view_ix = set_up(&mut engine, n_splats, size)?;
    if !engine.gpu().start_profile() {
        println!("Kernels are not timed: the adapter has no timestamps.\n");
        return Ok(());
    }
    let n_steps = 20;
    for _ in 0..n_steps {
        engine.step(view_ix, &settings())?;
    }
    engine.take_stats()?;
    let times = engine.gpu().take_profile();
    let all: f64 = times.iter().map(|(_, time)| time.secs).sum();
    println!(
        "Kernels of a step, {n_splats} splats at {}x{}: {:.0} us together\n",
        size[0],
        size[1],
        1e6 * all / f64::from(n_steps)
    );
    println!("| kernel | runs | us | share |");
    println!("|---|---|---|---|");
    for (kernel, time) in times {
        println!(
            "| {kernel} | {} | {:.1} | {:.0} % |",
            time.n_runs / n_steps as u64,
            1e6 * time.secs / f64::from(n_steps),
            100.0 * time.secs / all
        );
    }
    println!();
    Ok(())
}

/// Prints how long one view's depth takes from four others.
pub(crate) fn sweeps(gpu_only: bool) -> anyhow::Result<()> {
    let mut params = Settings::shipped().params()?.mvs;
    (params.depth_planes, params.source_views) = (96, 4);
    println!("Depth of a view from 4 others, 96 planes, ms:\n");
    println!("| image | GPU | CPU |");
    println!("|---|---|---|");
    for size in [[320, 240], [518, 388]] {
        let views: Vec<MvsView> = (0..5)
            .map(|ix| mvs_view(size, 0.1 * f64::from(ix)))
            .collect();
        let sources: Vec<&MvsView> = views[1..].iter().collect();
        let mut gpu = GpuMatcher::open(wanted(None, false))?;
        let range = (1.0, 6.0);
        let on_gpu = millis(|| {
            let _depth = black_box(gpu.sweep(&views[0], &sources, range, &params));
        });
        let on_cpu = if gpu_only {
            "-".to_owned()
        } else {
            let sweep = || {
                let _depth = black_box(stereo::sweep(&views[0], &sources, range, &params));
            };
            format!("{:.1}", millis(sweep))
        };
        println!("| {}x{} | {on_gpu:.2} | {on_cpu} |", size[0], size[1]);
    }
    println!();
    Ok(())
}

/// Replaces the engine's map and makes steps that are not timed. One engine for all sizes: NVIDIA's driver (580.159) shows
/// no adapter to a process that has opened some thirty instances.
fn set_up(engine: &mut dyn Engine, n_splats: usize, size: [u32; 2]) -> anyhow::Result<usize> {
    let (splats, view) = trained_scene(n_splats, size);
    engine.retain(&vec![false; engine.len()])?;
    engine.append(&splats)?;
    let view_ix = engine.add_view(view)?;
    for _ in 0..N_WARM {
        engine.step(view_ix, &settings())?;
    }
    engine.take_stats()?;
    Ok(view_ix)
}

fn rate(engine: &mut dyn Engine, view_ix: usize, batch: usize) -> anyhow::Result<f64> {
    let watch = Stopwatch::start();
    let mut n = 0;
    while watch.secs() < TIMED_SECS {
        for _ in 0..batch {
            engine.step(view_ix, &settings())?;
        }
        engine.take_stats()?;
        n += batch;
    }
    Ok(n as f64 / watch.secs())
}

fn millis(mut run: impl FnMut()) -> f64 {
    run();
    let watch = Stopwatch::start();
    let mut n = 0;
    while watch.secs() < TIMED_SECS {
        run();
        n += 1;
    }
    1e3 * watch.secs() / f64::from(n)
}
