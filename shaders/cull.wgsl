// cull: splats and a camera -> one bit per splat that is visible, and how many of each 256.
// First stage of an image. One thread per splat. Equations: docs/GRADIENTS.md, projection.

#import step
#import shape

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read> geometry: array<vec4<f32>>;
// Eight words per group.
@group(0) @binding(3) var<storage, read_write> visible_bits: array<u32>;
@group(0) @binding(4) var<storage, read_write> block_counts: array<u32>;

var<workgroup> bits: array<atomic<u32>, 8>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = flat(group, groups);
    if lane < 8u {
        atomicStore(&bits[lane], 0u);
    }
    workgroupBarrier();
    let splat_ix = block * 256u + lane;
    if splat_ix < step.n_splats {
        let at = 4u * splat_ix;
        let mean = geometry[at];
        // Most of a large map lies elsewhere: nothing more of those is read.
        if in_camera(camera, mean.xyz).z > max(step.near, NEAR) {
            let size_px = vec2<f32>(f32(step.width_px), f32(step.height_px));
            let shape = shape_of(camera, mean, geometry[at + 1u], geometry[at + 2u].xyz, size_px);
            if shape.is_seen {
                atomicOr(&bits[lane / 32u], 1u << (lane % 32u));
            }
        }
    }
    workgroupBarrier();
    // The last group of a split dispatch may lie behind the end.
    if block * 256u >= step.n_splats {
        return;
    }
    if lane < 8u {
        visible_bits[block * 8u + lane] = atomicLoad(&bits[lane]);
    }
    if lane == 0u {
        var n = 0u;
        for (var word = 0u; word < 8u; word += 1u) {
            n += countOneBits(atomicLoad(&bits[word]));
        }
        block_counts[block] = n;
    }
}
