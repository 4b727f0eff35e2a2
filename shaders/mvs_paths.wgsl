// mvs_paths: matching costs -> their sums along eight paths (Hirschmueller 2008, eq. 13).
// After mvs_cost. One workgroup per path, one thread per word of four planes of a pixel (per four such words with more
// than 128 planes). Whole numbers, whose sum is the same in any order.

#import sweep

@group(0) @binding(0) var<uniform> sweep: Sweep;
@group(0) @binding(1) var<storage, read> costs: array<u32>;
// Penalty for a jump between a pixel and the one left, above left, above, above right: a byte each.
@group(0) @binding(2) var<storage, read> penalties: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<atomic<u32>>;

const MAX_WORDS: u32 = MAX_SWEEP_PLANES / 4u;
// Words of one step of the path, with a border on both sides.
const STRIDE: u32 = MAX_WORDS + 2u;
// Cost of planes that do not exist: never wins, and a penalty on top still fits.
const BORDER: u32 = 32767u;

// Of this step and of the one before: the costs of each word's first and last plane.
var<workgroup> firsts: array<u32, 2u * STRIDE>;
var<workgroup> lasts: array<u32, 2u * STRIDE>;
// Of this step, of the one before, and of the next, which is being cleared.
var<workgroup> lowest: array<atomic<u32>, 3>;

struct Route {
    x: i32,
    y: i32,
    dx: i32,
    dy: i32,
}

// Two along each row, then six down or up each column; the slanted ones enter anew on the other side.
fn route_of(path: u32) -> Route {
    let width = i32(sweep.width_px);
    let height = i32(sweep.height_px);
    if path < 2u * sweep.height_px {
        let y = i32(path / 2u);
        if path % 2u == 0u {
            return Route(0, y, 1, 0);
        }
        return Route(width - 1, y, -1, 0);
    }
    let rest = path - 2u * sweep.height_px;
    let x = i32(rest / 6u);
    let dx = i32(rest % 3u) - 1;
    if rest % 6u < 3u {
        return Route(x, 0, dx, 1);
    }
    return Route(x, height - 1, dx, -1);
}

// Which byte of `penalties` joins a pixel with the one before it on the path; it is kept by the right or lower one.
fn penalty_at(x: i32, y: i32, route: Route) -> u32 {
    let is_keeper = route.dy > 0 || (route.dy == 0 && route.dx > 0);
    let keeper = select(vec2<i32>(x - route.dx, y - route.dy), vec2<i32>(x, y), is_keeper);
    var byte = 0u;
    if route.dy != 0 {
        byte = u32(2 - route.dx * route.dy);
    }
    return (penalties[u32(keeper.y) * sweep.width_px + u32(keeper.x)] >> (8u * byte)) & 255u;
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let path = flat(group, groups);
    // The last groups of a split dispatch may lie behind the end.
    if path >= 2u * sweep.height_px + 6u * sweep.width_px {
        return;
    }
    let route = route_of(path);
    let n_steps = select(sweep.height_px, sweep.width_px, route.dy == 0);
    for (var ix = lane; ix < 2u * STRIDE; ix += 32u) {
        firsts[ix] = BORDER;
        lasts[ix] = BORDER;
    }
    if lane < 3u {
        atomicStore(&lowest[lane], BORDER);
    }
    workgroupBarrier();
    var x = route.x;
    var y = route.y;
    var is_start = true;
#repeat c 4
    var path_$c = vec4<u32>(0u);
#end
    for (var step = 0u; step < n_steps; step += 1u) {
        let here = u32(y) * sweep.width_px + u32(x);
        var floor = 0u;
        var ceiling = 0u;
        if !is_start {
            floor = atomicLoad(&lowest[(step + 2u) % 3u]);
            ceiling = floor + penalty_at(x, y, route);
        }
        if lane == 0u {
            atomicStore(&lowest[(step + 1u) % 3u], BORDER);
        }
        let now = step % 2u * STRIDE;
        let before = STRIDE - now;
#repeat c 4
        if 32u * $cu + lane < sweep.n_words {
            let word = 32u * $cu + lane;
            let packed = costs[here * sweep.n_words + word];
            var cost = (vec4<u32>(packed) >> vec4<u32>(0u, 8u, 16u, 24u)) & vec4<u32>(255u);
            if !is_start {
                let below = vec4<u32>(lasts[before + word], path_$c.xyz);
                let above = vec4<u32>(path_$c.yzw, firsts[before + word + 2u]);
                let moved = min(below, above) + sweep.small_step;
                cost += min(min(path_$c, moved), vec4<u32>(ceiling)) - floor;
            }
            let is_plane = 4u * word + vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(sweep.n_planes);
            path_$c = select(vec4<u32>(BORDER), cost, is_plane);
            firsts[now + word + 1u] = path_$c.x;
            lasts[now + word + 1u] = path_$c.w;
            atomicMin(&lowest[step % 3u], min(min(path_$c.x, path_$c.y), min(path_$c.z, path_$c.w)));
            let added = select(vec4<u32>(0u), cost, is_plane);
            let at = 2u * (here * sweep.n_words + word);
            atomicAdd(&sums[at], added.x | (added.y << 16u));
            atomicAdd(&sums[at + 1u], added.z | (added.w << 16u));
        }
#end
        workgroupBarrier();
        x += route.dx;
        y += route.dy;
        let is_beyond = x < 0 || x >= i32(sweep.width_px);
        is_start = route.dy != 0 && is_beyond;
        if is_start {
            x = select(0, i32(sweep.width_px) - 1, x < 0);
        }
    }
}
