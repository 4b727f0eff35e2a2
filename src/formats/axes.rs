//! The numbers of a splat in axes that other formats use, and after activation.
//!
//! A half turn about an axis, or none: means and quaternions follow it, and each spherical harmonic keeps its value or turns its sign
//! (Blanco, Florez, Bermejo 1997, for the rotation of real harmonics; half turns about axes are diagonal).

use splat_types::splats::splats::{SH_C0, Splats};

/// A half turn from x right, y down, z forward.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axes {
    /// x right, y down, z forward: as maps have it, and PLY and .splat.
    RightDownForward,
    /// x right, y up, z back, about x: SPZ.
    RightUpBack,
    /// x left, y up, z forward, about z: glTF.
    LeftUpForward,
}

impl Axes {
    fn signs(self) -> [f32; 3] {
        match self {
            Self::RightDownForward => [1.0, 1.0, 1.0],
            Self::RightUpBack => [1.0, -1.0, -1.0],
            Self::LeftUpForward => [-1.0, -1.0, 1.0],
        }
    }

    /// The same half turn takes it back.
    pub fn mean(self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        let [a, b, c] = self.signs();
        [a * x, b * y, c * z]
    }

    /// w, x, y, z of a unit quaternion -> the same in these axes, where the splat's own axes stay: the half turn stands left of it.
    pub fn quat(self, [w, x, y, z]: [f32; 4]) -> [f32; 4] {
        match self {
            Self::RightDownForward => [w, x, y, z],
            Self::RightUpBack => [-x, w, -z, y],
            Self::LeftUpForward => [-z, -y, x, w],
        }
    }

    /// The half turn once more, so that it is undone. A quaternion and its negative are one rotation.
    pub fn quat_back(self, quat: [f32; 4]) -> [f32; 4] {
        self.quat(quat).map(|v| -v)
    }

    /// Factor of harmonic `k`, from 0 on, in the usual order (m from -l to l).
    pub fn sh_sign(self, k: usize) -> f32 {
        let [x, y, z] = self.signs();
        // Which of x, y, z a harmonic is odd in: y, z, x; xy, yz, -, xz, -; y, xyz, y, z, x, z, x.
        match k {
            1 | 9 | 11 => y,
            2 | 12 | 14 => z,
            3 | 13 | 15 => x,
            4 => x * y,
            5 => y * z,
            7 => x * z,
            10 => x * y * z,
            _ => 1.0,
        }
    }
}

/// Of unit length; no direction at all is no rotation.
pub fn unit_quat(quat: [f32; 4]) -> [f32; 4] {
    let length = quat.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 && length.is_finite() {
        quat.map(|v| v / length)
    } else {
        [1.0, 0.0, 0.0, 0.0]
    }
}

/// 0 to 1.
pub fn opacity(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// Logit of an opacity of `steps` steps from 0 to 1; the ends are half a step within, so that they are finite.
pub fn logit(opacity: f32, steps: f32) -> f32 {
    let p = opacity.clamp(0.5 / steps, 1.0 - 0.5 / steps);
    (p / (1.0 - p)).ln()
}

/// Colour of harmonic 0, not cut.
pub fn base_colour(splats: &Splats, ix: usize) -> [f32; 3] {
    let at = ix * splats.sh_stride();
    std::array::from_fn(|c| 0.5 + SH_C0 * splats.sh[at + c])
}

/// Splats that can be written: every number is finite.
pub fn finite(splats: &Splats) -> Vec<usize> {
    (0..splats.len())
        .filter(|ix| splats.is_finite(*ix))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Harmonics 1 to 15 without their constants, by their polynomials.
    fn harmonics([x, y, z]: [f32; 3]) -> [f32; 16] {
        [
            1.0,
            y,
            z,
            x,
            x * y,
            y * z,
            2.0 * z * z - x * x - y * y,
            x * z,
            x * x - y * y,
            y * (3.0 * x * x - y * y),
            x * y * z,
            y * (4.0 * z * z - x * x - y * y),
            z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
            x * (4.0 * z * z - x * x - y * y),
            z * (x * x - y * y),
            x * (x * x - 3.0 * y * y),
        ]
    }

    fn rotated([w, x, y, z]: [f32; 4], v: [f32; 3]) -> [f32; 3] {
        let q = glam::Quat::from_xyzw(x, y, z, w);
        (q * glam::Vec3::from(v)).to_array()
    }

    #[test]
    fn what_is_seen_from_a_turned_direction_has_the_same_colour_and_shape() {
        let direction = [0.3, -0.5, 0.81];
        let quat = unit_quat([0.4, -0.3, 0.7, 0.2]);
        for axes in [
            Axes::RightDownForward,
            Axes::RightUpBack,
            Axes::LeftUpForward,
        ] {
            let (here, there) = (harmonics(direction), harmonics(axes.mean(direction)));
            for k in 0..16 {
                let difference = (here[k] - axes.sh_sign(k) * there[k]).abs();
                assert!(difference < 1e-6, "{axes:?}, harmonic {k}");
            }
            for own in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
                let wanted = axes.mean(rotated(quat, own));
                let found = rotated(axes.quat(quat), own);
                for k in 0..3 {
                    assert!((found[k] - wanted[k]).abs() < 1e-6, "{axes:?}");
                }
                let back = rotated(axes.quat_back(axes.quat(quat)), own);
                let wanted = rotated(quat, own);
                for k in 0..3 {
                    assert!((back[k] - wanted[k]).abs() < 1e-6, "{axes:?} and back");
                }
            }
        }
    }

    #[test]
    fn opacities_go_to_logits_and_back() {
        for logit_in in [-4.0_f32, 0.0, 3.0] {
            assert!((logit(opacity(logit_in), 1e6) - logit_in).abs() < 1e-3);
        }
        assert!(logit(0.0, 255.0).is_finite() && logit(1.0, 255.0).is_finite());
    }
}
