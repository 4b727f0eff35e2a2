//! The files of a recording -> messages, in the order of the files.

use std::path::{Component, Path, PathBuf};

use crate::bag_channel::Channel;
use crate::bag_file::BagFile;
use crate::error::SourceError;
use crate::small_file::{natural_order, read_small};

/// A metadata.yaml names files and topics; a larger one is something else.
const MAX_METADATA_BYTES: u64 = 16 << 20;

#[derive(Debug)]
pub(crate) struct Message<'a> {
    pub channel: &'a Channel,
    pub log_nanos: i64,
    pub payload: &'a [u8],
}

/// The files of one recording, read one after the other.
#[derive(Debug)]
pub(crate) struct Bag {
    files: Vec<PathBuf>,
    next_file: usize,
    file: Option<BagFile>,
    is_at_end: bool,
}

impl Bag {
    pub(crate) fn new(files: Vec<PathBuf>) -> Self {
        Self {
            files,
            next_file: 0,
            file: None,
            is_at_end: false,
        }
    }

    /// The next message; `Ok(None)` at the end. After a fault, whose text says what and where, there is no more.
    pub(crate) fn next_message(&mut self) -> Result<Option<Message<'_>>, String> {
        if self.is_at_end {
            return Ok(None);
        }
        let head = self.advance().inspect_err(|_| self.is_at_end = true)?;
        let Some((channel_id, log_nanos)) = head else {
            self.is_at_end = true;
            return Ok(None);
        };
        let file = self.file.as_ref().expect("a message came from a file");
        let channel = file
            .channels
            .get(&channel_id)
            .expect("advance skips unknown channels");
        Ok(Some(Message {
            channel,
            log_nanos,
            payload: file.payload(),
        }))
    }

    fn advance(&mut self) -> Result<Option<(u16, i64)>, String> {
        loop {
            if self.file.is_none() {
                let Some(path) = self.files.get(self.next_file) else {
                    return Ok(None);
                };
                self.file = Some(BagFile::open(path)?);
                self.next_file += 1;
            }
            let file = self.file.as_mut().expect("opened above");
            let found = file.next_message();
            match found.map_err(|reason| {
                format!("{reason}: {}", self.files[self.next_file - 1].display())
            })? {
                Some(head) => return Ok(Some(head)),
                None => self.file = None,
            }
        }
    }
}

/// Why a file cannot be an MCAP recording; `None` when it begins like one.
pub(crate) fn not_mcap(path: &Path) -> Option<String> {
    BagFile::open(path).err()
}

/// The files of a recording in order.
pub(crate) fn files_of(path: &Path) -> Result<Vec<PathBuf>, SourceError> {
    let fail = |reason: String, way_out| SourceError::Open {
        what: "recording",
        reason,
        way_out,
        path: path.to_owned(),
    };
    let metadata = std::fs::metadata(path)
        .map_err(|e| fail(e.to_string(), "name an .mcap file or a rosbag2 folder"))?;
    if !metadata.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries =
        std::fs::read_dir(path).map_err(|e| fail(e.to_string(), "make the folder readable"))?;
    let mut found: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    let is_packed = |file: &PathBuf| file.to_string_lossy().ends_with(".mcap.zstd");
    let has_packed = found.iter().any(is_packed);
    found.retain(|file| {
        file.extension()
            .is_some_and(|extension| extension == "mcap")
    });
    found.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
    let listed = listed_files(path);
    if !listed.is_empty() && listed.iter().all(|file| file.is_file()) {
        return Ok(listed);
    }
    if !listed.is_empty() && !found.is_empty() {
        tracing::warn!(
            "metadata.yaml lists files that are not there; all .mcap files are read by name: {}",
            path.display()
        );
    }
    if found.is_empty() {
        let (reason, way_out) = if has_packed {
            (
                "its files are compressed as a whole",
                "unpack them with zstd -d --rm *.zstd and run ros2 bag reindex",
            )
        } else {
            (
                "no .mcap file is in it",
                "convert a .db3 bag with ros2 bag convert to storage mcap",
            )
        };
        return Err(fail(reason.to_owned(), way_out));
    }
    Ok(found)
}

/// What metadata.yaml says; empty when there is none or it makes no sense. Names that leave the folder make none.
fn listed_files(folder: &Path) -> Vec<PathBuf> {
    let Ok(text) = read_small(&folder.join("metadata.yaml"), MAX_METADATA_BYTES) else {
        return Vec::new();
    };
    let Ok(tree) = serde_saphyr::from_str::<serde_json::Value>(&String::from_utf8_lossy(&text))
    else {
        tracing::warn!(
            "metadata.yaml is not YAML, all .mcap files are read by name: {}",
            folder.display()
        );
        return Vec::new();
    };
    let names = tree
        .pointer("/rosbag2_bagfile_information/relative_file_paths")
        .and_then(|v| v.as_array());
    let plain = |name: &serde_json::Value| {
        let name = name.as_str()?;
        let is_plain = Path::new(name)
            .components()
            .all(|part| matches!(part, Component::Normal(_)));
        (is_plain && !name.is_empty() && name.ends_with(".mcap")).then(|| folder.join(name))
    };
    names
        .and_then(|names| names.iter().map(plain).collect())
        .unwrap_or_default()
}
