//! Poses of messages <-> rigid motions.

use glam::{DQuat, DVec3};

use crate::ros::{Pose, Quaternion, Vector3};
use splat_types::transform::Rigid;

impl From<DVec3> for Vector3 {
    fn from(v: DVec3) -> Self {
        Self {
            x: v.x,
            y: v.y,
            z: v.z,
        }
    }
}

impl From<Rigid> for Pose {
    fn from(rigid: Rigid) -> Self {
        let (t, q) = (rigid.translation, rigid.rotation);
        Self {
            position: t.into(),
            orientation: Quaternion {
                x: q.x,
                y: q.y,
                z: q.z,
                w: q.w,
            },
        }
    }
}

impl Pose {
    /// `None` when a number is not finite or the quaternion has no length.
    pub fn to_rigid(self) -> Option<Rigid> {
        let q = self.orientation;
        let rotation = DQuat::from_xyzw(q.x, q.y, q.z, q.w);
        let length = rotation.length();
        let translation = DVec3::new(self.position.x, self.position.y, self.position.z);
        (translation.is_finite() && length.is_finite() && length > 1e-6)
            .then(|| Rigid::new(rotation / length, translation))
    }
}
