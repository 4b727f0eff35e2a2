//! What an operation on splats needs of the map beside its own owner.

use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::params::MapperParams;
use crate::mapper::splats::store::SplatSet;
use splat_engine::traits::Engine;

/// Borrowed for one operation.
pub(crate) struct Parts<'a> {
    pub(crate) params: &'a MapperParams,
    pub(crate) engine: &'a mut dyn Engine,
    pub(crate) keyframes: &'a mut KeyframeStore,
    pub(crate) splats: &'a mut SplatSet,
}
