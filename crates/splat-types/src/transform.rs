//! Rigid motions and similarities in f64, named `target_from_source`.
//!
//! Knows nothing of cameras or maps. Quaternions here are glam's; the stored order elsewhere is w,x,y,z.

use glam::{DMat3, DQuat, DVec3};

/// `p_target = rotation * p_source + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rigid {
    pub rotation: DQuat,
    pub translation: DVec3,
}

/// `p_target = scale * rotation * p_source + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    pub scale: f64,
    pub rotation: DQuat,
    pub translation: DVec3,
}

impl Rigid {
    pub const IDENTITY: Self = Self {
        rotation: DQuat::IDENTITY,
        translation: DVec3::ZERO,
    };

    #[inline]
    pub fn new(rotation: DQuat, translation: DVec3) -> Self {
        Self {
            rotation,
            translation,
        }
    }

    #[inline]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        Self {
            rotation,
            translation: -(rotation * self.translation),
        }
    }

    #[inline]
    pub fn transform_point(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    #[inline]
    pub fn rotation_matrix(&self) -> DMat3 {
        DMat3::from_quat(self.rotation)
    }

    /// Exponential map of se(3): `rho` translates, `theta` rotates (radians). Small angles use the series.
    #[inline]
    pub fn exp(rho: DVec3, theta: DVec3) -> Self {
        let angle = theta.length();
        let skew = skew(theta);
        let (b, c) = if angle < 1e-5 {
            (
                0.5 - angle * angle / 24.0,
                1.0 / 6.0 - angle * angle / 120.0,
            )
        } else {
            (
                (1.0 - angle.cos()) / (angle * angle),
                (angle - angle.sin()) / (angle * angle * angle),
            )
        };
        let v = DMat3::IDENTITY + skew * b + skew * skew * c;
        Self {
            rotation: DQuat::from_scaled_axis(theta),
            translation: v * rho,
        }
    }

    /// Angle in radians of the rotation that takes `self` to `other`.
    #[inline]
    pub fn angle_to(&self, other: &Self) -> f64 {
        let dot = self.rotation.dot(other.rotation).abs().min(1.0);
        // acos loses all digits near 1, the sine of the difference does not.
        let relative = self.rotation.conjugate() * other.rotation;
        let sine = DVec3::new(relative.x, relative.y, relative.z).length();
        2.0 * sine.atan2(dot)
    }

    #[inline]
    pub fn is_finite(&self) -> bool {
        self.rotation.is_finite() && self.translation.is_finite()
    }

    /// Between `self` (share 0) and `other` (share 1): straight and at even speed, the short way round.
    pub fn between(&self, other: &Self, share: f64) -> Self {
        let same_side = if self.rotation.dot(other.rotation) < 0.0 {
            -other.rotation
        } else {
            other.rotation
        };
        Self {
            rotation: self.rotation.slerp(same_side, share),
            translation: self.translation.lerp(other.translation, share),
        }
    }

    /// Products of many rotations lose unit length; this restores it.
    #[inline]
    pub fn renormalized(&self) -> Self {
        Self {
            rotation: self.rotation.normalize(),
            translation: self.translation,
        }
    }
}

impl std::ops::Mul for Rigid {
    type Output = Self;

    #[inline]
    fn mul(self, rhs: Self) -> Self {
        Self {
            rotation: self.rotation * rhs.rotation,
            translation: self.rotation * rhs.translation + self.translation,
        }
    }
}

impl Similarity {
    pub const IDENTITY: Self = Self {
        scale: 1.0,
        rotation: DQuat::IDENTITY,
        translation: DVec3::ZERO,
    };

    #[inline]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        let scale = 1.0 / self.scale;
        Self {
            scale,
            rotation,
            translation: -(rotation * self.translation) * scale,
        }
    }

    #[inline]
    pub fn transform_point(&self, point: DVec3) -> DVec3 {
        self.rotation * point * self.scale + self.translation
    }

    #[inline]
    pub fn is_finite(&self) -> bool {
        let is_scale = self.scale.is_finite() && self.scale > 0.0;
        is_scale && self.rotation.is_finite() && self.translation.is_finite()
    }

    /// Radians.
    #[inline]
    pub fn angle(&self) -> f64 {
        let vector = DVec3::new(self.rotation.x, self.rotation.y, self.rotation.z);
        2.0 * vector.length().atan2(self.rotation.w.abs())
    }

    /// `self * source_from_cam`: the camera keeps unit scale, only its place and orientation move.
    #[inline]
    pub fn transform_pose(&self, pose: &Rigid) -> Rigid {
        Rigid {
            rotation: self.rotation * pose.rotation,
            translation: self.transform_point(pose.translation),
        }
    }
}

impl std::ops::Mul for Similarity {
    type Output = Self;

    #[inline]
    fn mul(self, rhs: Self) -> Self {
        Self {
            scale: self.scale * rhs.scale,
            rotation: self.rotation * rhs.rotation,
            translation: self.transform_point(rhs.translation),
        }
    }
}

impl From<Rigid> for Similarity {
    #[inline]
    fn from(rigid: Rigid) -> Self {
        Self {
            scale: 1.0,
            rotation: rigid.rotation,
            translation: rigid.translation,
        }
    }
}

/// The largest distance between two points. Exact up to some thousand points; beyond, at most 0.5 % too small.
pub fn extent(points: &[DVec3]) -> f64 {
    const MAX_EXACT: usize = 4000;
    const N_DIRECTIONS: usize = 512;

    let longest = |points: &[DVec3]| {
        let pairs = points
            .iter()
            .enumerate()
            .flat_map(|(ix, a)| points[ix + 1..].iter().map(move |b| a.distance_squared(*b)));
        pairs.fold(0.0, f64::max).sqrt()
    };
    if points.len() <= MAX_EXACT {
        return longest(points);
    }
    // The two ends of the longest distance are nearly outermost along one of many even directions: no direction
    // is further than 0.1 rad from a spiral point of the half sphere, and cos(0.1) = 0.995.
    let golden_angle = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let outermost: Vec<DVec3> = (0..N_DIRECTIONS)
        .flat_map(|ix| {
            let z = (ix as f64 + 0.5) / N_DIRECTIONS as f64;
            let (sin, cos) = (golden_angle * ix as f64).sin_cos();
            let radius = (1.0 - z * z).sqrt();
            let direction = DVec3::new(radius * cos, radius * sin, z);
            let along = |a: &&DVec3, b: &&DVec3| a.dot(direction).total_cmp(&b.dot(direction));
            [points.iter().min_by(along), points.iter().max_by(along)]
                .into_iter()
                .flatten()
                .copied()
        })
        .collect();
    longest(&outermost)
}

/// Reads `x y z qx qy qz qw`.
pub fn parse_transform(text: &str) -> Option<Rigid> {
    let numbers: Vec<f64> = text
        .split_whitespace()
        .map(str::parse)
        .collect::<Result<_, _>>()
        .ok()?;
    let [x, y, z, qx, qy, qz, qw] = numbers.try_into().ok()?;
    let rotation = DQuat::from_xyzw(qx, qy, qz, qw);
    let length = rotation.length();
    let translation = DVec3::new(x, y, z);
    let is_sound = translation.is_finite() && length.is_finite() && length > 1e-6;
    is_sound.then(|| Rigid::new(rotation / length, translation))
}

/// Axis times angle, the short way round: a quaternion and its negative are one rotation.
pub fn rotation_vector(rotation: DQuat) -> DVec3 {
    let short = if rotation.w < 0.0 {
        -rotation
    } else {
        rotation
    };
    short.to_scaled_axis()
}

/// `skew(a) * b == a.cross(b)`.
#[inline]
pub fn skew(a: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, a.z, -a.y),
        DVec3::new(-a.z, 0.0, a.x),
        DVec3::new(a.y, -a.x, 0.0),
    )
}
