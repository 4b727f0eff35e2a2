//! Arithmetic that vectorises: what the per-pixel loops of `raster`, `raster_backward` and `loss` share.
//!
//! The loops run over fixed arrays of `LANES` pixels and hold no branch, so that LLVM turns them into vector code.

/// Pixels that one inner loop handles: half a row of a tile, one AVX register.
pub(crate) const LANES: usize = 8;

/// One number for each pixel of a vector.
pub(crate) type Lane = [f32; LANES];

/// `a * b + c`. Fused only where the hardware does it: elsewhere `mul_add` is a slow library call.
#[inline(always)]
pub(crate) fn madd<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// `2^x` for `x <= 1`, relative error below 3e-7. Never 0, and NaN stays NaN.
#[inline(always)]
pub(crate) fn exp2<const FMA: bool>(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits of the mantissa.
    const ROUND: f32 = 12_582_912.0;
    let x = if x < -126.0 { -126.0 } else { x };
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    // Taylor series of 2^f to degree 6: the next term is 1.2e-7 at |f| = 0.5.
    let p = madd::<FMA>(f, 1.540_353e-4, 1.333_355_8e-3);
    let p = madd::<FMA>(f, p, 9.618_129e-3);
    let p = madd::<FMA>(f, p, 5.550_411e-2);
    let p = madd::<FMA>(f, p, 2.402_265e-1);
    let p = madd::<FMA>(f, p, std::f32::consts::LN_2);
    let p = madd::<FMA>(f, p, 1.0);
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// What `multiversion` picks on this machine, for logs.
pub(crate) fn instruction_set() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::is_x86_feature_detected as has;
        if !has!("avx2") || !has!("fma") {
            return "sse2";
        }
        let has_avx512 =
            has!("avx512f") && has!("avx512vl") && has!("avx512bw") && has!("avx512dq");
        if has_avx512 { "avx512" } else { "avx2+fma" }
    }
    #[cfg(target_arch = "aarch64")]
    {
        "neon"
    }
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    {
        "scalar"
    }
}

#[cfg(test)]
mod tests {
    use super::exp2;

    #[test]
    fn exp2_is_within_a_few_ulp_of_the_library() {
        for i in 0..200_000 {
            let x = -126.0 + 127.0 * i as f32 / 200_000.0;
            let expected = f64::from(x).exp2();
            for found in [exp2::<true>(x), exp2::<false>(x)] {
                assert!(
                    (f64::from(found) / expected - 1.0).abs() < 3e-7,
                    "2^{x}: {found}, expected {expected}"
                );
            }
        }
    }
}
