// project: visible splats -> ellipses on the image with colour and depth, in order of their index.
// After cull. One thread per splat. Equations: docs/GRADIENTS.md, projection.

#import step
#import shape
#import projected
#import sh

// A colour beyond this is a broken splat; its square would take SSIM, and with it the whole image, to infinity.
const MAX_COLOR: f32 = 1e4;

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> camera: Camera;
@group(0) @binding(2) var<storage, read> geometry: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> sh_rest: array<f32>;
@group(0) @binding(4) var<storage, read> visible_bits: array<u32>;
@group(0) @binding(5) var<storage, read> block_offsets: array<u32>;
@group(0) @binding(6) var<storage, read_write> projected: array<Projected>;
@group(0) @binding(7) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> depth_values: array<u32>;

fn color_of(base: vec3<f32>, splat_ix: u32, direction: vec3<f32>) -> vec3<f32> {
    var color = 0.5 + SH_C0 * base;
    if step.sh_degree == 0u {
        return color;
    }
    let basis = sh_basis(direction);
    let first = splat_ix * n_sh_rest(step.sh_stored);
    let n = n_sh_rest(step.sh_degree) / 3u;
    // Written out, so that the basis stays in registers.
#repeat b 15
    if $bu < n {
        let at = first + 3u * $bu;
        color += basis[$b] * vec3<f32>(sh_rest[at], sh_rest[at + 1u], sh_rest[at + 2u]);
    }
#end
    return color;
}

fn count_tiles(splat: Projected, tiles: vec4<u32>) -> u32 {
    var n = 0u;
    for (var y = tiles.y; y < tiles.w; y += 1u) {
        for (var x = tiles.x; x < tiles.z; x += 1u) {
            n += select(0u, 1u, touches(splat, vec2<u32>(x, y)));
        }
    }
    return n;
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = flat(group, groups);
    let splat_ix = block * 256u + lane;
    if splat_ix >= step.n_splats {
        return;
    }
    let word = visible_bits[block * 8u + lane / 32u];
    let bit = 1u << (lane % 32u);
    if (word & bit) == 0u {
        return;
    }
    var visible_ix = block_offsets[block] + countOneBits(word & (bit - 1u));
    for (var before = 0u; before < lane / 32u; before += 1u) {
        visible_ix += countOneBits(visible_bits[block * 8u + before]);
    }
    let at = 4u * splat_ix;
    let mean = geometry[at];
    let size_px = vec2<f32>(f32(step.width_px), f32(step.height_px));
    let shape = shape_of(camera, mean, geometry[at + 1u], geometry[at + 2u].xyz, size_px);
    let color = color_of(geometry[at + 3u].xyz, splat_ix, normalize(mean.xyz - camera.center.xyz));
    let is_sound = is_finite3(color) && all(abs(color) < vec3<f32>(MAX_COLOR));
    var out: Projected;
    out.center_px = shape.center_px;
    out.depth = shape.in_cam.z;
    out.opacity = select(0.0, shape.opacity, is_sound);
    out.conic_a = shape.cov.z / shape.det;
    out.conic_b = -shape.cov.y / shape.det;
    out.conic_c = shape.cov.x / shape.det;
    out.splat_ix = splat_ix;
    out.red = max(color.x, 0.0);
    out.green = max(color.y, 0.0);
    out.blue = max(color.z, 0.0);
    out.cut = shape.cut;
    out.extent_px = shape.extent_px;
    out.first_instance = 0u;
    if is_sound {
        out.n_tiles = count_tiles(out, tiles_of(out.center_px, out.extent_px, size_px));
    }
    projected[visible_ix] = out;
    // Depths are positive, so that their bits order as they do.
    depth_keys[visible_ix] = bitcast<u32>(out.depth);
    depth_values[visible_ix] = visible_ix;
}
