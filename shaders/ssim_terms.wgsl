// ssim_terms: moments blurred along rows -> SSIM, and the three maps that its gradient is made of.
// After ssim_rows. One thread per 4 pixels of a column. Equations: docs/GRADIENTS.md, loss.

#import step
#import ssim

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> moments: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> wanted: array<u32>;
// Three planes: derivative by the mean, by x^2, by xy; each times the pixel's weight.
@group(0) @binding(3) var<storage, read_write> terms: array<vec4<f32>>;
// Weighted sum of SSIM over each group's pixels and channels.
@group(0) @binding(4) var<storage, read_write> ssim_sums: array<f32>;

var<workgroup> sums: array<f32, 64>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let run = run_of_column(flat(group, groups) * 64u + lane);
    let x = run.x;
    let first = i32(run.y);
    let plane = step.width_px * step.height_px;
    var sum = 0.0;
#repeat t 14
    var m0_$t = vec4<f32>(0.0);
    var m1_$t = vec4<f32>(0.0);
    var m2_$t = vec4<f32>(0.0);
    var m3_$t = vec4<f32>(0.0);
    {
        let y = first + $t - REACH;
        if y >= 0 && y < i32(step.height_px) {
            let at = u32(y) * step.width_px + x;
            m0_$t = moments[at];
            m1_$t = moments[plane + at];
            m2_$t = moments[2u * plane + at];
            m3_$t = moments[3u * plane + at];
        }
    }
#end
#repeat j 4
    if first + $j < i32(step.height_px) {
        var m0 = vec4<f32>(0.0);
        var m1 = vec4<f32>(0.0);
        var m2 = vec4<f32>(0.0);
        var m3 = vec4<f32>(0.0);
#repeat t 11
        m0 += WINDOW[$t] * m0_$[j+t];
        m1 += WINDOW[$t] * m1_$[j+t];
        m2 += WINDOW[$t] * m2_$[j+t];
        m3 += WINDOW[$t] * m3_$[j+t];
#end
        let at = u32(first + $j) * step.width_px + x;
        let mx = m0.xyz;
        let my = m1.xyz;
        let xy = vec3<f32>(m0.w, m1.w, m2.w);
        let n1 = 2.0 * mx * my + C1;
        let n2 = 2.0 * (xy - mx * my) + C2;
        let d1 = mx * mx + my * my + C1;
        let d2 = (m2.xyz - mx * mx) + (m3.xyz - my * my) + C2;
        let inverse = 1.0 / (d1 * d2);
        let s = n1 * n2 * inverse;
        let by_mean = 2.0 * (my * n2 * inverse - mx * s / d1);
        let by_xx = -s / d2;
        let by_xy = 2.0 * n1 * inverse;
        let y = u32(first + $j);
        let margin = step.ssim_margin;
        let is_inside = x >= margin && x + margin < step.width_px && y >= margin && y + margin < step.height_px;
        let weight = select(0.0, unpack4x8unorm(wanted[at]).w, is_inside);
        terms[at] = vec4<f32>(weight * (by_mean - 2.0 * mx * by_xx - my * by_xy), 0.0);
        terms[plane + at] = vec4<f32>(weight * by_xx, 0.0);
        terms[2u * plane + at] = vec4<f32>(weight * by_xy, 0.0);
        sum += weight * (s.x + s.y + s.z);
    }
#end
    sums[lane] = sum;
    workgroupBarrier();
    if lane == 0u {
        var total = 0.0;
        for (var other = 0u; other < 64u; other += 1u) {
            total += sums[other];
        }
        ssim_sums[flat(group, groups)] = total;
    }
}
