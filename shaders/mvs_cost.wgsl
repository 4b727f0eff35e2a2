// mvs_cost: reference and source images -> matching cost of each pixel on each plane, a byte each.
// First stage of a sweep. One workgroup per tile of 32x16 pixels and word of four planes, one thread per column of 8
// pixels. A cost is 1 - score: ZNCC over the window and likeness of the pixel itself, mean of the best two sources.

#import sweep

@group(0) @binding(0) var<uniform> sweep: Sweep;
// The reference; then each source and the reference in its light; -0.5 to 0.5.
@group(0) @binding(1) var<storage, read> luma: array<f32>;
// Of the window around each reference pixel: sum, n * variance + noise, 1/n; and how far off its
// luma may be.
@group(0) @binding(2) var<storage, read> statistics: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> warps: array<Warp>;
// By source and plane.
@group(0) @binding(4) var<storage, read> starts: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> costs: array<u32>;

const SWEEP_WINDOW: u32 = 5u;
const SWEEP_TILE_X: u32 = 32u;
const SWEEP_TILE_Y: u32 = 16u;
// Pixels of a thread, one above the other.
const RUN: u32 = 8u;
// A tile with the windows of its outermost pixels.
const PATCH_X: u32 = SWEEP_TILE_X + SWEEP_WINDOW - 1u;
const PATCH_Y: u32 = SWEEP_TILE_Y + SWEEP_WINDOW - 1u;
const N_PATCH: u32 = PATCH_X * PATCH_Y;

// Source, warped, and reference. 0 outside of the reference image: what lies there adds nothing to any sum.
var<workgroup> patches: array<vec2<f32>, N_PATCH>;

fn is_in_reference(at: vec2<i32>) -> bool {
    return at.x >= 0 && at.y >= 0 && at.x < i32(sweep.width_px) && at.y < i32(sweep.height_px);
}

// Pixel in the source; z says whether it lies in the image.
fn pixel_in_source(warp: Warp, start: vec3<f32>, at: vec2<i32>) -> vec3<f32> {
    let there = start + f32(at.y) * warp.step_y.xyz + f32(at.x) * warp.step_x.xyz;
    let pixel = there.xy * (1.0 / max(there.z, 1e-6));
    let last = vec2<f32>(f32(warp.width_px - 1u), f32(warp.height_px - 1u));
    // Half a pixel beyond the outermost centres still belongs to the image.
    let is_inside = there.z > 1e-6 && all(pixel >= vec2<f32>(-0.5)) && all(pixel <= last + 0.5);
    return vec3<f32>(clamp(pixel, vec2<f32>(0.0), last), select(0.0, 1.0, is_inside));
}

fn luma_in_source(warp: Warp, pixel: vec2<f32>) -> f32 {
    let corner = min(floor(pixel), vec2<f32>(f32(warp.width_px - 2u), f32(warp.height_px - 2u)));
    let share = pixel - corner;
    let at = warp.first + u32(corner.y) * warp.width_px + u32(corner.x);
    let above = mix_exactly(luma[at], luma[at + 1u], share.x);
    let below = mix_exactly(luma[at + warp.width_px], luma[at + warp.width_px + 1u], share.x);
    return mix_exactly(above, below, share.y);
}

// As the host does it; `mix` may be computed in other ways.
fn mix_exactly(a: f32, b: f32, share: f32) -> f32 {
    return a + (b - a) * share;
}

fn patch_pixel(tile_from: vec2<i32>, ix: u32) -> vec2<i32> {
    return tile_from + vec2<i32>(i32(ix % PATCH_X), i32(ix / PATCH_X)) - i32(SWEEP_WINDOW / 2u);
}

// Of the sums over a window, the same window of the reference, and the pixel in the middle: in the source, and in the
// reference as the source shows it.
fn score_of(sums: vec3<f32>, window: vec4<f32>, own: f32, shown: f32) -> f32 {
    let spread = max(sums.y - sums.x * sums.x * window.z, 0.0) + sweep.noise_variance / window.z;
    let zncc = (sums.z - window.x * sums.x * window.z) / sqrt(window.y * spread);
    let off = max(abs(shown - own) - window.w, 0.0);
    let like = 1.0 - min(off / sweep.most_off, 1.0);
    return zncc + sweep.own_share * (like - max(zncc, 0.0));
}

fn cost_of(best: f32, found: f32) -> u32 {
    let second = select(min(best, sweep.unseen_zncc), found, found > -1.0);
    let zncc = select(sweep.unseen_zncc, 0.5 * (best + second), best > -1.0);
    return u32((1.0 - clamp(zncc, 0.0, 1.0)) * 255.0 + 0.5);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let n_tiles_x = (sweep.width_px + SWEEP_TILE_X - 1u) / SWEEP_TILE_X;
    let tile = flat(group, groups) / sweep.n_words;
    let word = flat(group, groups) % sweep.n_words;
    let tile_from = vec2<i32>(i32(tile % n_tiles_x * SWEEP_TILE_X), i32(tile / n_tiles_x * SWEEP_TILE_Y));
    // The last groups of a split dispatch may lie behind the end.
    if tile_from.y >= i32(sweep.height_px) {
        return;
    }
    for (var ix = lane; ix < N_PATCH; ix += 64u) {
        let at = patch_pixel(tile_from, ix);
        var value = 0.0;
        if is_in_reference(at) {
            value = luma[u32(at.y) * sweep.width_px + u32(at.x)];
        }
        patches[ix].y = value;
    }
    let column = lane % SWEEP_TILE_X;
    let row = lane / SWEEP_TILE_X * RUN;
    let own = tile_from + vec2<i32>(i32(column), i32(row));
    let last = vec2<i32>(i32(sweep.width_px), i32(sweep.height_px)) - 1;
#repeat k 8
    var packed_$k = 0u;
    // Pixels outside of the image do as the nearest one, and keep nothing.
    let at_$k = min(own + vec2<i32>(0, $k), last);
    let window_$k = statistics[u32(at_$k.y) * sweep.width_px + u32(at_$k.x)];
#end
    for (var in_word = 0u; in_word < 4u; in_word += 1u) {
        let plane = 4u * word + in_word;
        if plane >= sweep.n_planes {
            break;
        }
#repeat k 8
        var best_$k = -1.0;
        var second_$k = -1.0;
#end
        for (var source = 0u; source < sweep.n_sources; source += 1u) {
            let warp = warps[source];
            let start = starts[source * sweep.n_planes + plane].xyz;
            // The patch before may still be read.
            workgroupBarrier();
            for (var ix = lane; ix < N_PATCH; ix += 64u) {
                let at = patch_pixel(tile_from, ix);
                var value = 0.0;
                if is_in_reference(at) {
                    value = luma_in_source(warp, pixel_in_source(warp, start, at).xy);
                }
                patches[ix].x = value;
            }
            workgroupBarrier();
            // Source, source squared, source times reference: along the rows of the window, then down.
#repeat j 12
            var across_$j = vec3<f32>(0.0);
            {
                let first = (row + $ju) * PATCH_X + column;
#repeat t 5
                let pair_$t = patches[first + $tu];
                across_$j += pair_$t.x * vec3<f32>(1.0, pair_$t);
#end
            }
#end
#repeat k 8
            {
                var sums = vec3<f32>(0.0);
#repeat t 5
                sums += across_$[k+t];
#end
                // -1 where the source does not see the point.
                let is_seen = pixel_in_source(warp, start, at_$k).z > 0.0;
                let middle = patches[(row + $ku + SWEEP_WINDOW / 2u) * PATCH_X + column + SWEEP_WINDOW / 2u].x;
                let shown = luma[warp.shown + u32(at_$k.y) * sweep.width_px + u32(at_$k.x)];
                let score = select(-1.0, score_of(sums, window_$k, middle, shown), is_seen);
                second_$k = max(second_$k, min(score, best_$k));
                best_$k = max(best_$k, score);
            }
#end
        }
#repeat k 8
        packed_$k |= cost_of(best_$k, second_$k) << (8u * in_word);
#end
    }
#repeat k 8
    if is_in_reference(own + vec2<i32>(0, $k)) {
        costs[(u32(own.y + $k) * sweep.width_px + u32(own.x)) * sweep.n_words + word] = packed_$k;
    }
#end
}
