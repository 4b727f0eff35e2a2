// ssim_rows: rendering and photo -> their moments, blurred along rows.
// First stage of the loss, after raster. One thread per 4 pixels of a row. Equations: docs/GRADIENTS.md, loss.

#import step
#import camera
#import ssim

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
// Photo as r, g, b, weight bytes; depth behind it.
@group(0) @binding(3) var<storage, read> wanted: array<u32>;
// Four planes: mean of x with xy.r in w, mean of y with xy.g, x^2 with xy.b, y^2.
@group(0) @binding(4) var<storage, read_write> moments: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let run = run_of_row(flat(group, groups) * 64u + lane);
    if run.y >= step.height_px {
        return;
    }
    let first = i32(run.x);
    let row = i32(run.y * step.width_px);
#repeat t 14
    var x_$t = vec3<f32>(0.0);
    var y_$t = vec3<f32>(0.0);
    {
        let at = first + $t - REACH;
        if at >= 0 && at < i32(step.width_px) {
            x_$t = camera.gain.xyz * image[row + at].xyz + camera.offset.xyz;
            y_$t = unpack4x8unorm(wanted[row + at]).xyz;
        }
    }
#end
    let plane = step.width_px * step.height_px;
#repeat j 4
    if first + $j < i32(step.width_px) {
        var mx = vec3<f32>(0.0);
        var my = vec3<f32>(0.0);
        var xx = vec3<f32>(0.0);
        var yy = vec3<f32>(0.0);
        var xy = vec3<f32>(0.0);
#repeat t 11
        mx += WINDOW[$t] * x_$[j+t];
        my += WINDOW[$t] * y_$[j+t];
        xx += WINDOW[$t] * x_$[j+t] * x_$[j+t];
        yy += WINDOW[$t] * y_$[j+t] * y_$[j+t];
        xy += WINDOW[$t] * x_$[j+t] * y_$[j+t];
#end
        let at = u32(row + first + $j);
        moments[at] = vec4<f32>(mx, xy.x);
        moments[plane + at] = vec4<f32>(my, xy.y);
        moments[2u * plane + at] = vec4<f32>(xx, xy.z);
        moments[3u * plane + at] = vec4<f32>(yy, 0.0);
    }
#end
}
