//! Gradients of the GPU beside those of the CPU engine, which tests hold against the f64 reference.

use splat_engine::cpu::engine as cpu;
use splat_engine::gradients::Gradients;
use splat_engine::wgpu::engine::WgpuEngine;
use splat_engine::wgpu::gradients;

use crate::scene::settings;
use crate::{trained_scene, wanted};

/// Prints distances of the images and gradients, each over the norm of the CPU's.
pub(crate) fn table() -> anyhow::Result<()> {
    println!(
        "Distance of the GPU's results from the CPU engine's, over their norm (1,000 to 100,000 splats, 270x480):\n"
    );
    println!("| splats | sums | image | means | scales | quaternions | opacities | SH | pose |");
    println!("|---|---|---|---|---|---|---|---|---|");
    let scenes = [1_000, 10_000, 100_000].map(|n| (n, trained_scene(n, [270, 480])));
    let exact = scenes
        .iter()
        .map(|(_, (splats, view))| cpu::gradients(splats, view, &settings()));
    let exact: Vec<_> = exact.collect();
    for (order, lanes, atomics) in [
        ("in order, one subgroup a tile", Some(1), false),
        ("in order", None, false),
        ("in any order", None, true),
    ] {
        let mut engine = WgpuEngine::new(wanted(lanes, atomics))?;
        if atomics && !engine.sums_in_any_order() {
            continue;
        }
        for ((n, (splats, view)), exact) in scenes.iter().zip(&exact) {
            let found =
                gradients::gradients(&mut engine, splats, view, [[0.0; 3]; 2], &settings())?;
            println!(
                "| {n} | {order} | {} |",
                distances(&found, exact)
                    .map(|d| format!("{d:.1e}"))
                    .join(" | ")
            );
        }
    }
    println!();
    Ok(())
}

fn distances(found: &Gradients, exact: &Gradients) -> [f64; 7] {
    let pose = |g: &Gradients| g.pose.map(|x| x as f32);
    [
        distance(&found.rendering.rgb, &exact.rendering.rgb),
        distance(found.means.as_flattened(), exact.means.as_flattened()),
        distance(
            found.log_scales.as_flattened(),
            exact.log_scales.as_flattened(),
        ),
        distance(found.quats.as_flattened(), exact.quats.as_flattened()),
        distance(&found.opacity_logits, &exact.opacity_logits),
        distance(&found.sh, &exact.sh),
        distance(&pose(found), &pose(exact)),
    ]
}

fn distance(a: &[f32], b: &[f32]) -> f64 {
    let squared = |x: f32| f64::from(x).powi(2);
    let off: f64 = a.iter().zip(b).map(|(a, b)| squared(a - b)).sum();
    let norm: f64 = b.iter().copied().map(squared).sum();
    (off / norm.max(f64::MIN_POSITIVE)).sqrt()
}
