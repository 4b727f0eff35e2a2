// Sums over the lanes of a tile of an instance's three parts, each kept by the shader's `keep`, through workgroup memory: for any subgroup size.

var<workgroup> lane_values: array<vec4<f32>, 3u * LANES>;

fn store_sums(begin: u32, place: u32, lane: u32, geometry: vec4<f32>, conic: vec4<f32>, color: vec4<f32>) {
    lane_values[lane] = geometry;
    lane_values[LANES + lane] = conic;
    lane_values[2u * LANES + lane] = color;
    workgroupBarrier();
    if lane < 3u {
        var sum = vec4<f32>(0.0);
        for (var other = 0u; other < LANES; other += 1u) {
            sum += lane_values[lane * LANES + other];
        }
        keep(place, lane, sum);
    }
    workgroupBarrier();
}

// Nothing is left over: every instance was kept at once.
fn finish_sums(begin: u32, end: u32, lane: u32) {
}
