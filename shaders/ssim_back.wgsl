// ssim_back: the maps of ssim_terms, blurred along rows.
// After ssim_terms. One thread per 4 pixels of a row. The blur with zeros beyond the edges is its own adjoint.

#import step
#import ssim

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> maps: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> blurred: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let run = run_of_row(flat(group, groups) * 64u + lane);
    if run.y >= step.height_px {
        return;
    }
    let first = i32(run.x);
    let start = run.y * step.width_px;
    let stride = 1u;
    let n_along = i32(step.width_px);
    let plane = step.width_px * step.height_px;
#import ssim_maps_load
#repeat j 4
    if first + $j < n_along {
#import ssim_maps_blur
        let at = start + u32(first + $j);
        blurred[at] = vec4<f32>(p, 0.0);
        blurred[plane + at] = vec4<f32>(q, 0.0);
        blurred[2u * plane + at] = vec4<f32>(r, 0.0);
    }
#end
}
