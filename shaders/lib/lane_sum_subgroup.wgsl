// Sums over the lanes of a tile of an instance's three parts, each kept by the shader's `keep`; the workgroup is one subgroup.

fn store_sums(begin: u32, place: u32, lane: u32, geometry: vec4<f32>, conic: vec4<f32>, color: vec4<f32>) {
    var geometry_sum = vec4<f32>(0.0);
    var conic_sum = vec4<f32>(0.0);
    var color_sum = vec4<f32>(0.0);
    // Many splats of a tile miss all pixels of a subgroup.
    if subgroupAny(any(geometry != vec4<f32>(0.0)) || any(conic != vec4<f32>(0.0)) || any(color != vec4<f32>(0.0))) {
        geometry_sum = subgroupAdd(geometry);
        conic_sum = vec4<f32>(subgroupAdd(conic.xyz), 0.0);
        color_sum = vec4<f32>(subgroupAdd(color.xyz), 0.0);
    }
    if lane == 0u {
        keep(place, 0u, geometry_sum);
        keep(place, 1u, conic_sum);
        keep(place, 2u, color_sum);
    }
}

// Nothing is left over: every instance was kept at once.
fn finish_sums(begin: u32, end: u32, lane: u32) {
}
