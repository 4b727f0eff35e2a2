// Sums over the lanes of a tile of an instance's three parts, each kept by the shader's `keep`; the workgroup is one subgroup.

fn store_sums(place: u32, lane: u32, geometry: vec4<f32>, conic: vec4<f32>, color: vec4<f32>) {
    let geometry_sum = subgroupAdd(geometry);
    let conic_sum = subgroupAdd(conic);
    let color_sum = subgroupAdd(color);
    if lane == 0u {
        keep(place, 0u, geometry_sum);
        keep(place, 1u, conic_sum);
        keep(place, 2u, color_sum);
    }
}
