//! 3D Gaussian splats as plain arrays: what the map holds, engines train, files and messages carry.

/// Zeroth spherical harmonic, 1 / (2 sqrt(pi)): `rgb = 0.5 + SH_C0 * sh[0]`.
pub const SH_C0: f32 = 0.282_094_79;

/// 3D Gaussians as structure of arrays, before activation, in the map frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Splats {
    pub means: Vec<[f32; 3]>,
    /// Natural logarithm of the standard deviation along each own axis, map units.
    pub log_scales: Vec<[f32; 3]>,
    /// w, x, y, z; normalised on use.
    pub quats: Vec<[f32; 4]>,
    pub opacity_logits: Vec<f32>,
    /// `sh[splat][coefficient][rgb]` flattened, `3 * (sh_degree + 1)^2` numbers a splat.
    pub sh: Vec<f32>,
    /// 0 to 3, the same for all.
    pub sh_degree: u8,
    /// Keyframe that each splat was seeded from; a pose correction carries its splats along.
    pub anchors: Vec<u32>,
}

impl Splats {
    #[inline]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    #[inline]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Numbers of SH per splat.
    #[inline]
    pub fn sh_stride(&self) -> usize {
        3 * (usize::from(self.sh_degree) + 1).pow(2)
    }

    /// Whether every number of splat `i` is finite.
    #[inline]
    pub fn is_finite(&self, i: usize) -> bool {
        let stride = self.sh_stride();
        self.means[i].iter().all(|v| v.is_finite())
            && self.log_scales[i].iter().all(|v| v.is_finite())
            && self.quats[i].iter().all(|v| v.is_finite())
            && self.opacity_logits[i].is_finite()
            && self.sh[i * stride..(i + 1) * stride]
                .iter()
                .all(|v| v.is_finite())
    }

    /// Drops all behind the first `n`.
    pub fn truncate(&mut self, n: usize) {
        let stride = self.sh_stride();
        self.means.truncate(n);
        self.log_scales.truncate(n);
        self.quats.truncate(n);
        self.opacity_logits.truncate(n);
        self.anchors.truncate(n);
        self.sh.truncate(n * stride);
    }

    /// Appends splat `i` of others of the same SH degree.
    pub fn push(&mut self, others: &Self, i: usize) {
        let stride = self.sh_stride();
        self.means.push(others.means[i]);
        self.log_scales.push(others.log_scales[i]);
        self.quats.push(others.quats[i]);
        self.opacity_logits.push(others.opacity_logits[i]);
        self.anchors.push(others.anchors[i]);
        self.sh
            .extend_from_slice(&others.sh[i * stride..(i + 1) * stride]);
    }

    /// Some of them, in the order of their indices given.
    pub fn picked(&self, ixs: &[usize]) -> Self {
        let mut some = Self {
            sh_degree: self.sh_degree,
            ..Self::default()
        };
        ixs.iter().for_each(|ix| some.push(self, *ix));
        some
    }
}
