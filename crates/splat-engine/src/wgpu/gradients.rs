//! One view's loss and its gradient, without an update: for tests and diagnosis.

use crate::gradients::Gradients;
use crate::settings::{PoseMode, StepSettings};
use crate::view::TrainingView;
use crate::wgpu::engine::WgpuEngine;
use crate::wgpu::passes;
use crate::wgpu::types::{
    Camera, FLAG_ALL_SPLATS, FLAG_DEPTH, FLAG_GRADIENTS, Projected, Step, VIEW_EXPOSURE,
    VIEW_STRIDE,
};
use splat_gpu::commands::Commands;
use splat_gpu::error::GpuError;
use splat_types::splats::splats::Splats;

/// Place of the gradients in the statistics: rho and log focal, theta, gain, offset, four numbers each.
const AT_GRADIENTS: usize = 8;
/// Loss and depth loss of the last step.
const AT_DEPTH: usize = 4;
const AT_LOSS: usize = 5;

/// On an engine that holds nothing else; log gain and offset of r, g, b as given.
pub fn gradients(
    engine: &mut WgpuEngine,
    splats: &Splats,
    view: &TrainingView,
    exposure: [[f32; 3]; 2],
    settings: &StepSettings,
) -> Result<Gradients, GpuError> {
    engine.memory = crate::wgpu::memory::SplatMemory::new(&engine.gpu, splats.sh_degree)?;
    engine.gpu.forget_bindings();
    engine.try_append(splats)?;
    let view_ix = engine.views.add(&engine.gpu, view.clone())?;
    let at = view_ix * VIEW_STRIDE + VIEW_EXPOSURE;
    engine
        .gpu
        .write(&engine.views.records, at, exposure.as_flattened());
    let size = [view.image.width_px, view.image.height_px];
    engine.frame.fit(&engine.gpu, splats.len(), size)?;
    loop {
        let settings = StepSettings {
            pose: PoseMode::Held,
            ..settings.clone()
        };
        let step = engine.step_of(view_ix, &settings, 0);
        let step = Step {
            flags: FLAG_GRADIENTS | (step.flags & (FLAG_DEPTH | FLAG_ALL_SPLATS)),
            ..step
        };
        if let Some(found) = try_gradients(engine, view_ix, &step)? {
            return Ok(found);
        }
    }
}

/// `None`: there was no room, but there is.
fn try_gradients(
    engine: &mut WgpuEngine,
    view_ix: usize,
    step: &Step,
) -> Result<Option<Gradients>, GpuError> {
    engine.write_step(step);
    let [geometry, sh_rest] = engine.memory.scratch(&engine.gpu)?;
    let mut commands = Commands::new(&engine.gpu);
    commands.clear(&engine.frame.stats);
    passes::camera(&mut commands, &engine.frame, &engine.views)?;
    passes::forward(&mut commands, &mut engine.frame, &engine.memory, step)?;
    let wanted = &engine.views.all[view_ix].wanted;
    let copies = [&geometry, &sh_rest];
    passes::backward(
        &mut commands,
        &engine.frame,
        copies,
        &engine.memory,
        wanted,
        step,
    )?;
    passes::update_view(&mut commands, &engine.frame, &engine.views)?;
    commands.submit();
    let camera = engine.look()?;
    engine.reset_counts(camera);
    if camera.is_full != 0 {
        engine.make_room(&camera)?;
        return Ok(None);
    }
    let (gpu, n) = (&engine.gpu, engine.memory.n);
    let rows: Vec<f32> = gpu.read(&geometry, 0..16 * n)?;
    let rest: Vec<f32> = gpu.read(
        &sh_rest,
        0..n * crate::wgpu::memory::n_sh_rest(engine.memory.sh_degree),
    )?;
    let stats: Vec<f32> = gpu.read(&engine.frame.stats, 0..32)?;
    gpu.write(&engine.frame.stats, 0, &[0.0_f32; 32]);
    let all = engine.memory.unpack(&rows, &rest);
    let rendering = engine.read_image([step.width_px, step.height_px])?;
    Ok(Some(collect(engine, &camera, all, &stats, rendering)?))
}

fn collect(
    engine: &WgpuEngine,
    camera: &Camera,
    all: Splats,
    stats: &[f32],
    rendering: splat_types::rendering::Rendering,
) -> Result<Gradients, GpuError> {
    let n_visible = camera.n_visible as usize;
    let projected: Vec<Projected> = engine
        .gpu
        .read(&engine.frame.per_splat.projected, 0..n_visible)?;
    let visible: Vec<u32> = projected
        .iter()
        .filter(|splat| splat.opacity > 0.0)
        .map(|splat| splat.splat_ix)
        .collect();
    let mut is_visible = vec![false; all.len()];
    visible
        .iter()
        .for_each(|ix| is_visible[*ix as usize] = true);
    let mut found = all;
    let stride = found.sh_stride();
    for i in (0..found.len()).filter(|i| !is_visible[*i]) {
        found.means[i] = [0.0; 3];
        found.log_scales[i] = [0.0; 3];
        found.quats[i] = [0.0; 4];
        found.opacity_logits[i] = 0.0;
        found.sh[i * stride..(i + 1) * stride].fill(0.0);
    }
    let at = |k: usize| f64::from(stats[AT_GRADIENTS + k]);
    Ok(Gradients {
        means: found.means,
        log_scales: found.log_scales,
        quats: found.quats,
        opacity_logits: found.opacity_logits,
        sh: found.sh,
        pose: [at(0), at(1), at(2), at(4), at(5), at(6)],
        exposure: [[at(8), at(9), at(10)], [at(12), at(13), at(14)]],
        log_focal: at(3),
        loss: f64::from(stats[AT_LOSS]),
        l1: f64::from(stats[2]),
        ssim: f64::from(stats[3]),
        depth: f64::from(stats[AT_DEPTH]),
        rendering,
        visible,
    })
}
