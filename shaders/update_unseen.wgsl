// update_unseen: splats that the step's view did not show -> their update by momentum, regularisers and noise alone.
// After project_backward, only where a step moves all splats. One thread per splat. Equations: docs/GRADIENTS.md, Adam and MCMC.

#import step
#import camera
#import splat_update

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read_write> geometry: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> moments: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> sh_rest: array<f32>;
@group(0) @binding(5) var<storage, read_write> sh_moments: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = flat(group, groups) * 256u + lane;
    // A view that shows nothing changes nothing; and behind a step without room none is made.
    if splat_ix >= step.n_splats || camera.n_visible == 0u || camera.is_full != 0u {
        return;
    }
    let at = 4u * splat_ix;
    let seen_last = geometry[at + 3u].w;
    if seen_last == f32(step.n_steps) {
        return;
    }
    let opacity = 1.0 / (1.0 + exp(-geometry[at].w));
    let scale = exp(geometry[at + 2u].xyz);
    let per_splat = 1.0 / f32(step.n_splats);
    var g: Gradient;
    g.screen = -1.0;
    g.opacity_logit = step.opacity_reg * per_splat * opacity * (1.0 - opacity);
    g.log_scale = scale * step.scale_reg * per_splat / 3.0;
    if is_finite(g.opacity_logit) && is_finite3(g.log_scale) {
        update_splat(splat_ix, vec3<f32>(0.0, 0.0, 1.0), g);
        geometry[at + 3u].w = seen_last;
    }
}
