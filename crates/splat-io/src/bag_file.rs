//! One MCAP file -> its schemas, channels and messages, with memory bounded by one chunk.
//!
//! Walks the records itself and checks each length against the bytes that are there before anything is read;
//! the `mcap` crate opens the chunks. A chunk's checksum is checked before any of its messages is handed out;
//! of a chunk that the end of the file cuts off, the messages that are whole come out unchecked.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use mcap::records::op;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::bag_channel::Channel;

/// Opcode and length in front of each record.
const RECORD_HEAD_BYTES: u64 = 9;
/// Channel, sequence, log time and publish time in front of each message.
const MESSAGE_HEAD_BYTES: usize = 22;
/// Memory that one record or chunk may take whatever the file's length: an 8K image fits.
const MAX_RECORD_BYTES: u64 = 256 << 20;
/// A compressed chunk of a small file may unpack to so much, and to four times the file beyond it.
const FREE_RECORD_BYTES: u64 = 64 << 20;
/// Names of compressions are short; a longer one is a fault.
const MAX_COMPRESSION_NAME: u32 = 16;

/// A chunk that is being unpacked.
struct Chunk {
    reader: LinearReader,
    /// Bytes of the chunk that are in the file and not yet read.
    remaining: u64,
    is_cut_off: bool,
}

pub(crate) struct BagFile {
    reader: BufReader<File>,
    position: u64,
    file_bytes: u64,
    max_record_bytes: u64,
    chunk: Option<Chunk>,
    schemas: BTreeMap<u16, String>,
    pub channels: BTreeMap<u16, Channel>,
    /// The record read last, without opcode and length.
    record: Vec<u8>,
}

impl std::fmt::Debug for BagFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BagFile")
            .field("position", &self.position)
            .finish_non_exhaustive()
    }
}

impl BagFile {
    pub(crate) fn open(path: &Path) -> Result<Self, String> {
        let on_path = |reason: String| format!("{reason}: {}", path.display());
        let metadata = std::fs::metadata(path).map_err(|e| on_path(e.to_string()))?;
        // A device or pipe has no length to hold declared lengths against.
        if !metadata.is_file() {
            return Err(on_path("not a regular file".to_owned()));
        }
        let file = File::open(path).map_err(|e| on_path(e.to_string()))?;
        let file_bytes = metadata.len();
        let mut reader = BufReader::with_capacity(1 << 16, file);
        let mut magic = Vec::with_capacity(mcap::MAGIC.len());
        let read = reader
            .by_ref()
            .take(mcap::MAGIC.len() as u64)
            .read_to_end(&mut magic);
        read.map_err(|e| on_path(e.to_string()))?;
        if magic != mcap::MAGIC {
            let found = if magic.is_empty() {
                "is empty".to_owned()
            } else {
                format!("begins with {magic:02x?}")
            };
            return Err(on_path(format!(
                "the file {found}, an MCAP begins with {:02x?}",
                mcap::MAGIC
            )));
        }
        Ok(Self {
            reader,
            position: magic.len() as u64,
            file_bytes,
            max_record_bytes: (FREE_RECORD_BYTES + 4 * file_bytes).min(MAX_RECORD_BYTES),
            chunk: None,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            record: Vec::new(),
        })
    }

    /// Channel and log time of the next message, whose bytes are then in `record`; `None` at the end of the data.
    pub(crate) fn next_message(&mut self) -> Result<Option<(u16, i64)>, String> {
        while let Some(opcode) = self.next_record()? {
            match opcode {
                op::SCHEMA => self.add_schema()?,
                op::CHANNEL => self.add_channel()?,
                op::MESSAGE => {
                    let mut fields = Fields { rest: &self.record };
                    let head =
                        || Some((fields.u16()?, fields.u32()?, fields.u64()?, fields.u64()?));
                    let (channel_id, _, log_nanos, _) = { head }()
                        .ok_or_else(|| self.fault("a message shorter than its own header"))?;
                    if self.channels.contains_key(&channel_id) {
                        return Ok(Some((
                            channel_id,
                            i64::try_from(log_nanos).unwrap_or(i64::MAX),
                        )));
                    }
                    return Err(self.fault(&format!(
                        "a message of channel {channel_id}, which no record describes"
                    )));
                }
                _ => {}
            }
        }
        Ok(None)
    }

    /// What the message read last carries.
    pub(crate) fn payload(&self) -> &[u8] {
        self.record.get(MESSAGE_HEAD_BYTES..).unwrap_or_default()
    }

    fn fault(&self, what: &str) -> String {
        format!("recording is damaged near byte {}: {what}", self.position)
    }

    /// Opcode of the next schema, channel or message, in or out of a chunk; its bytes are then in `record`.
    fn next_record(&mut self) -> Result<Option<u8>, String> {
        loop {
            if self.chunk.is_some() {
                if let Some(opcode) = self.next_in_chunk()? {
                    return Ok(Some(opcode));
                }
                self.chunk = None;
            }
            let Some((opcode, length)) = self.record_head()? else {
                return Err(
                    self.fault("it ends without an end record, the recorder may have been killed")
                );
            };
            if opcode == op::DATA_END {
                return self.check_end().map(|()| None);
            }
            let available = self.file_bytes - self.position;
            if opcode == op::CHUNK {
                self.open_chunk(length, available)?;
                continue;
            }
            if length > available {
                return Err(
                    self.fault(&format!("a record of {length} bytes, {available} are left"))
                );
            }
            let is_wanted = matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE);
            if !is_wanted {
                self.skip(length)?;
                continue;
            }
            if length > self.max_record_bytes {
                let most = self.max_record_bytes;
                return Err(self.fault(&format!(
                    "a record of {length} bytes, at most {most} are read"
                )));
            }
            self.record.clear();
            let read = self
                .reader
                .by_ref()
                .take(length)
                .read_to_end(&mut self.record);
            let n_read = read.map_err(|e| self.fault(&e.to_string()))? as u64;
            self.position += n_read;
            if n_read < length {
                return Err(self.fault("the file became shorter while it was read"));
            }
            return Ok(Some(opcode));
        }
    }

    /// Opcode and length of the next record outside chunks; `None` at the end of the file.
    fn record_head(&mut self) -> Result<Option<(u8, u64)>, String> {
        if self.file_bytes - self.position < RECORD_HEAD_BYTES {
            return Ok(None);
        }
        let mut head = [0; RECORD_HEAD_BYTES as usize];
        self.reader
            .read_exact(&mut head)
            .map_err(|e| self.fault(&e.to_string()))?;
        self.position += RECORD_HEAD_BYTES;
        let mut fields = Fields { rest: &head[1..] };
        Ok(fields.u64().map(|length| (head[0], length)))
    }

    fn skip(&mut self, n_bytes: u64) -> Result<(), String> {
        // Lengths were held against the file's, which the file system keeps below i64::MAX.
        self.reader
            .seek_relative(n_bytes as i64)
            .map_err(|e| self.fault(&e.to_string()))?;
        self.position += n_bytes;
        Ok(())
    }

    /// All messages were read. A file cut in its index loses none, but it was cut, and that is worth a word.
    fn check_end(&mut self) -> Result<(), String> {
        let magic_bytes = mcap::MAGIC.len() as u64;
        let mut magic = Vec::with_capacity(mcap::MAGIC.len());
        let start = self.file_bytes.saturating_sub(magic_bytes);
        let sought = self.reader.seek(SeekFrom::Start(start));
        sought
            .and_then(|_| {
                self.reader
                    .by_ref()
                    .take(magic_bytes)
                    .read_to_end(&mut magic)
            })
            .map_err(|e| self.fault(&e.to_string()))?;
        if magic == mcap::MAGIC {
            return Ok(());
        }
        Err(self.fault(
            "its index at the end is cut off or overwritten; all messages before it were read",
        ))
    }

    fn open_chunk(&mut self, length: u64, available: u64) -> Result<(), String> {
        // Times, unpacked size, checksum, length of the compression's name; the name; packed size.
        let mut head = [0; 32];
        self.peek(&mut head, length.min(available))?;
        let mut fields = Fields { rest: &head[16..] };
        let (unpacked_bytes, _, name_bytes) =
            { || Some((fields.u64()?, fields.u32()?, fields.u32()?)) }()
                .ok_or_else(|| self.fault("a chunk without a header"))?;
        if name_bytes > MAX_COMPRESSION_NAME {
            return Err(self.fault(&format!(
                "a chunk whose compression has a name of {name_bytes} bytes"
            )));
        }
        let mut head = vec![0; 32 + name_bytes as usize + 8];
        self.peek(&mut head, length.min(available))?;
        let mut fields = Fields {
            rest: &head[32 + name_bytes as usize..],
        };
        let packed_bytes = fields
            .u64()
            .ok_or_else(|| self.fault("a chunk without a header"))?;
        let declared = length - head.len() as u64;
        // Also keeps records of an unpacked chunk inside it: the crate trusts this length.
        if packed_bytes > declared
            || (name_bytes == 0 && (packed_bytes != declared || unpacked_bytes != packed_bytes))
        {
            return Err(self.fault(&format!(
                "a chunk of {length} bytes that claims {packed_bytes} bytes of records"
            )));
        }
        let is_cut_off = length > available;
        let fits = unpacked_bytes <= self.max_record_bytes && packed_bytes <= self.max_record_bytes;
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_validate_chunk_crcs(true)
            .with_prevalidate_chunk_crcs(fits && !is_cut_off)
            .with_record_length_limit(self.max_record_bytes as usize);
        let mut reader = LinearReader::new_with_options(options);
        let mut record_head = [0; RECORD_HEAD_BYTES as usize];
        record_head[0] = op::CHUNK;
        record_head[1..].copy_from_slice(&length.to_le_bytes());
        reader
            .insert(record_head.len())
            .copy_from_slice(&record_head);
        reader.notify_read(record_head.len());
        self.chunk = Some(Chunk {
            reader,
            remaining: length.min(available),
            is_cut_off,
        });
        Ok(())
    }

    /// Reads ahead without moving on.
    fn peek(&mut self, target: &mut [u8], available: u64) -> Result<(), String> {
        if available < target.len() as u64 {
            return Err(self.fault("the file ends in the header of a chunk"));
        }
        let back = -(target.len() as i64);
        let read = self
            .reader
            .read_exact(target)
            .and_then(|()| self.reader.seek_relative(back));
        read.map_err(|e| self.fault(&e.to_string()))
    }

    fn next_in_chunk(&mut self) -> Result<Option<u8>, String> {
        loop {
            let chunk = self.chunk.as_mut().expect("called with a chunk");
            let wanted = match chunk.reader.next_event() {
                None => return Ok(None),
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    if matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
                        self.record.clear();
                        self.record.extend_from_slice(data);
                        return Ok(Some(opcode));
                    }
                    continue;
                }
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => wanted,
                Some(Err(e)) => {
                    let what = if chunk.is_cut_off {
                        "the file ends in a chunk".to_owned()
                    } else {
                        e.to_string()
                    };
                    return Err(self.fault(&what));
                }
            };
            let wanted = wanted.min(usize::try_from(chunk.remaining).unwrap_or(usize::MAX));
            let target = chunk.reader.insert(wanted);
            let n_read = self
                .reader
                .read(target)
                .map_err(|e| format!("cannot read on: {e}"))?;
            chunk.reader.notify_read(n_read);
            chunk.remaining -= n_read as u64;
            self.position += n_read as u64;
        }
    }

    fn add_schema(&mut self) -> Result<(), String> {
        let mut fields = Fields { rest: &self.record };
        let schema = { || Some((fields.u16()?, fields.text()?)) }();
        let (id, name) =
            schema.ok_or_else(|| self.fault("a schema shorter than its own lengths"))?;
        self.schemas.insert(id, name);
        Ok(())
    }

    fn add_channel(&mut self) -> Result<(), String> {
        let mut fields = Fields { rest: &self.record };
        let channel = { || Some((fields.u16()?, fields.u16()?, fields.text()?, fields.text()?)) }();
        let (id, schema_id, topic, message_encoding) =
            channel.ok_or_else(|| self.fault("a channel shorter than its own lengths"))?;
        let type_name = self.schemas.get(&schema_id).cloned().unwrap_or_default();
        self.channels.insert(
            id,
            Channel {
                topic,
                type_name,
                message_encoding,
            },
        );
        Ok(())
    }
}

/// Little-endian fields of a record; `None` once the bytes run out.
struct Fields<'a> {
    rest: &'a [u8],
}

impl Fields<'_> {
    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (bytes, rest) = self.rest.split_first_chunk::<N>()?;
        self.rest = rest;
        Some(*bytes)
    }

    fn u16(&mut self) -> Option<u16> {
        self.bytes().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.bytes().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.bytes().map(u64::from_le_bytes)
    }

    fn text(&mut self) -> Option<String> {
        let n_bytes = self.u32()? as usize;
        let (text, rest) = self.rest.split_at_checked(n_bytes)?;
        self.rest = rest;
        Some(String::from_utf8_lossy(text).into_owned())
    }
}
