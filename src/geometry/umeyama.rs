//! Points in two frames -> the similarity between the frames.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

use crate::pose::Similarity;

/// `target_from_source` of (target, source) pairs by least squares (Umeyama 1991).
pub fn aligned(pairs: &[(DVec3, DVec3)]) -> Option<Similarity> {
    let n = pairs.len() as f64;
    if pairs.len() < 3 {
        return None;
    }
    let target_mean = pairs.iter().map(|p| p.0).sum::<DVec3>() / n;
    let source_mean = pairs.iter().map(|p| p.1).sum::<DVec3>() / n;
    let mut covariance = Matrix3::<f64>::zeros();
    let mut variance = 0.0;
    for (t, s) in pairs {
        let (t, s) = (*t - target_mean, *s - source_mean);
        covariance +=
            nalgebra::Vector3::new(t.x, t.y, t.z) * nalgebra::RowVector3::new(s.x, s.y, s.z) / n;
        variance += s.length_squared() / n;
    }
    let svd = covariance.svd(true, true);
    let (u, vt) = (svd.u?, svd.v_t?);
    let mut signs = nalgebra::Vector3::new(1.0, 1.0, 1.0);
    if u.determinant() * vt.determinant() < 0.0 {
        signs[svd.singular_values.argmin().0] = -1.0;
    }
    let r = u * Matrix3::from_diagonal(&signs) * vt;
    let scale = svd.singular_values.dot(&signs) / variance;
    let rotation = DQuat::from_mat3(&DMat3::from_cols_slice(r.as_slice())).normalize();
    let found = Similarity {
        scale,
        rotation,
        translation: target_mean - rotation * source_mean * scale,
    };
    (scale.is_finite() && scale > 1e-6 && found.rotation.is_finite()).then_some(found)
}
