// raster: splats of each tile, near to far -> colour, transmittance and summed depth of its pixels.
// After ranges. One workgroup per tile. Equations: docs/GRADIENTS.md, compositing.

#import step
#import camera
#import shape
#import projected
#import blend
#import batch

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> projected: array<Projected>;
@group(0) @binding(2) var<storage, read> instances: array<u32>;
@group(0) @binding(3) var<storage, read> tile_ranges: array<vec2<u32>>;
// r, g, b, transmittance.
@group(0) @binding(4) var<storage, read_write> image: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> depth_sum: array<f32>;
// Splats looked at before the whole tile had stopped; the host clears them.
@group(0) @binding(6) var<storage, read_write> n_used: array<atomic<u32>>;

// Whether a pixel of the tile has not stopped, by turns.
var<workgroup> is_open: array<atomic<u32>, 2>;

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = flat(group, groups);
    if tile >= step.n_tiles_x * step.n_tiles_y {
        return;
    }
    let first = vec2<u32>(tile % step.n_tiles_x, tile / step.n_tiles_x) * TILE_PX;
    let corner = vec2<f32>(first);
    let size_px = vec2<f32>(f32(step.width_px), f32(step.height_px));
    let range = tile_ranges[tile];
#repeat i PIXELS
    // Negative once the pixel has stopped; off the image it has from the start.
    var t_$i = select(-1.0, 1.0, all(corner + pixel_in_tile($iu, lane) < size_px));
    var light_$i = vec4<f32>(0.0);
#end
    if lane < 2u {
        atomicStore(&is_open[lane], 0u);
    }
    workgroupBarrier();
    var begin = range.x;
    var n_looked_at = 0u;
    var turn = 0u;
    var most = -1.0;
#repeat i PIXELS
    most = max(most, t_$i);
#end
    loop {
        if most > 0.0 {
            atomicStore(&is_open[turn], 1u);
        }
        fetch_batch(begin, range.y, lane, corner);
        workgroupBarrier();
        // The same for all lanes: pixels of the tile that have not stopped, and splats that are left.
        if begin >= range.y || atomicLoad(&is_open[turn]) == 0u {
            break;
        }
        if lane == 0u {
            atomicStore(&is_open[1u - turn], 0u);
        }
        let n = min(BATCH, range.y - begin);
        var k = 0u;
        while k < n && most > 0.0 {
            let end = min(k + SPLATS_PER_LOOK, n);
            for (; k < end; k += 1u) {
                let ellipse = ellipse_in_batch(k);
                let payload = payload_in_batch(k);
#repeat i PIXELS
                let d_$i = ellipse.center - pixel_in_tile($iu, lane);
                if abs(d_$i.y) <= ellipse.reach {
                    let alpha = min(raw_alpha(ellipse, d_$i), MAX_ALPHA);
                    let next = t_$i * (1.0 - alpha);
                    let is_over = next <= MIN_TRANSMITTANCE;
                    light_$i += select(alpha * t_$i, 0.0, is_over) * payload;
                    t_$i = select(next, -abs(t_$i), is_over);
                }
#end
            }
            most = -1.0;
#repeat i PIXELS
            most = max(most, t_$i);
#end
        }
        n_looked_at = select(n_looked_at, begin - range.x + k, k > 0u);
        workgroupBarrier();
        begin += BATCH;
        turn = 1u - turn;
    }
    atomicMax(&n_used[tile], n_looked_at);
#repeat i PIXELS
    {
        let at = first + vec2<u32>(pixel_in_tile($iu, lane));
        if at.x < step.width_px && at.y < step.height_px {
            let pixel = at.y * step.width_px + at.x;
            image[pixel] = vec4<f32>(light_$i.xyz, abs(t_$i));
            depth_sum[pixel] = light_$i.w;
        }
    }
#end
}
