// Optimiser state of a splat to 0; the count of all its updates stays.

#import sh

fn clear_moments(splat_ix: u32) {
    let in_all = moments[8u * splat_ix + 4u].w;
    for (var k = 0u; k < 8u; k += 1u) {
        moments[8u * splat_ix + k] = vec4<f32>(0.0);
    }
    moments[8u * splat_ix + 4u].w = in_all;
    let words = (n_sh_rest(moves.sh_stored) + 1u) / 2u + moves.sh_stored;
    for (var k = 0u; k < words; k += 1u) {
        sh_moments[splat_ix * words + k] = 0u;
    }
}
