// Numbers that depend on nothing but their counters (pcg3d, Jarzynski & Olano 2020), the same on every adapter.

fn hash3(seed: u32, a: u32, b: u32) -> vec3<u32> {
    var v = vec3<u32>(seed, a, b) * 1664525u + 1013904223u;
    v.x += v.y * v.z;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v ^= v >> vec3<u32>(16u);
    v.x += v.y * v.z;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    return v;
}

// [0, 1) from the upper 24 bits.
fn uniform_of(bits: u32) -> f32 {
    return f32(bits >> 8u) * (1.0 / 16777216.0);
}

// Sets the second hash of a splat's noise apart from the first.
const SECOND_HASH: u32 = 0x9e3779b9u;

// Three independent numbers of mean 0 and variance 1 (Box & Muller 1958).
fn normal3(seed: u32, a: u32, b: u32) -> vec3<f32> {
    let first = hash3(seed, a, b);
    let second = hash3(seed ^ SECOND_HASH, a, b);
    // 1 - u is never 0.
    let radius = sqrt(-2.0 * log(1.0 - vec2<f32>(uniform_of(first.x), uniform_of(first.z))));
    let angle = 6.2831855 * vec2<f32>(uniform_of(first.y), uniform_of(second.x));
    return vec3<f32>(radius.x * cos(angle.x), radius.x * sin(angle.x), radius.y * cos(angle.y));
}
