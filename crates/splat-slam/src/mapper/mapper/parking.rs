//! The submap that is worked on changes: the one before is parked with its splats, and comes back with them.

use std::sync::Arc;

use crate::mapper::cameras::Cameras;
use crate::mapper::keyframes::poses::keyframe_poses;
use crate::mapper::mapper::Mapper;
use crate::mapper::submaps::parked::Parked;
use splat_engine::error::EngineError;
use splat_geometry::answer::{PoseStd, View};
use splat_types::snapshot::{Scale, ScaleSource};

impl Mapper {
    /// At the end of the input: of all submaps the one with the most keyframes is the map.
    pub fn settle_on_largest(&mut self) -> Result<(), EngineError> {
        if let Some(submap) = self.submaps.parked().larger_than(self.n_keyframes()) {
            let views = self.activate(submap)?;
            let new = self.register(views, PoseStd::default(), &[])?;
            self.seed(&new, &[])?;
            self.settle_in()?;
        }
        Ok(())
    }

    /// Keyframes of the map and of parked submaps.
    pub fn n_mapped_keyframes(&self) -> usize {
        self.n_keyframes() + self.submaps.parked().n_keyframes()
    }

    /// Where the newest keyframes have gone to another submap, that becomes the map: views to register in it.
    pub(super) fn follow_newest(&mut self) -> Result<Vec<View>, EngineError> {
        match self.submaps.to_follow(&self.keyframes) {
            Some(submap) => self.activate(submap),
            None => Ok(Vec::new()),
        }
    }

    fn activate(&mut self, submap: u32) -> Result<Vec<View>, EngineError> {
        let (n_keyframes, n_splats) = (self.n_keyframes(), self.n_splats());
        tracing::warn!(
            "submap {submap} is the map from here on; the one of {n_keyframes} keyframes and {n_splats} splats is parked until they join"
        );
        self.park()?;
        let (parked, views) = self.submaps.switch_to(submap);
        match parked {
            Some(parked) => {
                self.scale.set(parked.snapshot.scale);
                self.unpark(parked)?;
            }
            None if self.scale.scale().source != ScaleSource::Given => {
                self.scale.set(Scale::UP_TO_SCALE);
            }
            None => {}
        }
        Ok(views)
    }

    /// The engine holds no splats afterwards, and no images.
    fn park(&mut self) -> Result<(), EngineError> {
        let cameras = Cameras::read(&mut *self.engine)?;
        let poses = keyframe_poses(&self.keyframes, &cameras);
        let (read, aside) = self.splats.take_all(&mut *self.engine)?;
        let revision = self.submaps.revision() + 1;
        let snapshot = self.snapshot_of(poses, revision, (read.splats, read.ids));
        let keyframes = self.keyframes.take_registered();
        for registered in keyframes.registered().values() {
            self.engine.unload_view(registered.view_ix)?;
        }
        self.trainer.set_trainable(Vec::new());
        self.trainer.reset_convergence();
        self.submaps.park(Parked {
            submap: self.submaps.active().unwrap_or_default(),
            keyframes,
            cameras,
            snapshot: Arc::new(snapshot),
            update_counts: Arc::new(read.update_counts),
            aside,
        });
        Ok(())
    }

    /// What was parked is worked on again, beside what is there.
    pub(super) fn unpark(&mut self, mut parked: Parked) -> Result<(), EngineError> {
        let engine = &mut *self.engine;
        let focal_scale = engine.focal_scale()?;
        if parked.cameras.focal_scale != focal_scale {
            parked
                .keyframes
                .refocus(parked.cameras.focal_scale / focal_scale);
        }
        for registered in parked.keyframes.registered().values() {
            let (view_ix, intrinsics) = (registered.view_ix, &registered.intrinsics);
            if registered.home.is_here {
                engine.set_image(view_ix, Arc::clone(&registered.image), intrinsics)?;
                let depth = &registered.depth;
                let depth = (depth.width_px > 0).then(|| Arc::clone(depth));
                engine.set_depth(view_ix, depth)?;
            } else {
                engine.set_intrinsics(view_ix, intrinsics)?;
            }
            engine.set_pose(view_ix, parked.cameras.cam_from_maps[view_ix])?;
        }
        let snapshot = &parked.snapshot;
        let splats = (
            &*snapshot.splats,
            &snapshot.splat_ids[..],
            &parked.update_counts[..],
        );
        self.splats.put_back(splats, parked.aside, engine)?;
        self.keyframes.absorb(parked.keyframes);
        self.report_renumbered();
        self.share_budget();
        self.make_fit("submaps that joined")?;
        self.trainer.reset_convergence();
        self.choose_trainable()
    }

    /// The cap on splats is for all submaps together.
    pub(super) fn share_budget(&mut self) {
        let (most, n_keyframes) = (self.params.map.max_splats, self.n_keyframes());
        let n_own = self.engine.len();
        let parked = self.submaps.parked_mut();
        let n_gone = parked.prune(most, (n_own, n_keyframes));
        if n_gone > 0 {
            tracing::debug!("{n_gone} splats of parked submaps made room");
        }
        let kept = parked.kept(most, n_keyframes);
        self.splats.set_parked(kept);
    }
}
