//! Poses and focal length of all views as the engine has refined them, read once per operation.

use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_types::transform::Rigid;

/// Of all views of the engine, by their index.
#[derive(Debug, Clone, Default)]
pub(crate) struct Cameras {
    pub(crate) cam_from_maps: Vec<Rigid>,
    pub(crate) focal_scale: f64,
}

impl Cameras {
    pub(crate) fn read(engine: &mut dyn Engine) -> Result<Self, EngineError> {
        Ok(Self {
            cam_from_maps: engine.poses()?,
            focal_scale: engine.focal_scale()?,
        })
    }
}
