//! What odometry says of the motion between two cameras, as residuals of bundle adjustment.
//!
//! The residual is the difference of the places and the logarithm of the turn that is left over, each in standard deviations
//! (the relative-pose factor of pose graphs, Grisetti et al. 2010, section III, with the two errors apart). Cauchy's loss makes a
//! wheel that slips count for little.

use glam::{DMat3, DVec3};

use crate::optim::bundle::problem::{Camera, Flat, RelativeMotion};
use crate::optim::bundle::reduced::{HELD, Layout, System};
use splat_types::transform::{Rigid, rotation_vector, skew};

/// Standard deviations at which the loss bends. Observations bend at their `loss_px`, so that one standard deviation of a motion
/// counts as a third of that in pixels, which is about what a good match is off by.
const STD_PER_LOSS: f64 = 3.0;

/// Derivatives by a shift and a turn of each camera in its own axes, row by row.
type ByPose = [[[f64; 6]; 6]; 2];

/// One motion, linearised and weighted.
#[derive(Debug)]
pub(crate) struct MotionRows {
    slots: [u32; 2],
    residual: [f64; 6],
    by_pose: ByPose,
}

impl RelativeMotion {
    /// In standard deviations: place, then turn.
    pub(crate) fn residual(&self, cameras: &[Camera]) -> [f64; 6] {
        self.residual_of(&self.between(cameras))
    }

    /// `first_from_second` by the cameras.
    fn between(&self, cameras: &[Camera]) -> Rigid {
        let pose = |ix: u32| cameras[ix as usize].cam_from_world;
        pose(self.first_ix) * pose(self.second_ix).inverse()
    }

    fn residual_of(&self, between: &Rigid) -> [f64; 6] {
        let place = (between.translation - self.first_from_second.translation) / self.std[0];
        let turn = self.turned(between) / self.std[1];
        [place.x, place.y, place.z, turn.x, turn.y, turn.z]
    }

    /// The turn that is left over, as the rotation vector of the shorter way round.
    fn turned(&self, between: &Rigid) -> DVec3 {
        rotation_vector(self.first_from_second.rotation.inverse() * between.rotation)
    }

    fn derivatives(&self, between: &Rigid) -> ByPose {
        // With first_from_second M: a motion of the first camera makes it exp(x) M, one of the second M exp(-x).
        let rotation = between.rotation_matrix();
        let log = inverse_right_jacobian(self.turned(between));
        let by_turn = log * rotation.transpose();
        let mut out = [[[0.0; 6]; 6]; 2];
        let mut put = |camera: usize, at: [usize; 2], matrix: DMat3, std: f64| {
            for row in 0..3 {
                for column in 0..3 {
                    out[camera][at[0] + row][at[1] + column] = matrix.col(column)[row] / std;
                }
            }
        };
        let [place, turn] = self.std;
        put(0, [0, 0], DMat3::IDENTITY, place);
        put(0, [0, 3], skew(-between.translation), place);
        put(0, [3, 3], by_turn, turn);
        put(1, [0, 0], -rotation, place);
        put(1, [3, 3], -log, turn);
        out
    }
}

/// Of SO(3) at a rotation vector: by how much its logarithm changes when a small turn comes after it (Forster et al. 2017,
/// equation 9).
pub(crate) fn inverse_right_jacobian(v: DVec3) -> DMat3 {
    let (angle, matrix) = (v.length(), skew(v));
    // The series near zero, where the closed form is 0 / 0.
    let second = if angle < 1e-3 {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        let (sin, cos) = angle.sin_cos();
        1.0 / (angle * angle) - (1.0 + cos) / (2.0 * angle * sin)
    };
    DMat3::IDENTITY + matrix * 0.5 + matrix * matrix * second
}

fn squared(residual: &[f64; 6]) -> f64 {
    residual.iter().map(|r| r * r).sum()
}

/// Cauchy's loss of all motions, in units of `loss_px` squared, as for observations.
pub(crate) fn cost(cameras: &[Camera], flat: &Flat<'_>) -> f64 {
    let bend = STD_PER_LOSS * STD_PER_LOSS;
    let of = |motion: &RelativeMotion| (squared(&motion.residual(cameras)) / bend).ln_1p();
    flat.motions.iter().map(of).sum()
}

/// Rows of the motions that anything free has a part in.
pub(crate) fn linearise(cameras: &[Camera], flat: &Flat<'_>, layout: &Layout) -> Vec<MotionRows> {
    let rows = |motion: &RelativeMotion| {
        let ends = [motion.first_ix, motion.second_ix];
        let slots = ends.map(|ix| layout.slot_of[ix as usize]);
        if slots == [HELD, HELD] {
            return None;
        }
        let between = motion.between(cameras);
        let residual = motion.residual_of(&between);
        let bend = STD_PER_LOSS * STD_PER_LOSS;
        // Square root of the weight of iteratively reweighted least squares, in pixels per standard deviation.
        let weight = flat.loss_px / STD_PER_LOSS * (1.0 + squared(&residual) / bend).recip().sqrt();
        let by_pose = motion.derivatives(&between);
        Some(MotionRows {
            slots,
            residual: residual.map(|r| weight * r),
            by_pose: by_pose.map(|camera| camera.map(|row| row.map(|d| weight * d))),
        })
    };
    flat.motions.iter().filter_map(rows).collect()
}

/// Adds motions to the reduced system, which they touch no point of.
pub(crate) fn add(system: &mut System, motions: &[MotionRows], damping: f64) {
    for motion in motions {
        for (camera, &slot) in motion.slots.iter().enumerate() {
            if slot == HELD {
                continue;
            }
            let own = &motion.by_pose[camera];
            let gradient = &mut system.gradient[slot as usize];
            for (row, residual) in own.iter().zip(motion.residual) {
                (0..6).for_each(|k| gradient[k] += row[k] * residual);
            }
            for (other, &other_slot) in motion.slots.iter().enumerate() {
                if other_slot == HELD || other_slot > slot {
                    continue;
                }
                let block = system.block(slot as usize, other_slot as usize);
                for (a, b) in own.iter().zip(&motion.by_pose[other]) {
                    for i in 0..6 {
                        (0..6).for_each(|j| block[6 * i + j] += a[i] * b[j]);
                        if other == camera {
                            block[7 * i] += damping * a[i] * a[i];
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
