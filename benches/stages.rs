//! Time of each stage of a step and of whole steps, 270x480, by number of splats.
//!
//! And of features by kind: a random image of 640x360 on all cores, and one pair of 2,000 descriptors on one.
//!
//! Splats are random, with sizes that give 100 to 280 of them per tile as trained maps have. Whole steps also on the GPU,
//! which may be software, and in maps of which most lies behind the camera. Depth of a view on both.

use std::hint::black_box;
use std::time::Duration;

use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, Throughput, criterion_group, criterion_main};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use splat_engine::cpu::engine::CpuEngine;
use splat_engine::cpu::project_backward::{Forward, SplatGradients, project_backward};
use splat_engine::cpu::raster_backward::{InstanceGradients, raster_backward};
use splat_engine::cpu::{bin, loss, loss_buffers, project, raster};
use splat_engine::traits::{Engine, SplatBuffers as _, Trainer as _, ViewStore as _};
use splat_engine::view::TrainingView;
use splat_engine::wgpu::engine::WgpuEngine;
use splat_geometry::features::descriptor::Features;
use splat_geometry::features::scale_space::Grey;
use splat_geometry::features::{orb, sift};
use splat_geometry::matching::{PreparedDescriptors, matches};
use splat_geometry::mvs::gpu::GpuMatcher;
use splat_geometry::mvs::stereo;
use splat_geometry::mvs::view::MvsView;
use splat_gpu::device::Wanted;
use splat_mapper::params::settings::Settings;
use splat_types::splats::splats::Splats;

#[path = "../examples/gpu_bench/scene.rs"]
mod scene;

use scene::{mvs_view, scene, settings};

const SIZE: [u32; 2] = [270, 480];

/// Name, number of splats, and the mean size that gives the wanted splats per tile.
const SIZES: [(&str, usize, f64); 3] = [
    ("10k", 10_000, 4.0),
    ("20k", 20_000, 3.0),
    ("54k", 54_000, 2.0),
];

/// Splats in all, of which the first size is in view.
const MAPS: [(&str, usize); 4] = [
    ("10k", 10_000),
    ("30k", 30_000),
    ("100k", 100_000),
    ("300k", 300_000),
];

criterion_group!(benches, stages, gpu_steps, maps, sweeps, features);
criterion_main!(benches);

fn stages(c: &mut Criterion) {
    for (name, n, size_px) in SIZES {
        let (splats, view) = scene(n, size_px, SIZE);
        let mut group = c.benchmark_group("step");
        configure(&mut group);
        let mut engine = CpuEngine::new();
        engine.append(&splats).expect("a device that stays");
        let view_ix = engine.add_view(view.clone()).expect("a device that stays");
        group.bench_function(name, |b| {
            b.iter(|| {
                let stepped = engine.step(view_ix, &settings());
                stepped.expect("a device that stays");
            });
        });
        group.finish();
        each_stage(c, name, &splats, &view);
    }
}

/// Whole steps with their wait, by how the GPU adds up.
fn gpu_steps(c: &mut Criterion) {
    for (kind, subgroups, float_atomics) in [
        ("wgpu", true, false),
        ("wgpu_plain", false, false),
        ("wgpu_any_order", true, true),
    ] {
        let wanted = Wanted {
            any_kind: true,
            subgroups,
            float_atomics,
            lanes: None,
        };
        for (name, n, size_px) in SIZES {
            let Ok(mut engine) = WgpuEngine::new(wanted) else {
                return;
            };
            let (splats, view) = scene(n, size_px, SIZE);
            bench_step(
                c,
                &format!("step_{kind}"),
                name,
                &mut engine,
                &[splats],
                view,
            );
        }
    }
}

/// 10,000 splats in view, and in all as many as named.
fn maps(c: &mut Criterion) {
    for (name, n) in MAPS {
        let (seen, view) = scene(SIZES[0].1, SIZES[0].2, SIZE);
        let (mut unseen, _) = scene(n - seen.len(), SIZES[0].2, SIZE);
        unseen.means.iter_mut().for_each(|[.., z]| *z = -*z);
        let all = [seen, unseen];
        let mut engine = CpuEngine::new();
        bench_step(c, "step_in_map", name, &mut engine, &all, view.clone());
        let wanted = Wanted {
            any_kind: true,
            subgroups: true,
            float_atomics: false,
            lanes: None,
        };
        if let Ok(mut engine) = WgpuEngine::new(wanted) {
            bench_step(c, "step_in_map_wgpu", name, &mut engine, &all, view);
        }
    }
}

/// Depth of one view from the multi-view stereo: 320x240, 96 planes, 4 sources.
fn sweeps(c: &mut Criterion) {
    let mut params = Settings::shipped().params().expect("shipped").mvs;
    (params.depth_planes, params.source_views) = (96, 4);
    let views: Vec<MvsView> = (0..5)
        .map(|ix| mvs_view([320, 240], 0.1 * f64::from(ix)))
        .collect();
    let sources: Vec<&MvsView> = views[1..].iter().collect();
    let range = (1.0, 6.0);
    let mut group = c.benchmark_group("sweep_320x240x96_4_sources");
    configure(&mut group);
    group.sample_size(10);
    group.bench_function("cpu", |b| {
        b.iter(|| stereo::sweep(&views[0], &sources, range, &params));
    });
    let wanted = Wanted {
        any_kind: true,
        subgroups: true,
        float_atomics: false,
        lanes: None,
    };
    if let Ok(mut gpu) = GpuMatcher::open(wanted) {
        group.bench_function("wgpu", |b| {
            b.iter(|| gpu.sweep(&views[0], &sources, range, &params));
        });
    }
    group.finish();
}

fn features(c: &mut Criterion) {
    const N: usize = 2_000;
    let mut rng = Pcg32::seed_from_u64(3);
    let (width, height) = (640, 360);
    let mut image = Grey {
        width,
        height,
        pixels: vec![0.5; width * height],
    };
    for _ in 0..4_000 {
        let (x, y) = (rng.random_range(0..width), rng.random_range(0..height));
        let (size, step) = (rng.random_range(2..30), rng.random_range(-0.2..0.2_f32));
        for row in y..(y + size).min(height) {
            image.pixels[row * width..][x..(x + size).min(width)]
                .iter_mut()
                .for_each(|v| *v = (*v + step).clamp(0.0, 1.0));
        }
    }
    type Find = fn(&Grey, usize) -> Features;
    for (kind, find) in [("sift", sift::features as Find), ("orb", orb::features)] {
        let mut group = c.benchmark_group(format!("features_{kind}"));
        configure(&mut group);
        group.bench_function("640x360", |b| b.iter(|| find(black_box(&image), N)));
        group.finish();
        let found = PreparedDescriptors::new(&find(&image, N).descriptors);
        let mut group = c.benchmark_group(format!("matches_{kind}"));
        configure(&mut group);
        group.bench_function("2000", |b| b.iter(|| matches(&found, black_box(&found))));
        group.finish();
    }
}

fn bench_step(
    c: &mut Criterion,
    group: &str,
    name: &str,
    engine: &mut dyn Engine,
    splats: &[Splats],
    view: TrainingView,
) {
    splats
        .iter()
        .for_each(|splats| engine.append(splats).expect("a device that stays"));
    let view_ix = engine.add_view(view).expect("a device that stays");
    let mut group = c.benchmark_group(group);
    configure(&mut group);
    group.sample_size(10);
    group.bench_function(name, |b| {
        b.iter(|| {
            engine
                .step(view_ix, &settings())
                .expect("a device that stays");
            // Waits: a GPU's step only begins when it is asked for.
            engine.take_stats().expect("a device that stays")
        });
    });
    group.finish();
}

fn each_stage(c: &mut Criterion, name: &str, splats: &Splats, view: &TrainingView) {
    let settings = settings();
    let camera = project::Camera::new(&view.intrinsics, &view.cam_from_world);
    let target = loss::Target {
        image: &view.image,
        depth: view.depth.as_deref(),
        mask: None,
        exposure: [[0.0; 3]; 2],
    };
    let (mut projected, mut tiles, mut image) = (
        project::Projected::default(),
        bin::Tiles::default(),
        raster::Raster::default(),
    );
    let mut pixels = loss_buffers::PixelGradients::default();
    let (mut instances, mut gradients) = (InstanceGradients::default(), SplatGradients::default());
    let mut bench = |stage: &str, run: &mut dyn FnMut()| {
        // Once outside of the measurement: a filter may leave it out, and the next stage needs the result.
        run();
        let mut group = c.benchmark_group(stage);
        configure(&mut group);
        group.bench_function(name, |b| b.iter(&mut *run));
        group.finish();
    };
    bench("project", &mut || {
        project::project(black_box(splats), &camera, 3, &mut projected);
    });
    let visible = &projected.splats;
    bench("bin", &mut || {
        bin::bin(visible, SIZE[0], SIZE[1], &mut tiles);
    });
    bench("raster", &mut || {
        raster::raster(visible, &tiles, &mut image);
    });
    bench("loss", &mut || {
        black_box(loss::loss(&image, &target, &settings, &mut pixels));
    });
    bench("raster_backward", &mut || {
        raster_backward(visible, &tiles, &image, &pixels, &mut instances);
    });
    let forward = Forward {
        splats,
        camera: &camera,
        visible,
        tiles: &tiles,
    };
    bench("project_backward", &mut || {
        project_backward(forward, &instances, &settings, &mut gradients);
    });
    #[expect(clippy::print_stderr, reason = "says what was measured")]
    {
        let per_tile = tiles.instances.len() / tiles.n_tiles();
        let used = 100 * instances.slots.len() / tiles.instances.len();
        eprintln!(
            "{name}: {} visible, {per_tile} instances per tile, {used} % of them used\n",
            visible.len()
        );
    }
}

fn configure(group: &mut BenchmarkGroup<'_, WallTime>) {
    group.throughput(Throughput::Elements(1));
    group
        .sample_size(20)
        .warm_up_time(Duration::from_secs(1))
        .measurement_time(Duration::from_secs(3));
}
