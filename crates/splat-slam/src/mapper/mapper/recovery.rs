//! A lost device -> the map goes on with another engine from its last good state.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::mapper::cameras::Cameras;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::mapper::Mapper;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_engine::view::TrainingView;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

impl Mapper {
    /// Whether there is anything to go on from after a fault.
    pub fn can_recover(&self) -> bool {
        self.last_good.is_some()
    }

    /// Goes on with another engine, which must hold nothing, from the last good state: what has changed since is lost,
    /// ids, epoch, revision and steps go on. A batch that was being added must be added again.
    pub fn recover(&mut self, engine: Box<dyn Engine>) -> Result<(), EngineError> {
        assert_eq!(
            engine.len(),
            0,
            "the engine takes this map and nothing else"
        );
        self.engine = engine;
        self.trainer.forget_scratch_view();
        self.submaps.anchor().clear();
        let Some(good) = self.last_good.clone() else {
            self.forget_all();
            self.start_points.release(|_| false);
            return Ok(());
        };
        self.keyframes.restore(&good.keyframes);
        let registered = self.keyframes.registered();
        self.start_points.release(|id| registered.contains_key(&id));
        self.submaps.restore(&good.submaps);
        let snapshot = &good.snapshot;
        self.splats.restore_from(&snapshot.splat_ids, &good.on_disk);
        if !snapshot.splats.is_empty() {
            self.engine.append(&snapshot.splats)?;
            // An adapter may have room for fewer.
            let n = self.engine.len();
            let fits: Vec<bool> = (0..snapshot.splats.len()).map(|ix| ix < n).collect();
            self.splats.keep_ids(&fits);
            self.engine.set_update_counts(0, &good.update_counts)?;
        }
        self.upload_views(&good.cameras)?;
        self.upload_parked_views()?;
        self.trainer.note_trained(self.engine.poses()?.len());
        let (mut parts, trainer) = self.split();
        trainer.match_views(&mut parts)?;
        self.choose_trainable()?;
        self.set_anchor()?;
        self.trainer.reset_convergence();
        self.splats.note_peaks(&*self.engine);
        self.engine.status()?;
        // Views have other indices now.
        self.keep_good()
    }

    /// All views with a place, in the order in which they came. What the optimiser found of the focal length goes into
    /// the intrinsics: the new engine's factor begins at 1.
    fn upload_views(&mut self, cameras: &Cameras) -> Result<(), EngineError> {
        let mut by_view: Vec<(usize, u32)> = self
            .keyframes
            .registered()
            .iter()
            .map(|(id, registered)| (registered.view_ix, *id))
            .collect();
        by_view.sort_unstable();
        for (old_ix, id) in by_view {
            let Some(registered) = self.keyframes.get_mut(id) else {
                continue;
            };
            registered.intrinsics = registered.intrinsics.refocused(cameras.focal_scale);
            let depth = &registered.depth;
            registered.view_ix = self.engine.add_view(TrainingView {
                image: Arc::clone(&registered.image),
                intrinsics: registered.intrinsics,
                cam_from_world: cameras.cam_from_maps[old_ix],
                depth: (depth.width_px > 0).then(|| Arc::clone(depth)),
                mask: None,
            })?;
        }
        Ok(())
    }

    /// Views of parked submaps get an index, and no image before they are worked on again.
    fn upload_parked_views(&mut self) -> Result<(), EngineError> {
        for parked in self.submaps.parked_mut().iter_mut() {
            let mut cam_from_maps = Vec::new();
            for registered in parked.keyframes.values_mut() {
                let cam_from_world = parked.cameras.cam_from_maps[registered.view_ix];
                let (w, h) = (registered.image.width_px, registered.image.height_px);
                registered.view_ix = self.engine.add_view(TrainingView {
                    image: Arc::new(RgbImage::unloaded(w, h)),
                    intrinsics: registered.intrinsics,
                    cam_from_world,
                    depth: None,
                    mask: None,
                })?;
                cam_from_maps.resize(registered.view_ix + 1, Rigid::IDENTITY);
                cam_from_maps[registered.view_ix] = cam_from_world;
            }
            parked.cameras.cam_from_maps = cam_from_maps;
        }
        Ok(())
    }

    /// Nothing of the map was ever read: it begins again with what comes.
    fn forget_all(&mut self) {
        self.keyframes.restore(&KeyframeStore::default());
        self.submaps.forget_all();
        self.splats.restore_from(&[], &BTreeMap::new());
        self.trainer.forget_matches();
        self.trainer.set_trainable(Vec::new());
        self.trainer.reset_convergence();
    }
}
