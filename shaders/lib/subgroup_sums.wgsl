// Sums over one subgroup of the three parts of an instance's gradient.

struct SubgroupSums {
    geometry: vec4<f32>,
    conic: vec4<f32>,
    color: vec4<f32>,
}

fn subgroup_sums_of(geometry: vec4<f32>, conic: vec4<f32>, color: vec4<f32>) -> SubgroupSums {
    var sums = SubgroupSums(vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0));
    // Many splats of a tile miss all pixels of a subgroup.
    if subgroupAny(any(geometry != vec4<f32>(0.0)) || any(conic != vec4<f32>(0.0)) || any(color != vec4<f32>(0.0))) {
        sums.geometry = subgroupAdd(geometry);
        sums.conic = vec4<f32>(subgroupAdd(conic.xyz), 0.0);
        sums.color = vec4<f32>(subgroupAdd(color.xyz), 0.0);
    }
    return sums;
}
