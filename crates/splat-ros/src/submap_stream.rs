//! Submaps without a known relation to the map -> messages of their own, whole, once for each revision.

use std::sync::Arc;

use crate::error::PublishError;
use crate::latched::{PublishedSubmap, send_submap};
use crate::publisher::Publisher;
use splat_types::snapshot::Snapshot;
use splat_types::splats::splats::Splats;

/// What clients hold of them; owned by the thread that publishes the map.
#[derive(Debug, Default)]
pub struct SubmapStream {
    published: Vec<PublishedSubmap>,
}

impl SubmapStream {
    /// Sends those that are new or have changed. One that is gone, since it is the map or a part of it, goes out once more,
    /// without splats.
    pub fn publish(
        &mut self,
        publisher: &Publisher,
        submaps: &[Arc<Snapshot>],
    ) -> Result<(), PublishError> {
        let latched = publisher.latched();
        let (mut kept, mut fresh) = (Vec::new(), Vec::new());
        for snapshot in submaps {
            let held = self
                .published
                .iter()
                .find(|held| is_same(held.snapshot(), snapshot));
            let submap = held.cloned().unwrap_or_else(|| latched.submap(snapshot));
            if held.is_none() {
                fresh.push(submap.clone());
            }
            kept.push(submap);
        }
        let is_gone = |held: &&PublishedSubmap| {
            let mut submaps = submaps.iter();
            submaps.all(|snapshot| snapshot.map_id != held.snapshot().map_id)
        };
        let gone = self.published.iter().filter(is_gone);
        let gone = gone.map(|held| latched.submap(&Arc::new(emptied(held.snapshot()))));
        let outgoing: Vec<PublishedSubmap> = gone.chain(fresh).collect();
        self.published.clone_from(&kept);
        // Before the first message goes out: who subscribed too late for it finds it there.
        latched.keep_submaps(kept);
        for submap in &outgoing {
            let messages = latched.submap_messages(submap);
            send_submap(&messages, &mut |sample| publisher.send(sample))?;
        }
        Ok(())
    }
}

fn is_same(a: &Snapshot, b: &Snapshot) -> bool {
    a.map_id == b.map_id && a.epoch == b.epoch && a.revision == b.revision
}

/// What is left of a submap that is gone.
fn emptied(snapshot: &Snapshot) -> Snapshot {
    Snapshot {
        revision: snapshot.revision + 1,
        poses: Vec::new(),
        splats: Arc::new(Splats {
            sh_degree: snapshot.splats.sh_degree,
            ..Splats::default()
        }),
        splat_ids: Arc::default(),
        ..snapshot.clone()
    }
}
