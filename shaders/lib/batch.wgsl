// The next splats of a tile, fetched by all its lanes at once into workgroup memory: a walk from splat to splat would wait
// for two reads that hang on each other at every one of them.

// Splats of a batch.
const BATCH: u32 = 32u;

// Per splat: centre from the tile's first pixel, half_a, b; half_c, opacity, reach, -; red, green, blue, depth.
var<workgroup> batch: array<vec4<f32>, 3u * BATCH>;

// Fetches those from `begin` on, before `end`; a workgroupBarrier has to follow.
fn fetch_batch(begin: u32, end: u32, lane: u32, corner: vec2<f32>) {
    for (var i = lane; i < BATCH && begin + i < end; i += LANES) {
        let splat = projected[instances[begin + i]];
        let ellipse = ellipse_of(splat, corner);
        batch[3u * i] = vec4<f32>(ellipse.center, ellipse.half_a, ellipse.b);
        batch[3u * i + 1u] = vec4<f32>(ellipse.half_c, ellipse.opacity, ellipse.reach, 0.0);
        batch[3u * i + 2u] = vec4<f32>(splat.red, splat.green, splat.blue, splat.depth);
    }
}

fn ellipse_in_batch(i: u32) -> Ellipse {
    let first = batch[3u * i];
    let second = batch[3u * i + 1u];
    return Ellipse(first.xy, first.z, first.w, second.x, second.y, second.z);
}

fn payload_in_batch(i: u32) -> vec4<f32> {
    return batch[3u * i + 2u];
}
