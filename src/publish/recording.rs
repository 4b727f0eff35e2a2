//! Outgoing messages -> an MCAP file with their definitions, which Foxglove and `ros2 bag play` open.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use mcap::records::MessageHeader;

use crate::publish::PublishError;
use crate::publish::face::{Face, Post};

/// A node killed between chunks loses at most so much.
const CHUNK_BYTES: u64 = 1 << 20;

struct Open {
    file: mcap::Writer<BufWriter<File>>,
    /// Channel and number of the last message, by topic.
    topics: BTreeMap<&'static str, (u16, u32)>,
}

/// One file; closed with the node.
pub(super) struct RecordingFace {
    path: PathBuf,
    open: Mutex<Option<Open>>,
}

impl std::fmt::Debug for RecordingFace {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "RecordingFace({})", self.path.display())
    }
}

impl RecordingFace {
    /// A file of that name is replaced.
    pub(super) fn create(path: &Path) -> Result<Self, PublishError> {
        let fault = |reason: String| PublishError::Record {
            reason,
            path: path.to_owned(),
        };
        let file = File::create(path).map_err(|e| fault(e.to_string()))?;
        let file = mcap::WriteOptions::new()
            .profile("ros2")
            .chunk_size(Some(CHUNK_BYTES))
            .create(BufWriter::new(file))
            .map_err(|e| fault(e.to_string()))?;
        Ok(Self {
            path: path.to_owned(),
            open: Mutex::new(Some(Open {
                file,
                topics: BTreeMap::new(),
            })),
        })
    }

    fn fault(&self, e: &mcap::McapError) -> PublishError {
        PublishError::Record {
            reason: e.to_string(),
            path: self.path.clone(),
        }
    }
}

impl Open {
    fn write(&mut self, post: &Post) -> mcap::McapResult<()> {
        let topic = post.topic;
        let (channel_id, sequence) = match self.topics.get(topic.name) {
            Some(known) => *known,
            None => {
                let schema = self.file.add_schema(
                    topic.type_name,
                    "ros2msg",
                    topic.definition.as_bytes(),
                )?;
                let name = match topic.name.strip_prefix('/') {
                    Some(_) => topic.name.to_owned(),
                    None => format!("/splat_mapper/{}", topic.name),
                };
                let channel = self
                    .file
                    .add_channel(schema, &name, "cdr", &BTreeMap::new())?;
                (channel, 0)
            }
        };
        self.topics.insert(topic.name, (channel_id, sequence + 1));
        let nanos = u64::try_from(post.stamp.nanos).unwrap_or(0);
        let header = MessageHeader {
            channel_id,
            sequence,
            log_time: nanos,
            publish_time: nanos,
        };
        self.file.write_to_known_channel(&header, &post.payload)
    }
}

impl Face for RecordingFace {
    fn send(&self, post: &Post) -> Result<(), PublishError> {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        match open.as_mut() {
            Some(open) => open.write(post).map_err(|e| self.fault(&e)),
            None => Ok(()),
        }
    }

    fn close(&self) -> Result<(), PublishError> {
        let open = self
            .open
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take();
        match open {
            Some(mut open) => match open.file.finish() {
                Ok(_) => Ok(()),
                Err(e) => Err(self.fault(&e)),
            },
            None => Ok(()),
        }
    }
}
