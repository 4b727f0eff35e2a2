//! Engines on a GPU, which may be software, and sums that they may make in any order.

use std::cell::RefCell;

use crate::backends::ORDINARY;
use crate::reference::random;
use splat_engine::gradients::Gradients;
use splat_engine::settings::StepSettings;
use splat_engine::traits::Device as _;
use splat_engine::view::TrainingView;
use splat_engine::wgpu::engine::WgpuEngine;
use splat_engine::wgpu::gradients;
use splat_gpu::device::Wanted;
use splat_types::splats::splats::Splats;

/// On lavapipe where there is no GPU; `scripts/setup test` installs it.
pub fn gpu_engine(subgroups: bool) -> WgpuEngine {
    opened(Wanted {
        any_kind: true,
        subgroups,
        float_atomics: false,
        lanes: None,
    })
}

/// Which adds up in any order, where the adapter has float atomics.
pub fn fast_engine() -> WgpuEngine {
    opened(Wanted {
        any_kind: true,
        subgroups: true,
        float_atomics: true,
        lanes: None,
    })
}

fn opened(wanted: Wanted) -> WgpuEngine {
    WgpuEngine::new(wanted).unwrap_or_else(|error| panic!("run scripts/setup test: {error}"))
}

pub fn gpu_gradients(
    subgroups: bool,
    splats: &Splats,
    view: &TrainingView,
    settings: &StepSettings,
) -> Gradients {
    thread_local! {
        // Opening a device compiles all shaders.
        static ENGINES: RefCell<[Option<WgpuEngine>; 2]> = const { RefCell::new([None, None]) };
    }
    ENGINES.with_borrow_mut(|engines| {
        let engine = engines[usize::from(subgroups)].get_or_insert_with(|| gpu_engine(subgroups));
        gradients::gradients(engine, splats, view, [[0.0; 3]; 2], settings).unwrap()
    })
}

#[test]
fn sums_in_any_order_are_the_same_but_for_rounding() {
    let mut fast = fast_engine();
    if !fast.sums_in_any_order() {
        eprintln!(
            "not measured: this adapter has no float atomics: {}",
            fast.adapter()
        );
        return;
    }
    assert_rounding_alone(&mut fast);
}

/// As on adapters with subgroups of 32, which share a tile by two.
#[test]
fn sums_over_several_subgroups_a_tile_are_the_same_but_for_rounding() {
    for lanes in [16, 64, 256] {
        assert_rounding_alone(&mut opened(Wanted {
            any_kind: true,
            subgroups: true,
            float_atomics: false,
            lanes: Some(lanes),
        }));
    }
}

/// Beside the engine whose tiles are one subgroup on lavapipe.
fn assert_rounding_alone(engine: &mut WgpuEngine) {
    for seed in 0..4 {
        let scene = random::scene(seed, &ORDINARY);
        let settings = random::settings();
        let exact = gpu_gradients(true, &scene.splats, &scene.view, &settings);
        let found =
            gradients::gradients(engine, &scene.splats, &scene.view, [[0.0; 3]; 2], &settings);
        let found = found.unwrap();
        let pairs = [
            (found.means.as_flattened(), exact.means.as_flattened()),
            (
                found.log_scales.as_flattened(),
                exact.log_scales.as_flattened(),
            ),
            (found.quats.as_flattened(), exact.quats.as_flattened()),
            (&found.opacity_logits, &exact.opacity_logits),
            (&found.sh, &exact.sh),
        ];
        for (found, exact) in pairs {
            let norm =
                |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
            let off = norm(&mut found.iter().zip(exact).map(|(a, b)| f64::from(a - b)));
            let all = norm(&mut exact.iter().map(|v| f64::from(*v)));
            assert!(
                all > 0.0 && off < 1e-5 * all,
                "seed {seed}: {off:e} of {all:e}"
            );
        }
    }
}
