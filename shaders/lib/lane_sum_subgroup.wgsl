// Sums over the lanes of a tile into the slot of an instance; the workgroup is one subgroup.

fn store_sums(place: u32, lane: u32, geometry: vec4<f32>, conic: vec4<f32>, color: vec4<f32>) {
    let geometry_sum = subgroupAdd(geometry);
    let conic_sum = subgroupAdd(conic);
    let color_sum = subgroupAdd(color);
    if lane == 0u {
        slots[3u * place] = geometry_sum;
        slots[3u * place + 1u] = conic_sum;
        slots[3u * place + 2u] = color_sum;
    }
}
