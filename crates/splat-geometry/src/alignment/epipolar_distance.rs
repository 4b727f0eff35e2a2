//! Two cameras and a match -> its distance from the epipolar lines, with derivatives by what the cameras are made of.

use glam::{DMat3, DVec2, DVec3, DVec4};

use splat_types::camera::Intrinsics;
use splat_types::transform::{Rigid, skew};

/// Of the camera matrix.
pub(crate) fn inverse_of(lens: &Intrinsics) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(1.0 / lens.fx, 0.0, 0.0),
        DVec3::new(0.0, 1.0 / lens.fy, 0.0),
        DVec3::new(-lens.cx / lens.fx, -lens.cy / lens.fy, 1.0),
    )
}

/// `second^T F first = 0` for pixels of the same point; from the poses and the inverse camera matrices.
pub(crate) fn fundamental([a, b]: [Rigid; 2], [inverse_a, inverse_b]: [DMat3; 2]) -> DMat3 {
    let b_from_a = b * a.inverse();
    inverse_b.transpose() * skew(b_from_a.translation) * b_from_a.rotation_matrix() * inverse_a
}

pub(crate) fn distance(f: &DMat3, first: DVec2, second: DVec2) -> f64 {
    distance_and_gradient(f, first, second).0
}

/// Root of the squared distances of both ends to their lines, and its gradient by F.
pub(crate) fn distance_and_gradient(f: &DMat3, first: DVec2, second: DVec2) -> (f64, DMat3) {
    let (x1, x2) = (first.extend(1.0), second.extend(1.0));
    let (l2, l1) = (*f * x1, f.transpose() * x2);
    let s = x2.dot(l2);
    let (n2, n1) = (
        l2.truncate().length_squared(),
        l1.truncate().length_squared(),
    );
    let k = (1.0 / n1 + 1.0 / n2).sqrt();
    let error = s.abs() * k;
    let flat = |l: DVec3| l.truncate().extend(0.0);
    let by_lines =
        outer(flat(l2), x1) * (-1.0 / (n2 * n2)) + outer(x2, flat(l1)) * (-1.0 / (n1 * n1));
    let gradient = outer(x2, x1) * (s.signum() * k) + by_lines * (s.abs() / k);
    (error, gradient)
}

pub(crate) fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

pub(crate) fn inner(a: &DMat3, b: &DMat3) -> f64 {
    a.x_axis.dot(b.x_axis) + a.y_axis.dot(b.y_axis) + a.z_axis.dot(b.z_axis)
}

/// Gradient by a quaternion (w x y z) that is normalised on use, from the one by its rotation matrix.
pub(crate) fn by_quaternion(raw: &[f64], by_r: &DMat3) -> [f64; 4] {
    let raw = DVec4::new(raw[0], raw[1], raw[2], raw[3]);
    let length = raw.length();
    let [w, x, y, z] = (raw / length).to_array();
    let d = |row: usize, column: usize| by_r.col(column)[row];
    let by_unit = 2.0
        * DVec4::new(
            x * (d(2, 1) - d(1, 2)) + y * (d(0, 2) - d(2, 0)) + z * (d(1, 0) - d(0, 1)),
            y * (d(0, 1) + d(1, 0)) + z * (d(0, 2) + d(2, 0)) + w * (d(2, 1) - d(1, 2))
                - 2.0 * x * (d(1, 1) + d(2, 2)),
            x * (d(0, 1) + d(1, 0)) + z * (d(1, 2) + d(2, 1)) + w * (d(0, 2) - d(2, 0))
                - 2.0 * y * (d(0, 0) + d(2, 2)),
            x * (d(0, 2) + d(2, 0)) + y * (d(1, 2) + d(2, 1)) + w * (d(1, 0) - d(0, 1))
                - 2.0 * z * (d(0, 0) + d(1, 1)),
        );
    let unit = raw / length;
    ((by_unit - unit * unit.dot(by_unit)) / length).to_array()
}
