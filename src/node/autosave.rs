//! The map while it grows -> the run directory's map file, every so often, on a thread of its own.
//!
//! The map thread hands over a copy; packing images and writing happen here. While one file is written, newer copies
//! replace each other. A crash loses what came since.

use std::path::Path;
use std::thread::JoinHandle;

use crate::node::job::spawn;
use crate::node::requests::RequestHandler;
use crate::node::save_map::{MapFile, save_map};
use splat_engine::error::EngineError;
use splat_io::queue::{Sender, WhenFull, queue};
use splat_slam::mapper::map_file::checkpoint::Checkpoint;
use splat_slam::mapper::mapper::Mapper;
use splat_types::time::Stopwatch;

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
                if let Err(e) = save_map(MapFile::Checkpoint(&checkpoint), &path) {
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
    pub(crate) fn save_if_due(
        this: Option<&mut Self>,
        map: &mut Mapper,
        request_handler: &mut RequestHandler,
    ) -> Result<(), EngineError> {
        let is_due = |this: &&mut Self| this.since.secs() >= this.every_secs;
        let Some(this) = this.filter(is_due).filter(|_| map.n_splats() > 0) else {
            return Ok(());
        };
        this.since = Stopwatch::start();
        map.snapshot()?;
        let copy = map.checkpoint(request_handler.landmarks().to_vec());
        if let Some(copies) = &this.copies {
            drop(copies.send(Box::new(copy)));
        }
        Ok(())
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
