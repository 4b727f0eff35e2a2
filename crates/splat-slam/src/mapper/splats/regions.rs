//! A part of the map on disk: what was seeded from one keyframe, which it moves with.

use std::io;
use std::sync::Arc;

use glam::DVec3;

use crate::mapper::splats::region_codec::take_region;
use crate::mapper::splats::transform::Carry;
use splat_types::pages::Page;
use splat_types::splats::splats::Splats;
use splat_types::transform::{Rigid, Similarity};

/// A region on disk.
#[derive(Debug, Clone)]
pub struct Evicted {
    pub anchor: u32,
    pub n_splats: usize,
    pub sh_degree: u8,
    pub(super) page: Arc<dyn Page>,
    pub(super) world_from_anchor: Rigid,
    /// What it was moved by as a whole since it left: `world_from_anchor` and `sample` are those after it.
    pub(super) carried: Option<Similarity>,
    /// What moved the map there since.
    pub(super) motion: Option<Rigid>,
    /// Places of some of its splats when it left.
    pub(super) sample: Vec<DVec3>,
}

impl Evicted {
    /// Splats where the map has them by now, and their update counts.
    pub fn splats(&self) -> io::Result<(Splats, Vec<u16>)> {
        let bytes = self.page.read()?;
        let (mut splats, update_counts) = take_region(&mut &bytes[..]).map_err(io::Error::other)?;
        for motion in self.carried.into_iter().chain(self.motion.map(Into::into)) {
            let carry = Carry::new(motion, splats.sh_degree);
            (0..splats.len()).for_each(|i| carry.transform(&mut splats, i));
        }
        Ok((splats, update_counts))
    }

    pub(crate) fn moved_to(&self, world_from_anchor: &Rigid) -> Self {
        let motion = *world_from_anchor * self.world_from_anchor.inverse();
        let is_moved = *world_from_anchor != self.world_from_anchor;
        Self {
            motion: is_moved.then_some(motion),
            ..self.clone()
        }
    }

    /// It lies in another world.
    pub(crate) fn carry(&mut self, motion: &Similarity) {
        self.carried = Some(match self.carried {
            Some(before) => *motion * before,
            None => *motion,
        });
        self.world_from_anchor = motion.transform_pose(&self.world_from_anchor);
        for place in &mut self.sample {
            *place = motion.transform_point(*place);
        }
    }
}
