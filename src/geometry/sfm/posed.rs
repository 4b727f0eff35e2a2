//! Keyframes with given cameras -> landmarks that fit them, and depth by stereo: no pose is estimated.
//!
//! The landmarks only tell the stereo which keyframes see the same things and between which depths.

use std::collections::BTreeMap;

use super::landmarks::extend;
use super::scene::Component;
use super::{Sfm, SparseBatch};
use crate::config::{MvsParams, SfmParams};
use crate::frame::Batch;
use crate::geometry::{GeometryBatch, GeometryError};
use crate::pose::Rigid;

/// Stereo for a stream of keyframes whose poses are given, all in one frame.
#[derive(Debug)]
pub struct PosedStereo {
    sfm: Sfm,
}

impl PosedStereo {
    /// An error where the parameters insist on a GPU or a network that is not there.
    pub fn new(sfm: &SfmParams, mvs: &MvsParams, seed: u64) -> Result<Self, GeometryError> {
        let mut sfm = Sfm::new(sfm, mvs, seed)?;
        sfm.scene.components.push(Component::default());
        Ok(Self { sfm })
    }

    /// Views of all keyframes of the batch that have a pose in `batch_from_cam` (by keyframe id) and intrinsics.
    pub fn infer(&mut self, batch: &Batch, batch_from_cam: &BTreeMap<u32, Rigid>) -> GeometryBatch {
        let sfm = &mut self.sfm;
        sfm.batch_id = batch.id;
        let first_new = sfm.scene.shots.len();
        let limits = sfm.take_in(&batch.keyframes);
        let fresh: Vec<usize> = (first_new..sfm.scene.shots.len()).collect();
        for &shot_ix in &fresh {
            let given = batch_from_cam.get(&sfm.scene.shots[shot_ix].keyframe.id);
            if let Some(pose) = given.filter(|_| sfm.scene.shots[shot_ix].is_calibrated) {
                sfm.scene.place(shot_ix, 0, pose.inverse());
                extend(&mut sfm.scene, shot_ix, limits.max_error_px);
            }
        }
        let again = sfm.shared_shots(batch);
        self.dense(&again)
    }

    /// Views of earlier batches, where keyframes that came later add to their depth.
    pub fn finish(&mut self) -> GeometryBatch {
        let again: Vec<usize> = (0..self.sfm.scene.shots.len())
            .filter(|&ix| {
                let id = self.sfm.scene.shots[ix].keyframe.id;
                self.sfm.densifier.holds(id)
            })
            .collect();
        self.dense(&again)
    }

    fn dense(&mut self, again: &[usize]) -> GeometryBatch {
        let sparse = self.sfm.told.changes(&self.sfm.scene, again);
        let sparse = SparseBatch {
            batch_id: self.sfm.batch_id,
            ..sparse
        };
        self.sfm.densify(&sparse)
    }
}
