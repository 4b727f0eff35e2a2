//! The sweep on a GPU (lavapipe where there is none) against the one on the CPU and against exact depth.

use std::cell::RefCell;
use std::sync::Arc;

use glam::{DQuat, DVec2, DVec3};

use crate::mvs::backend::{Matcher, timed};
use crate::mvs::depth_stream::DepthStream;
use crate::mvs::gpu::GpuMatcher;
use crate::mvs::params::MvsParams;
use crate::mvs::stereo::{SweepTask, sweep as sweep_on_cpu};
use crate::mvs::sweep::matching_costs;
use crate::mvs::view::{MvsView, Prepared, RawDepth, prepared};
use crate::mvs::{sgm, zncc};
use splat_gpu::backend::Backend;
use splat_gpu::device::Wanted;
use splat_types::camera::Intrinsics;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

/// Of the scene: before the box and behind the far end of the plane.
const RANGE: (f64, f64) = (1.4, 6.0);
/// A cost is rounded to a whole number, so sums in another order may end up one beside it.
const MAX_COST_ERROR: u8 = 1;

fn params(depth_planes: usize, source_views: usize) -> MvsParams {
    let mut params = MvsParams::default();
    (params.depth_planes, params.source_views) = (depth_planes, source_views);
    params
}

/// Depth of a slanted plane with a box before it, and where on it the ray ends.
fn hit(origin: DVec3, ray: DVec3) -> DVec3 {
    let front = origin + ray * ((2.0 - origin.z) / ray.z);
    if (front.x - 0.25).abs() < 0.4 && (front.y + 0.1).abs() < 0.35 {
        return front;
    }
    // z = 3.2 + 0.4 x - 0.25 y.
    let normal = DVec3::new(-0.4, 0.25, 1.0);
    origin + ray * ((3.2 - normal.dot(origin)) / normal.dot(ray))
}

/// Waves of many lengths and directions: a different pattern at every place.
fn grey_at(point: DVec3) -> f64 {
    let waves = (0..14).map(|k| {
        let turn = 2.4 * f64::from(k);
        let frequency = 3.0 * 1.28_f64.powi(k);
        let along = DVec3::new(turn.cos(), turn.sin(), 0.6 * (1.7 * turn).sin());
        (frequency * along.dot(point) + turn).sin()
    });
    0.5 + 0.09 * waves.sum::<f64>()
}

fn lens(width_px: u32, height_px: u32) -> Intrinsics {
    Intrinsics {
        width_px,
        height_px,
        fx: 0.9 * f64::from(width_px),
        fy: 0.88 * f64::from(width_px),
        cx: 0.49 * f64::from(width_px),
        cy: 0.52 * f64::from(height_px),
    }
}

fn view(submap_from_cam: Rigid, (width_px, height_px): (u32, u32)) -> MvsView {
    let intrinsics = lens(width_px, height_px);
    let rotation = submap_from_cam.rotation_matrix();
    let mut pixels = Vec::new();
    for y in 0..height_px {
        for x in 0..width_px {
            let samples = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)].map(|(u, v)| {
                let pixel = DVec2::new(f64::from(x) + u, f64::from(y) + v);
                let ray = rotation * intrinsics.ray_in_cam(pixel);
                grey_at(hit(submap_from_cam.translation, ray))
            });
            let grey = samples.iter().sum::<f64>() / 4.0;
            pixels.extend([(255.0 * grey).clamp(0.0, 255.0) as u8; 3]);
        }
    }
    MvsView {
        image: Arc::new(RgbImage {
            width_px,
            height_px,
            pixels,
        }),
        intrinsics,
        submap_from_cam,
    }
}

fn pose(turn: f64, x: f64, y: f64, z: f64) -> Rigid {
    Rigid::new(DQuat::from_rotation_y(turn), DVec3::new(x, y, z))
}

/// A reference and up to four sources, one of them of another size.
fn scene(size: (u32, u32), n_sources: usize) -> (MvsView, Vec<MvsView>) {
    let poses = [
        pose(-0.06, 0.3, 0.02, 0.0),
        pose(0.05, -0.28, -0.03, 0.04),
        pose(0.01, 0.03, 0.3, -0.05),
        pose(-0.02, 0.1, -0.27, 0.1),
    ];
    let sources = poses[..n_sources].iter().enumerate().map(|(ix, pose)| {
        let smaller = (size.0 - 6, size.1 - 3);
        view(*pose, if ix == 1 { smaller } else { size })
    });
    (view(pose(0.0, 0.0, 0.0, 0.0), size), sources.collect())
}

const ANY_KIND: Wanted = Wanted {
    any_kind: true,
    subgroups: true,
    float_atomics: false,
    lanes: None,
};

fn opened() -> GpuMatcher {
    GpuMatcher::open(ANY_KIND).unwrap_or_else(|error| panic!("run scripts/setup test: {error}"))
}

fn with_gpu<T>(run: impl FnOnce(&mut GpuMatcher) -> T) -> T {
    thread_local! {
        static GPU: RefCell<Option<GpuMatcher>> = const { RefCell::new(None) };
    }
    GPU.with_borrow_mut(|gpu| run(gpu.get_or_insert_with(opened)))
}

fn with_task<T>(
    (reference, sources): &(MvsView, Vec<MvsView>),
    range: (f64, f64),
    params: &MvsParams,
    run: impl FnOnce(&SweepTask<'_>) -> T,
) -> T {
    let reference = Prepared::new(reference, params);
    let sources = prepared(&sources.iter().collect::<Vec<_>>(), params);
    let sources: Vec<&Prepared> = sources.iter().collect();
    run(&SweepTask::new(&reference, &sources, range, params).unwrap())
}

/// The same image in another light.
fn relit(view: &MvsView, gain: f32, offset: f32) -> MvsView {
    let mut image = RgbImage::clone(&view.image);
    let lit = |p: u8| (gain * f32::from(p) + offset).clamp(0.0, 255.0) as u8;
    image.pixels.iter_mut().for_each(|p| *p = lit(*p));
    let image = Arc::new(image);
    MvsView { image, ..*view }
}

fn share(n: usize, of: usize) -> f64 {
    n as f64 / of as f64
}

/// Of pixels where one machine has a winner within half a plane of the other's, or both have none.
fn share_of_equal_winners(a: &sgm::Winners, b: &sgm::Winners) -> f64 {
    let pairs = a.plane.iter().zip(&b.plane);
    let n_equal = pairs
        .filter(|(a, b)| (**a < 0.0 && **b < 0.0) || (**a - **b).abs() < 0.5)
        .count();
    share(n_equal, a.plane.len())
}

/// Both machines on one scene: costs, then winners.
fn check(size: (u32, u32), n_sources: usize, n_depths: usize, range: (f64, f64)) {
    check_scene(&scene(size, n_sources), n_depths, range);
}

fn check_scene(scene: &(MvsView, Vec<MvsView>), n_depths: usize, range: (f64, f64)) {
    let params = params(n_depths, scene.1.len().max(1));
    with_task(scene, range, &params, |task| {
        let on_cpu = matching_costs(
            &task.reference.grey,
            &task.warps,
            &task.planes,
            zncc::OWN_SHARE,
            &|| (),
        );
        let (winners, on_gpu) = with_gpu(|gpu| (gpu.winners(task).unwrap(), gpu.costs(task)));
        assert_eq!(on_gpu.len(), on_cpu.len());
        let n_off = on_cpu
            .iter()
            .zip(&on_gpu)
            .filter(|(a, b)| a.abs_diff(**b) > MAX_COST_ERROR)
            .count();
        let (image, n_sources) = (&scene.0.image, scene.1.len());
        let shown = format!("{image:?}, {n_sources} sources, {n_depths} planes");
        assert!(
            share(n_off, on_cpu.len()) <= 1e-3,
            "{shown}: {n_off} of {} costs differ",
            on_cpu.len()
        );
        // Whole numbers: from equal costs, equal bits.
        let of_same_costs = sgm::best_planes(&task.reference.grey, &on_gpu, task.planes.n);
        assert_eq!(winners.plane, of_same_costs.plane, "{shown}");
        assert_eq!(winners.score, of_same_costs.score, "{shown}");
        assert_eq!(winners.margin, of_same_costs.margin, "{shown}");
        let equal = share_of_equal_winners(&winners, &task.winners_on_cpu());
        assert!(equal >= 0.995, "{shown}: {equal} of the winners are equal");
    });
}

#[test]
fn costs_and_winners_are_those_of_the_cpu() {
    check((96, 72), 4, 48, RANGE);
}

#[test]
fn odd_sizes_and_numbers_of_planes_match_too() {
    for (size, n_sources, n_depths) in [
        ((67, 51), 3, 37),
        ((33, 17), 2, 16),
        ((14, 90), 1, 19),
        ((41, 33), 1, 130),
        ((27, 31), 1, 512),
    ] {
        check(size, n_sources, n_depths, RANGE);
    }
}

#[test]
fn planes_outside_of_the_scene_or_the_sources_match_too() {
    // All before the scene, all behind it, and from behind a source's back.
    for range in [(0.2, 0.9), (7.0, 60.0), (0.03, 50.0)] {
        check((64, 48), 4, 32, range);
    }
}

#[test]
fn a_source_in_another_light_is_matched_as_if_it_were_in_the_same() {
    let (size, params) = ((320, 240), params(64, 3));
    let (reference, sources) = scene(size, 3);
    // Of little contrast, so that there are even places.
    let pale = |view: &MvsView| relit(view, 0.4, 77.0);
    let (reference, sources): (_, Vec<_>) = (pale(&reference), sources.iter().map(pale).collect());
    let lights = [(1.0, 0.0), (0.8, 30.0), (1.1, -20.0)];
    let pairs = sources.iter().zip(lights);
    let relit: Vec<MvsView> = pairs.map(|(view, (g, o))| relit(view, g, o)).collect();
    let scene = (reference, relit);
    with_task(&scene, RANGE, &params, |task| {
        for (warp, (gain, offset)) in task.warps.iter().zip(lights) {
            // Luma is centred: half of what the gain takes off is offset. Neighbours taken for each other draw the
            // line a little towards the mean.
            let (found, offset) = (warp.light, offset / 255.0 + 0.5 * (gain - 1.0));
            let off = (found.gain - gain).abs().max((found.offset - offset).abs());
            assert!(off < 0.1, "{gain} {offset}: {found:?}");
        }
    });
    let good = |sources: &[MvsView]| {
        let raw = sweep_on_cpu(
            &scene.0,
            &sources.iter().collect::<Vec<_>>(),
            RANGE,
            &params,
        );
        let errors = relative_errors(&raw, size);
        share(
            errors.iter().filter(|e| **e < 0.02).count(),
            raw.depth.len(),
        )
    };
    let (same, other) = (good(&sources), good(&scene.1));
    assert!(same > 0.9 && other > same - 0.02, "{same} {other}");
    check_scene(&scene, 48, RANGE);
}

fn relative_errors(raw: &RawDepth, (width_px, height_px): (u32, u32)) -> Vec<f64> {
    let intrinsics = lens(width_px, height_px);
    let mut errors = Vec::new();
    for (ix, depth) in raw.depth.iter().enumerate().filter(|(_, d)| **d > 0.0) {
        let (x, y) = (ix as u32 % width_px, ix as u32 / width_px);
        let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let exact = hit(DVec3::ZERO, intrinsics.ray_in_cam(pixel)).z;
        errors.push((f64::from(*depth) / exact - 1.0).abs());
    }
    errors.sort_by(f64::total_cmp);
    errors
}

#[test]
fn depth_is_as_exact_as_that_of_the_cpu_and_twice_the_same() {
    let size = (112, 84);
    let (reference, sources) = scene(size, 3);
    let sources: Vec<&MvsView> = sources.iter().collect();
    let params = params(64, 3);
    let on_cpu = sweep_on_cpu(&reference, &sources, RANGE, &params);
    let [first, second] =
        [0, 1].map(|_| with_gpu(|gpu| gpu.sweep(&reference, &sources, RANGE, &params)).unwrap());
    assert_eq!(first.depth, second.depth);
    assert_eq!(first.score, second.score);
    assert_eq!(first.margin, second.margin);

    let mut differences: Vec<f32> = on_cpu
        .depth
        .iter()
        .zip(&first.depth)
        .filter(|(a, b)| **a > 0.0 && **b > 0.0)
        .map(|(a, b)| (a / b - 1.0).abs())
        .collect();
    differences.sort_by(f32::total_cmp);
    assert!(differences.len() > first.depth.len() * 9 / 10);
    assert!(differences[differences.len() / 2] <= 1e-4);

    let (cpu, gpu) = (
        relative_errors(&on_cpu, size),
        relative_errors(&first, size),
    );
    let median = |errors: &[f64]| errors[errors.len() / 2];
    let good = |errors: &[f64]| share(errors.iter().filter(|e| **e < 0.02).count(), errors.len());
    assert!(median(&cpu) < 4e-3, "{}", median(&cpu));
    assert!(
        median(&gpu) < 1.01 * median(&cpu),
        "{} against {}",
        median(&gpu),
        median(&cpu)
    );
    assert!(
        good(&gpu) > good(&cpu) - 1e-3,
        "{} against {}",
        good(&gpu),
        good(&cpu)
    );
}

#[test]
fn without_parallax_or_sources_the_depth_is_empty() {
    let (reference, _) = scene((64, 48), 0);
    let beside = view(pose(0.0, 1e-4, 0.0, 0.0), (64, 48));
    for (sources, range) in [
        (vec![], RANGE),
        (vec![&beside], RANGE),
        (vec![&beside], (2.0, 1.0)),
        (vec![&beside], (0.0, f64::NAN)),
    ] {
        let params = params(32, 4);
        let raw = with_gpu(|gpu| gpu.sweep(&reference, &sources, range, &params)).unwrap();
        assert_eq!(raw.depth, vec![0.0; 64 * 48]);
    }
}

#[test]
fn a_sweep_larger_than_promised_is_refused_before_memory_is_taken() {
    let params = params(64, 1);
    with_task(&scene((32, 24), 1), RANGE, &params, |task| {
        let mut gpu = opened();
        gpu.winners(task).unwrap();
        let held = gpu.peak_bytes();
        assert!(held > 0 && held < 20 << 20, "{held}");
        let error = gpu.make_room_for(1 << 30).unwrap_err().to_string();
        assert!(error.contains("a sweep"), "{error}");
        assert_eq!(gpu.peak_bytes(), held);
        gpu.winners(task).unwrap();
    });
}

#[test]
fn a_device_lost_in_the_middle_of_a_run_costs_no_depth() {
    let params = params(32, 2);
    with_task(&scene((64, 48), 2), RANGE, &params, |task| {
        let mut matcher = Matcher::new(Backend::Wgpu).unwrap();
        matcher.winners(task, &|| ());
        let Matcher::Gpu(gpu) = &matcher else {
            panic!("a GPU was asked for");
        };
        gpu.lose();
        let found = matcher.winners(task, &|| ());
        assert_eq!(found.plane, task.winners_on_cpu().plane);
        assert!(matches!(matcher, Matcher::Cpu), "it does not try again");
    });
}

#[test]
fn the_slower_machine_is_not_taken() {
    let params = params(64, 2);
    with_task(&scene((96, 72), 2), RANGE, &params, |task| {
        let (winners, matcher) = timed(task, ANY_KIND);
        let is_software = with_gpu(|gpu| gpu.adapter().contains("llvmpipe"));
        if is_software {
            // Tens of times slower than native code: no load of the machine turns that round.
            assert!(matches!(matcher, Matcher::Cpu));
        }
        let taken = match matcher {
            Matcher::Gpu(mut gpu) => gpu.winners(task).unwrap(),
            _ => task.winners_on_cpu(),
        };
        assert_eq!(winners.plane, taken.plane, "of the machine that is kept");
    });
}

#[test]
fn auto_decides_at_the_first_sweep_and_stays_off_software() {
    let params = params(32, 2);
    let (reference, sources) = scene((64, 48), 2);
    let mut state = DepthStream::new(params, 8).unwrap();
    state.add(0, &sources[0], 1.0, 2.0, &[]);
    assert!(matches!(state.matcher(), Some(Matcher::Undecided)));
    state.add(1, &reference, RANGE.0, RANGE.1, &[0]);
    let matcher = state.matcher().unwrap();
    assert!(!matches!(matcher, Matcher::Undecided), "a sweep was made");
    if let Matcher::Gpu(gpu) = matcher {
        assert!(!gpu.adapter().contains("llvmpipe"), "{}", gpu.adapter());
    }
}
