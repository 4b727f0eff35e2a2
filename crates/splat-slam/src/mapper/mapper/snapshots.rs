//! The map at one moment: snapshots, checkpoints, and the last good state.

use std::sync::Arc;

use sha2::{Digest, Sha256};

use crate::mapper::cameras::Cameras;
use crate::mapper::keyframes::poses::keyframe_poses;
use crate::mapper::keyframes::saved_views::saved_views;
use crate::mapper::last_good::LastGood;
use crate::mapper::map_file::checkpoint::Checkpoint;
use crate::mapper::mapper::Mapper;
use crate::mapper::splats::store::evicted_regions;
use splat_engine::error::EngineError;
use splat_types::snapshot::{KeyframePose, Snapshot};
use splat_types::splats::splats::Splats;

impl Mapper {
    /// Poses and splats as they are.
    pub fn snapshot(&mut self) -> Result<Arc<Snapshot>, EngineError> {
        let cameras = Cameras::read(&mut *self.engine)?;
        let read = self.splats.finite_copy(&mut *self.engine)?;
        let poses = keyframe_poses(&self.keyframes, &cameras);
        let prior = self.submaps.prior().map(|prior| prior.scale);
        let first_id = self.first_id();
        let own = &poses[poses.partition_point(|pose| pose.keyframe_id < first_id)..];
        let scale = self.scale.measure(&mut self.keyframes, own, prior);
        self.scale.set(scale);
        let revision = self.submaps.next_revision();
        let snapshot = Arc::new(self.snapshot_of(poses, revision, (read.splats, read.ids)));
        self.keep(Arc::clone(&snapshot), cameras, read.update_counts);
        Ok(snapshot)
    }

    /// The last good state with all that a later run goes on from, whatever has become of the engine. Cheap: images are
    /// packed when the file is written. `landmarks` are the tracker's.
    pub fn checkpoint(&self, landmarks: Vec<u8>) -> Checkpoint {
        let snapshot = Snapshot::clone(&self.last_snapshot());
        let bare = Checkpoint {
            map_frame: self.map_frame,
            ..Checkpoint::of(snapshot, self.seed, self.n_steps_in_all())
        };
        let Some(good) = &self.last_good else {
            return bare;
        };
        Checkpoint {
            landmarks,
            update_counts: good.update_counts.clone(),
            views: saved_views(good.keyframes.registered()),
            max_view_bytes: self.params.map.save_images_mib << 20,
            evicted: evicted_regions(&good.on_disk, &good.keyframes, &good.cameras),
            ..bare
        }
    }

    /// The newest state that was read without a fault; without splats where there was none.
    pub fn last_snapshot(&self) -> Arc<Snapshot> {
        match &self.last_good {
            Some(good) => Arc::clone(&good.snapshot),
            None => {
                let revision = self.submaps.revision();
                Arc::new(self.snapshot_of(Vec::new(), revision, Default::default()))
            }
        }
    }

    /// Copies what the engine holds. Changes nothing that a snapshot shows.
    pub(super) fn keep_good(&mut self) -> Result<(), EngineError> {
        let cameras = Cameras::read(&mut *self.engine)?;
        let read = self.splats.finite_copy(&mut *self.engine)?;
        let poses = keyframe_poses(&self.keyframes, &cameras);
        let revision = self.submaps.revision() + 1;
        let snapshot = self.snapshot_of(poses, revision, (read.splats, read.ids));
        self.keep(Arc::new(snapshot), cameras, read.update_counts);
        Ok(())
    }

    fn keep(&mut self, snapshot: Arc<Snapshot>, cameras: Cameras, update_counts: Vec<u16>) {
        self.last_good = Some(Arc::new(LastGood {
            snapshot,
            cameras,
            update_counts,
            keyframes: self.keyframes.clone(),
            submaps: self.submaps.state(),
            on_disk: self.splats.on_disk().clone(),
        }));
    }

    pub(super) fn snapshot_of(
        &self,
        poses: Vec<KeyframePose>,
        revision: u32,
        (splats, splat_ids): (Splats, Vec<u32>),
    ) -> Snapshot {
        Snapshot {
            map_id: self.map_id(),
            epoch: self.submaps.epoch(),
            revision,
            stamp: poses.last().map(|pose| pose.stamp).unwrap_or_default(),
            scale: self.scale.scale(),
            poses,
            splats: Arc::new(splats),
            splat_ids: Arc::new(splat_ids),
        }
    }

    fn map_id(&self) -> [u8; 16] {
        if let Some(prior) = self.submaps.prior() {
            return prior.map_id;
        }
        let first = self
            .keyframes
            .registered()
            .values()
            .next()
            .map(|p| p.keyframe.frame.stamp.nanos)
            .unwrap_or(0);
        let digest = Sha256::new()
            .chain_update(self.seed.to_le_bytes())
            .chain_update(first.to_le_bytes())
            .finalize();
        std::array::from_fn(|i| digest[i])
    }
}
