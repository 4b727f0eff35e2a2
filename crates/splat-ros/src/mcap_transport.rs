//! Outgoing messages -> an MCAP file with their definitions, which Foxglove and `ros2 bag play` open.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use crate::error::PublishError;
use crate::transport::{Sample, Transport};
use splat_io::bag_writer::{BagWriter, Topic, options};

/// A node killed between chunks loses at most so much.
const CHUNK_BYTES: u64 = 1 << 20;
/// Of zstd: the mapping has better uses for a core.
const COMPRESSION_LEVEL: u32 = 1;

struct Open {
    file: BagWriter<BufWriter<File>>,
    topics: BTreeMap<&'static str, Topic>,
}

/// One file; closed with the node.
pub(crate) struct McapTransport {
    path: PathBuf,
    open: Mutex<Option<Open>>,
}

impl std::fmt::Debug for McapTransport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "RecordingFace({})", self.path.display())
    }
}

impl McapTransport {
    /// A file of that name is replaced.
    pub(crate) fn create(path: &Path) -> Result<Self, PublishError> {
        let fault = |reason: String| PublishError::Record {
            reason,
            path: path.to_owned(),
        };
        let file = File::create(path).map_err(|e| fault(e.to_string()))?;
        let options = options(COMPRESSION_LEVEL).chunk_size(Some(CHUNK_BYTES));
        let file = BagWriter::new(options, BufWriter::new(file)).map_err(fault)?;
        Ok(Self {
            path: path.to_owned(),
            open: Mutex::new(Some(Open {
                file,
                topics: BTreeMap::new(),
            })),
        })
    }

    fn fault(&self, reason: String) -> PublishError {
        PublishError::Record {
            reason,
            path: self.path.clone(),
        }
    }
}

impl Open {
    fn write(&mut self, post: &Sample) -> Result<(), String> {
        let of = post.topic;
        let topic = match self.topics.entry(of.name) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => {
                let name = of.full_name("splat_mapper");
                new.insert(self.file.topic_of(&name, of.type_name, of.definition)?)
            }
        };
        let nanos = u64::try_from(post.stamp.nanos).unwrap_or(0);
        self.file.write_payload(topic, nanos, &post.payload)
    }
}

impl Transport for McapTransport {
    fn send(&self, post: &Sample) -> Result<(), PublishError> {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        match open.as_mut() {
            Some(open) => open.write(post).map_err(|e| self.fault(e)),
            None => Ok(()),
        }
    }

    fn close(&self) -> Result<(), PublishError> {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        match open.take() {
            Some(open) => open.file.finish().map(|_| ()).map_err(|e| self.fault(e)),
            None => Ok(()),
        }
    }
}
