//! The map while it grows -> the run directory's map file, every so often, on a thread of its own.
//!
//! The map thread hands over a copy; packing pictures and writing happen here. While one file is written, newer copies
//! replace each other. A crash loses what came since.

use std::path::Path;
use std::thread::JoinHandle;

use crate::clock::Stopwatch;
use crate::map::SplatMap;
use crate::map::checkpoint::{self, Checkpoint};
use crate::node::outward::Clerk;
use crate::node::spawn;
use crate::queue::{Sender, WhenFull, queue};

/// The side of the map thread.
#[derive(Debug)]
pub struct Autosave {
    every_secs: f64,
    since: Stopwatch,
    copies: Option<Sender<Box<Checkpoint>>>,
    writer: Option<JoinHandle<()>>,
}

impl Autosave {
    /// Writes `out/map.splatmap` every `every_secs`; `None` where nobody asks for it.
    pub fn start(out: Option<&Path>, every_secs: f64) -> anyhow::Result<Option<Self>> {
        let Some(out) = out.filter(|_| every_secs > 0.0) else {
            return Ok(None);
        };
        let path = out.join("map.splatmap");
        let (copies, taken) = queue::<Box<Checkpoint>>("autosave", 1, WhenFull::DropOldest);
        let writer = spawn("autosave", move || {
            while let Some(checkpoint) = taken.recv() {
                // The next one may find room; the run goes on.
                if let Err(e) = checkpoint::write(&checkpoint, &path) {
                    tracing::warn!("{e}");
                }
            }
        })?;
        Ok(Some(Self {
            every_secs,
            since: Stopwatch::start(),
            copies: Some(copies),
            writer: Some(writer),
        }))
    }

    /// Takes a copy where it is time for one; an older one that still waits is given up for it.
    pub(super) fn save_if_due(this: Option<&mut Self>, map: &mut SplatMap, clerk: &mut Clerk) {
        let is_due = |this: &&mut Self| this.since.secs() >= this.every_secs;
        let Some(this) = this.filter(is_due).filter(|_| map.n_splats() > 0) else {
            return;
        };
        this.since = Stopwatch::start();
        let snapshot = map.snapshot();
        let copy = map.checkpoint(&snapshot, clerk.landmarks().to_vec());
        if let Some(copies) = &this.copies {
            drop(copies.send(Box::new(copy)));
        }
    }
}

/// Waits for the file that is being written.
impl Drop for Autosave {
    fn drop(&mut self) {
        self.copies = None;
        if let Some(Err(_)) = self.writer.take().map(JoinHandle::join) {
            tracing::warn!("the thread of autosaves broke");
        }
    }
}
