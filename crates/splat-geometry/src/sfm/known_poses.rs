//! Keyframes with given cameras -> landmarks that fit them, and depth by stereo: no pose is estimated.
//!
//! The landmarks only report the stereo which keyframes see the same things and between which depths.

use std::collections::BTreeMap;

use crate::answer::GeometryBatch;
use crate::error::GeometryError;
use crate::mvs::params::MvsParams;
use crate::sfm::estimator::Sfm;
use crate::sfm::landmarks::extend;
use crate::sfm::params::SfmParams;
use crate::sfm::reconstruction::Submap;
use crate::sfm::updates::SparseBatch;
use splat_types::frame::Batch;
use splat_types::transform::Rigid;

/// Stereo for a stream of keyframes whose poses are given, all in one frame.
#[derive(Debug)]
pub struct KnownPoseStereo {
    sfm: Sfm,
}

impl KnownPoseStereo {
    /// An error where the parameters insist on a GPU or a network that is not there.
    pub fn new(sfm: &SfmParams, mvs: &MvsParams, seed: u64) -> Result<Self, GeometryError> {
        let mut sfm = Sfm::new(sfm, mvs, seed)?;
        sfm.scene.submaps.push(Submap::default());
        Ok(Self { sfm })
    }

    /// Views of all keyframes of the batch that have a pose in `submap_from_cam` (by keyframe id) and intrinsics.
    pub fn infer(
        &mut self,
        batch: &Batch,
        submap_from_cam: &BTreeMap<u32, Rigid>,
    ) -> GeometryBatch {
        let sfm = &mut self.sfm;
        sfm.batch_id = batch.id;
        let first_new = sfm.scene.views.len();
        let limits = sfm.take_in(&batch.keyframes);
        let fresh: Vec<usize> = (first_new..sfm.scene.views.len()).collect();
        for &view_ix in &fresh {
            let given = submap_from_cam.get(&sfm.scene.views[view_ix].keyframe.id);
            if let Some(pose) = given.filter(|_| sfm.scene.views[view_ix].is_calibrated) {
                sfm.scene.place(view_ix, 0, pose.inverse());
                extend(&mut sfm.scene, view_ix, limits.max_error_px);
            }
        }
        let again = sfm.shared_views(batch);
        self.dense(&again)
    }

    /// Views of earlier batches, where keyframes that came later add to their depth.
    pub fn finish(&mut self) -> GeometryBatch {
        let again: Vec<usize> = (0..self.sfm.scene.views.len())
            .filter(|&ix| {
                let id = self.sfm.scene.views[ix].keyframe.id;
                self.sfm.densifier.holds(id)
            })
            .collect();
        self.dense(&again)
    }

    fn dense(&mut self, again: &[usize]) -> GeometryBatch {
        let sparse = self.sfm.reported.changes(&self.sfm.scene, again);
        let sparse = SparseBatch {
            batch_id: self.sfm.batch_id,
            ..sparse
        };
        self.sfm.densify(&sparse)
    }
}
