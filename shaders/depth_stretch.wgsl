// depth_stretch: rendered depth or alpha against the depth map, each stretched to 0..1 -> their part of the gradient.
// After photo_gradient, only when the step compares as the paper does. One workgroup: this is for comparison, and a
// hundredth of a step. Equations: docs/GRADIENTS.md, losses.

#import step
#import depth_map

const PAPER_ALPHA: u32 = 2u;
// What spans less, relative to its largest number, is flat: stretching it would amplify rounding.
const MIN_RELATIVE_RANGE: f32 = 1e-3;
const LARGEST: f32 = 3.4e38;

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> depth_sum: array<f32>;
@group(0) @binding(3) var<storage, read> wanted: array<u32>;
@group(0) @binding(4) var<storage, read_write> v_image: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> behind: array<f32>;
@group(0) @binding(6) var<storage, read_write> loss_sums: array<vec4<f32>>;

struct Pixel {
    is_compared: bool,
    alpha: f32,
    rendered: f32,
    wanted: f32,
}

var<workgroup> lows: array<vec4<f32>, 256>;
var<workgroup> highs: array<vec2<f32>, 256>;
var<workgroup> low_ixs: array<u32, 256>;
var<workgroup> high_ixs: array<u32, 256>;
var<workgroup> sums: array<vec4<f32>, 256>;

fn pixel_at(p: u32) -> Pixel {
    let given = depth_and_confidence(p % step.width_px, p / step.width_px);
    let depth = given.x;
    let alpha = 1.0 - image[p].w;
    // All pixels that have a depth and count, verified or not, whatever the map covers.
    if depth <= 0.0 || unpack4x8unorm(wanted[p]).w <= 0.0 {
        return Pixel(false, alpha, 0.0, 0.0);
    }
    if step.depth_mode == PAPER_ALPHA {
        return Pixel(true, alpha, alpha, depth);
    }
    // 1 - minmax(1/d) is minmax(-1/d).
    if alpha <= 0.0 {
        return Pixel(true, alpha, 0.0, -1.0 / depth);
    }
    return Pixel(true, alpha, depth_sum[p] / alpha, -1.0 / depth);
}

fn is_flat(low: f32, high: f32) -> bool {
    let width = high - low;
    return !(is_finite(width) && width > MIN_RELATIVE_RANGE * max(abs(low), abs(high)));
}

fn put(p: u32, pixel: Pixel, v: f32) {
    var v_z = 0.0;
    var v_alpha = v;
    if step.depth_mode != PAPER_ALPHA {
        // Where there is no splat there is nothing to move.
        if pixel.alpha <= 0.0 {
            return;
        }
        v_z = v / pixel.alpha;
        v_alpha = -v * pixel.rendered / pixel.alpha;
    }
    v_image[p].w += v_z;
    behind[p] += depth_sum[p] * v_z - image[p].w * v_alpha;
}

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n = step.width_px * step.height_px;
    // Rendered and wanted.
    var low = vec2<f32>(LARGEST);
    var high = vec2<f32>(-LARGEST);
    var low_ix = n;
    var high_ix = n;
    for (var p = lane; p < n; p += 256u) {
        let pixel = pixel_at(p);
        if pixel.is_compared {
            if pixel.rendered < low.x {
                low_ix = p;
            }
            if pixel.rendered > high.x {
                high_ix = p;
            }
            low = min(low, vec2<f32>(pixel.rendered, pixel.wanted));
            high = max(high, vec2<f32>(pixel.rendered, pixel.wanted));
        }
    }
    lows[lane] = vec4<f32>(low, 0.0, 0.0);
    highs[lane] = high;
    low_ixs[lane] = low_ix;
    high_ixs[lane] = high_ix;
    workgroupBarrier();
    if lane == 0u {
        for (var other = 1u; other < 256u; other += 1u) {
            let l = lows[other].xy;
            let h = highs[other];
            if l.x < low.x || (l.x == low.x && low_ixs[other] < low_ix) {
                low_ix = low_ixs[other];
            }
            if h.x > high.x || (h.x == high.x && high_ixs[other] < high_ix) {
                high_ix = high_ixs[other];
            }
            low = min(low, l);
            high = max(high, h);
        }
        lows[0] = vec4<f32>(low, 0.0, 0.0);
        highs[0] = high;
        low_ixs[0] = low_ix;
        high_ixs[0] = high_ix;
    }
    workgroupBarrier();
    low = lows[0].xy;
    high = highs[0];
    let is_empty = low_ixs[0] == n || is_flat(low.x, high.x) || is_flat(low.y, high.y);
    var sum = vec4<f32>(0.0);
    for (var p = lane; p < n && !is_empty; p += 256u) {
        let pixel = pixel_at(p);
        if pixel.is_compared {
            let stretched = (vec2<f32>(pixel.rendered, pixel.wanted) - low) / (high - low);
            let difference = stretched.x - stretched.y;
            // All move when the ends do.
            sum += vec4<f32>(abs(difference), 1.0, -sign(difference) * (1.0 - stretched.x), -sign(difference) * stretched.x);
        }
    }
    sums[lane] = sum;
    workgroupBarrier();
    if lane == 0u {
        for (var other = 1u; other < 256u; other += 1u) {
            sum += sums[other];
        }
        sums[0] = sum;
    }
    workgroupBarrier();
    if is_empty {
        return;
    }
    let total = sums[0];
    let scale = step.depth_weight / total.y / (high.x - low.x);
    for (var p = lane; p < n; p += 256u) {
        let pixel = pixel_at(p);
        if pixel.is_compared {
            let stretched = (vec2<f32>(pixel.rendered, pixel.wanted) - low) / (high - low);
            var v = sign(stretched.x - stretched.y);
            v += select(0.0, total.z, p == low_ixs[0]);
            v += select(0.0, total.w, p == high_ixs[0]);
            put(p, pixel, scale * v);
        }
    }
    if lane == 0u {
        loss_sums[0].y += total.x / total.y;
    }
}
