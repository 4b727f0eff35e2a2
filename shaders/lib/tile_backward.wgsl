// Way back through one tile: near to far as `raster` went, with nothing of the way there kept. The shader says by
// `keep(instance, part, sum)` where the three sums of an instance go.

#import step
#import shape
#import projected
#import blend
#import batch
#import lane_sum

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> projected: array<Projected>;
@group(0) @binding(2) var<storage, read> instances: array<u32>;
@group(0) @binding(3) var<storage, read> tile_ranges: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> n_used: array<u32>;
// By r, g, b and the depth sum.
@group(0) @binding(5) var<storage, read> v_image: array<vec4<f32>>;
// What lies behind the first splat, seen through the gradient, less the transmittance's part.
@group(0) @binding(6) var<storage, read> behind_all: array<f32>;

// The first instance behind those that `raster` blended.
fn end_of(tile: u32) -> u32 {
    return tile_ranges[tile].x + n_used[tile];
}

fn walk_back(tile: u32, lane: u32) {
    let first = vec2<u32>(tile % step.n_tiles_x, tile / step.n_tiles_x) * TILE_PX;
    let corner = vec2<f32>(first);
    let begin = tile_ranges[tile].x;
    let end = end_of(tile);
#repeat i PIXELS
    var t_$i = -1.0;
    var v_$i = vec4<f32>(0.0);
    var behind_$i = 0.0;
    {
        let at = first + vec2<u32>(pixel_in_tile($iu, lane));
        if at.x < step.width_px && at.y < step.height_px {
            let pixel = at.y * step.width_px + at.x;
            t_$i = 1.0;
            v_$i = v_image[pixel];
            behind_$i = behind_all[pixel];
        }
    }
#end
    for (var first_of_batch = begin; first_of_batch < end; first_of_batch += BATCH) {
        fetch_batch(first_of_batch, end, lane, corner);
        workgroupBarrier();
        let end_of_batch = min(first_of_batch + BATCH, end);
        for (var k = first_of_batch; k < end_of_batch; k += 1u) {
            let ellipse = ellipse_in_batch(k - first_of_batch);
            let payload = payload_in_batch(k - first_of_batch);
            // v_sigma times 1, dx, dy; dx^2, dx dy, dy^2; weight times the pixel's gradient.
            var moments = vec3<f32>(0.0);
            var squares = vec3<f32>(0.0);
            var lights = vec4<f32>(0.0);
#repeat i PIXELS
            let d_$i = ellipse.center - pixel_in_tile($iu, lane);
            if abs(d_$i.y) <= ellipse.reach {
                let d = d_$i;
                let raw = raw_alpha(ellipse, d);
                let alpha = min(raw, MAX_ALPHA);
                let next = t_$i * (1.0 - alpha);
                let is_over = next <= MIN_TRANSMITTANCE;
                let weight = select(alpha * t_$i, 0.0, is_over);
                let worth = dot(payload, v_$i);
                behind_$i -= weight * worth;
                let v_alpha = t_$i * worth - behind_$i / (1.0 - alpha);
                let v_sigma = select(-raw * v_alpha, 0.0, is_over || raw > MAX_ALPHA);
                lights += weight * v_$i;
                let v_d = v_sigma * d;
                moments += vec3<f32>(v_sigma, v_d);
                squares += vec3<f32>(v_d.x * d.x, v_d.x * d.y, v_d.y * d.y);
                t_$i = select(next, -abs(t_$i), is_over);
            }
#end
            store_sums(begin, k, lane, vec4<f32>(moments, lights.w), vec4<f32>(squares, 0.0), vec4<f32>(lights.xyz, 0.0));
        }
        workgroupBarrier();
    }
    finish_sums(begin, end, lane);
}
