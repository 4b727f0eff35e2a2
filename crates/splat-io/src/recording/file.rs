//! Messages -> MCAP files, a chunk at a time: each goes to the disk whole, so that a crash costs the last one only.

use std::fs::{File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use crate::bag_writer::{BagWriter, Topic, options};
use crate::params::RecordParams;
use crate::recording::item::{RecordError, RecordedImage, Written};
use splat_msgs::ros::{CameraInfo, CompressedImage, Image};
use splat_types::time::Stopwatch;

/// Gathers what is written, and brings it to the disk when it is flushed.
#[derive(Debug)]
struct Durable {
    file: File,
    waiting: Vec<u8>,
    n_bytes: u64,
    written: Arc<Written>,
}

impl Write for Durable {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.waiting.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        self.file.write_all(&self.waiting)?;
        self.file.sync_data()?;
        let n_bytes = self.waiting.len() as u64;
        self.n_bytes += n_bytes;
        self.written.n_bytes.fetch_add(n_bytes, Ordering::Relaxed);
        self.waiting.clear();
        Ok(())
    }
}

impl Seek for Durable {
    /// The writer asks where it is; it is instructed not to seek.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match to {
            SeekFrom::Current(0) => Ok(self.n_bytes + self.waiting.len() as u64),
            _ => Err(io::Error::from(io::ErrorKind::Unsupported)),
        }
    }
}

/// The file under way, and its topics once they are used.
struct Part {
    bag: BagWriter<Durable>,
    path: PathBuf,
    compressed: Option<Topic>,
    raw: Option<Topic>,
    info: Option<Topic>,
    age: Stopwatch,
    /// Since the last chunk went to disk.
    since_chunk: Stopwatch,
    chunk_bytes: u64,
    n_bytes: u64,
}

/// One recording: one file, or several in a row.
pub(crate) struct Files {
    out: PathBuf,
    params: RecordParams,
    written: Arc<Written>,
    part: Part,
    /// Finished ones, the oldest first.
    paths: Vec<PathBuf>,
    next_number: u64,
}

impl Files {
    pub(crate) fn create(
        out: &Path,
        params: &RecordParams,
        written: &Arc<Written>,
    ) -> Result<Self, RecordError> {
        Ok(Self {
            out: out.to_owned(),
            params: params.clone(),
            written: Arc::clone(written),
            part: Part::create(out, params, written)?,
            paths: Vec::new(),
            next_number: 1,
        })
    }

    pub(crate) fn write(&mut self, image: RecordedImage) -> Result<(), RecordError> {
        let params = &self.params;
        let max_bytes = params.max_file_mib << 20;
        let is_full = max_bytes > 0 && self.part.n_bytes >= max_bytes;
        let is_old = params.max_file_secs > 0.0 && self.part.age.secs() >= params.max_file_secs;
        if is_full || is_old {
            self.next_part()?;
        }
        let path = self.part.path.clone();
        self.part
            .write(image, &self.params)
            .map_err(|reason| RecordError::Write { reason, path })
    }

    fn next_part(&mut self) -> Result<(), RecordError> {
        let path = numbered(&self.out, self.next_number);
        self.next_number += 1;
        let next = Part::create(&path, &self.params, &self.written)?;
        let full = std::mem::replace(&mut self.part, next);
        let path = full.path.clone();
        full.finish()?;
        self.paths.push(path);
        // The one under way counts too.
        while self.params.max_files > 0 && self.paths.len() >= self.params.max_files {
            let oldest = self.paths.remove(0);
            if let Err(e) = std::fs::remove_file(&oldest) {
                tracing::warn!("cannot remove an old file: {e}: {}", oldest.display());
            }
        }
        Ok(())
    }

    pub(crate) fn finish(self) -> Result<(), RecordError> {
        self.part.finish()
    }
}

/// `drive.mcap` -> `drive_1.mcap`: names that sort in the order of time.
fn numbered(out: &Path, number: u64) -> PathBuf {
    let stem = out.file_stem().unwrap_or_default().to_string_lossy();
    out.with_file_name(format!("{stem}_{number}.mcap"))
}

impl Part {
    fn create(
        path: &Path,
        params: &RecordParams,
        written: &Arc<Written>,
    ) -> Result<Self, RecordError> {
        let failed = |reason: String| RecordError::Write {
            reason,
            path: path.to_owned(),
        };
        let file = OpenOptions::new().write(true).create_new(true).open(path);
        let file = file.map_err(|e| match e.kind() {
            io::ErrorKind::AlreadyExists => RecordError::Exists {
                path: path.to_owned(),
            },
            _ => failed(e.to_string()),
        })?;
        let durable = Durable {
            file,
            waiting: Vec::new(),
            n_bytes: 0,
            written: Arc::clone(written),
        };
        // Chunks end here, by size and time, not in the library.
        let options = options(params.compression_level)
            .disable_seeking(true)
            .chunk_size(None);
        let mut bag = BagWriter::new(options, durable).map_err(failed)?;
        bag.flush().map_err(failed)?;
        written.n_files.fetch_add(1, Ordering::Relaxed);
        Ok(Self {
            bag,
            path: path.to_owned(),
            compressed: None,
            raw: None,
            info: None,
            age: Stopwatch::start(),
            since_chunk: Stopwatch::start(),
            chunk_bytes: 0,
            n_bytes: 0,
        })
    }

    fn write(&mut self, image: RecordedImage, params: &RecordParams) -> Result<(), String> {
        let stamp = image.stamp;
        let nanos = u64::try_from(stamp.nanos)
            .map_err(|e| format!("stamp {stamp} lies before the epoch: {e}"))?;
        let namespace = params.namespace.trim_end_matches('/');
        let bag = &mut self.bag;
        let (message, info) = image.messages(&params.frame_id);
        if let Some(info) = info {
            let name = format!("{namespace}/camera_info");
            let topic = used::<CameraInfo>(&mut self.info, bag, &name)?;
            bag.write(topic, nanos, &info)?;
        }
        let n_bytes = match message {
            Ok(message) => {
                let name = format!("{namespace}/image_raw/compressed");
                let topic = used::<CompressedImage>(&mut self.compressed, bag, &name)?;
                bag.write(topic, nanos, &message)?;
                message.data.len() as u64
            }
            Err(message) => {
                let name = format!("{namespace}/image_raw");
                let topic = used::<Image>(&mut self.raw, bag, &name)?;
                bag.write(topic, nanos, &message)?;
                message.data.len() as u64
            }
        };
        self.n_bytes += n_bytes;
        self.chunk_bytes += n_bytes;
        let is_large = self.chunk_bytes >= params.chunk_kib << 10;
        if is_large || self.since_chunk.secs() >= params.chunk_secs {
            bag.flush()?;
            tracing::debug!("{} messages are on disk", bag.n_messages);
            self.chunk_bytes = 0;
            self.since_chunk = Stopwatch::start();
        }
        Ok(())
    }

    fn finish(self) -> Result<(), RecordError> {
        let path = self.path;
        let finished = self.bag.finish();
        let flushed = finished.and_then(|mut file| file.flush().map_err(|e| e.to_string()));
        flushed.map_err(|reason| RecordError::Write { reason, path })
    }
}

/// The topic, which is written into the file when it is first used.
fn used<'a, T: splat_msgs::ros::Message>(
    topic: &'a mut Option<Topic>,
    bag: &mut BagWriter<Durable>,
    name: &str,
) -> Result<&'a mut Topic, String> {
    if topic.is_none() {
        *topic = Some(bag.topic::<T>(name)?);
    }
    Ok(topic.as_mut().expect("made above"))
}
