//! The map while it grows -> the run directory's map file, every so often, on a thread of its own.
//!
//! The map thread hands over a copy; packing pictures and writing happen here. While one file is written, newer copies
//! replace each other. A crash loses what came since.

use std::path::Path;
use std::thread::JoinHandle;

use crate::clock::Stopwatch;
use crate::map::checkpoint::{self, Checkpoint};
use crate::node::spawn;
use crate::queue::{Sender, WhenFull, queue};

/// The side of the map thread.
#[derive(Debug)]
pub struct Autosave {
    every_secs: f64,
    since: Stopwatch,
    copies: Option<Sender<Box<Checkpoint>>>,
    writer: Option<JoinHandle<u64>>,
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
            let mut n_written = 0;
            while let Some(checkpoint) = taken.recv() {
                match checkpoint::write(&checkpoint, &path) {
                    Ok(()) => n_written += 1,
                    // The next one may find room; the run goes on.
                    Err(e) => tracing::warn!("{e}"),
                }
            }
            n_written
        })?;
        Ok(Some(Self {
            every_secs,
            since: Stopwatch::start(),
            copies: Some(copies),
            writer: Some(writer),
        }))
    }

    pub fn is_due(&self) -> bool {
        self.since.secs() >= self.every_secs
    }

    /// Takes a copy; one that still waits is given up for it.
    pub fn save(&mut self, checkpoint: Checkpoint) {
        self.since = Stopwatch::start();
        if let Some(copies) = &self.copies {
            drop(copies.send(Box::new(checkpoint)));
        }
    }

    /// Waits for the file that is being written. Returns how many were.
    pub fn finish(mut self) -> u64 {
        self.copies = None;
        let writer = self.writer.take();
        writer.and_then(|w| w.join().ok()).unwrap_or(0)
    }
}
