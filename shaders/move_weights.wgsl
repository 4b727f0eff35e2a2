// move_weights: splats -> the weight of each in the draw, and which are dead.
// First stage of MCMC moves; scans of both follow. One thread per splat.

#import step
#import moves
#import sh

@group(0) @binding(0) var<uniform> moves: Moves;
@group(0) @binding(1) var<storage, read> geometry: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> sh_rest: array<f32>;
@group(0) @binding(3) var<storage, read_write> weights: array<u32>;
@group(0) @binding(4) var<storage, read_write> dead: array<u32>;
// Copies that each splat is drawn for.
@group(0) @binding(5) var<storage, read_write> shares: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = flat(group, groups) * 256u + lane;
    if splat_ix >= moves.n_splats {
        return;
    }
    let at = 4u * splat_ix;
    let mean = geometry[at];
    let base = geometry[at + 3u];
    var is_live = is_finite4(mean) && is_finite4(geometry[at + 1u]) && is_finite3(geometry[at + 2u].xyz) && is_finite3(base.xyz);
    let n = n_sh_rest(moves.sh_stored);
    for (var k = 0u; k < n; k += 1u) {
        is_live = is_live && is_finite(sh_rest[splat_ix * n + k]);
    }
    let opacity = 1.0 / (1.0 + exp(-mean.w));
    is_live = is_live && opacity > moves.min_opacity;
    let unseen = moves.n_steps - u32(base.w);
    let is_source = is_live && (moves.active_steps == 0u || unseen < moves.active_steps);
    weights[splat_ix] = select(0u, u32(opacity * f32(1u << moves.weight_bits)), is_source);
    dead[splat_ix] = select(1u, 0u, is_live);
    shares[splat_ix] = 0u;
}
