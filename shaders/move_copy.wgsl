// move_copy: places to fill -> copies of the splats that were drawn for them.
// After move_share. One thread per splat, or per place behind the last. Nobody's source is itself filled.

#import step
#import moves

@group(0) @binding(0) var<uniform> moves: Moves;
@group(0) @binding(1) var<storage, read> sources: array<u32>;
@group(0) @binding(2) var<storage, read_write> geometry: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> sh_rest: array<f32>;
@group(0) @binding(4) var<storage, read_write> moments: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> sh_moments: array<u32>;
@group(0) @binding(6) var<storage, read_write> anchors: array<u32>;

#import cleared

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let thread = flat(group, groups) * 256u + lane;
    let n_threads = select(moves.n_added, moves.n_splats, moves.n_added == 0u);
    if thread >= n_threads {
        return;
    }
    let source = sources[thread];
    if source == NOBODY {
        return;
    }
    let place = select(moves.n_splats + thread, thread, moves.n_added == 0u);
    for (var k = 0u; k < 4u; k += 1u) {
        geometry[4u * place + k] = geometry[4u * source + k];
    }
    let n = n_sh_rest(moves.sh_stored);
    for (var k = 0u; k < n; k += 1u) {
        sh_rest[place * n + k] = sh_rest[source * n + k];
    }
    clear_moments(place);
    moments[8u * place + 4u].w = moments[8u * source + 4u].w;
    anchors[place] = anchors[source];
}
