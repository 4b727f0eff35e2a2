// Quaternions stored w, x, y, z.

// Rotation matrix of a quaternion of any length; zero length is the identity.
fn rotation_of(quat: vec4<f32>) -> mat3x3<f32> {
    let length_sq = dot(quat, quat);
    var q = vec4<f32>(1.0, 0.0, 0.0, 0.0);
    if length_sq > 1e-30 {
        q = quat * inverseSqrt(length_sq);
    }
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3<f32>(
        vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3<f32>(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3<f32>(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}
