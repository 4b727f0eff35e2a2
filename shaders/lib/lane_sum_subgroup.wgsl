// Sums over the lanes of a tile of an instance's three parts, each kept by the shader's `keep`; the workgroup is one subgroup.

#import subgroup_sums

fn store_sums(begin: u32, place: u32, lane: u32, geometry: vec4<f32>, conic: vec4<f32>, color: vec4<f32>) {
    let sums = subgroup_sums_of(geometry, conic, color);
    if lane == 0u {
        keep(place, 0u, sums.geometry);
        keep(place, 1u, sums.conic);
        keep(place, 2u, sums.color);
    }
}

// Nothing is left over: every instance was kept at once.
fn finish_sums(begin: u32, end: u32, lane: u32) {
}
