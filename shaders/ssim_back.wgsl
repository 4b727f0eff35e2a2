// ssim_back: the maps of ssim_terms, blurred along rows.
// After ssim_terms. One thread per 4 pixels of a row. The blur with zeros beyond the edges is its own adjoint.

#import step
#import ssim

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> terms: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> blurred: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let runs = (step.width_px + RUN - 1u) / RUN;
    let run = flat(group, groups) * 64u + lane;
    let y = run / runs;
    if y >= step.height_px {
        return;
    }
    let first = i32(run % runs * RUN);
    let row = i32(y * step.width_px);
    let plane = step.width_px * step.height_px;
#repeat t 14
    var p_$t = vec3<f32>(0.0);
    var q_$t = vec3<f32>(0.0);
    var r_$t = vec3<f32>(0.0);
    {
        let x = first + $t - REACH;
        if x >= 0 && x < i32(step.width_px) {
            let at = u32(row + x);
            p_$t = terms[at].xyz;
            q_$t = terms[plane + at].xyz;
            r_$t = terms[2u * plane + at].xyz;
        }
    }
#end
#repeat j 4
    if first + $j < i32(step.width_px) {
        var p = vec3<f32>(0.0);
        var q = vec3<f32>(0.0);
        var r = vec3<f32>(0.0);
#repeat t 11
        p += WINDOW[$t] * p_$[j+t];
        q += WINDOW[$t] * q_$[j+t];
        r += WINDOW[$t] * r_$[j+t];
#end
        let at = u32(row + first + $j);
        blurred[at] = vec4<f32>(p, 0.0);
        blurred[plane + at] = vec4<f32>(q, 0.0);
        blurred[2u * plane + at] = vec4<f32>(r, 0.0);
    }
#end
}
