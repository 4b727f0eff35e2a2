// Real spherical harmonics to degree 3, sign and order of 3D Gaussian Splatting files (Kerbl et al. 2023).

const SH_C0: f32 = 0.28209479177387814;
const SH_C1: f32 = 0.4886025119029199;
const SH_C2A: f32 = 1.0925484305920792;
const SH_C2B: f32 = 0.31539156525252005;
const SH_C2C: f32 = 0.5462742152960396;
const SH_C3A: f32 = 0.5900435899266435;
const SH_C3B: f32 = 2.890611442640554;
const SH_C3C: f32 = 0.4570457994644658;
const SH_C3D: f32 = 0.3731763325901154;
const SH_C3E: f32 = 1.445305721320277;

// Numbers of SH above degree 0 per splat.
fn n_sh_rest(degree: u32) -> u32 {
    return 3u * ((degree + 1u) * (degree + 1u) - 1u);
}

// Coefficients 1 to 15 in a unit direction; those above the degree are computed too and not used.
fn sh_basis(d: vec3<f32>) -> array<f32, 15> {
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    return array<f32, 15>(
        -SH_C1 * d.y,
        SH_C1 * d.z,
        -SH_C1 * d.x,
        SH_C2A * d.x * d.y,
        -SH_C2A * d.y * d.z,
        SH_C2B * (2.0 * zz - xx - yy),
        -SH_C2A * d.x * d.z,
        SH_C2C * (xx - yy),
        -SH_C3A * d.y * (3.0 * xx - yy),
        SH_C3B * d.x * d.y * d.z,
        -SH_C3C * d.y * (4.0 * zz - xx - yy),
        SH_C3D * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -SH_C3C * d.x * (4.0 * zz - xx - yy),
        SH_C3E * d.z * (xx - yy),
        -SH_C3A * d.x * (xx - 3.0 * yy),
    );
}

// Derivative of one coefficient (1 to 15, counted from 0) by the direction, as a polynomial off the sphere.
fn sh_basis_gradient(d: vec3<f32>, coefficient: u32) -> vec3<f32> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    switch coefficient {
        case 0u: { return vec3<f32>(0.0, -SH_C1, 0.0); }
        case 1u: { return vec3<f32>(0.0, 0.0, SH_C1); }
        case 2u: { return vec3<f32>(-SH_C1, 0.0, 0.0); }
        case 3u: { return SH_C2A * vec3<f32>(y, x, 0.0); }
        case 4u: { return -SH_C2A * vec3<f32>(0.0, z, y); }
        case 5u: { return SH_C2B * vec3<f32>(-2.0 * x, -2.0 * y, 4.0 * z); }
        case 6u: { return -SH_C2A * vec3<f32>(z, 0.0, x); }
        case 7u: { return SH_C2C * vec3<f32>(2.0 * x, -2.0 * y, 0.0); }
        case 8u: { return -SH_C3A * vec3<f32>(6.0 * x * y, 3.0 * (x * x - y * y), 0.0); }
        case 9u: { return SH_C3B * vec3<f32>(y * z, x * z, x * y); }
        case 10u: { return -SH_C3C * vec3<f32>(-2.0 * x * y, 4.0 * z * z - x * x - 3.0 * y * y, 8.0 * y * z); }
        case 11u: { return SH_C3D * vec3<f32>(-6.0 * x * z, -6.0 * y * z, 6.0 * z * z - 3.0 * x * x - 3.0 * y * y); }
        case 12u: { return -SH_C3C * vec3<f32>(4.0 * z * z - 3.0 * x * x - y * y, -2.0 * x * y, 8.0 * x * z); }
        case 13u: { return SH_C3E * vec3<f32>(2.0 * x * z, -2.0 * y * z, x * x - y * y); }
        default: { return -SH_C3A * vec3<f32>(3.0 * (x * x - y * y), -6.0 * x * y, 0.0); }
    }
}
