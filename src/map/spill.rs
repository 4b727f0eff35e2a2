//! Records that memory has no room for -> a file without a name, and back. It goes with the process, also after a crash.
//!
//! Each record has a CRC32C. Space of records that nobody holds is given to later ones, and the file has a limit.

use std::fs::{File, OpenOptions};
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};

/// A file with room for `max_bytes` of records.
#[derive(Debug, Clone)]
pub struct Spill {
    shared: Arc<Shared>,
}

/// A record on disk. Its space is free again when the last one who holds it lets go.
#[derive(Debug)]
pub struct Slot {
    offset: u64,
    n_bytes: u64,
    crc: u32,
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    file: File,
    max_bytes: u64,
    space: Mutex<Space>,
}

#[derive(Debug, Default)]
struct Space {
    /// (offset, bytes), by offset, none beside another.
    free: Vec<(u64, u64)>,
    end: u64,
}

impl Spill {
    /// In `folder`; the name is taken away at once.
    pub fn new(folder: &Path, max_bytes: u64) -> io::Result<Self> {
        let mut number = 0_u32;
        let (file, path) = loop {
            let path = folder.join(format!(".spill-{}-{number}", std::process::id()));
            let made = OpenOptions::new()
                .read(true)
                .write(true)
                .create_new(true)
                .open(&path);
            match made {
                Ok(file) => break (file, path),
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists && number < 1000 => number += 1,
                Err(e) => return Err(e),
            }
        };
        std::fs::remove_file(path)?;
        Ok(Self {
            shared: Arc::new(Shared {
                file,
                max_bytes,
                space: Mutex::default(),
            }),
        })
    }

    /// `None`: there is no room within the limit.
    pub fn put(&self, bytes: &[u8]) -> io::Result<Option<Slot>> {
        let n_bytes = bytes.len() as u64;
        let Some(offset) = self.shared.space().take(n_bytes, self.shared.max_bytes) else {
            return Ok(None);
        };
        let slot = Slot {
            offset,
            n_bytes,
            crc: crc32c::crc32c(bytes),
            shared: Arc::clone(&self.shared),
        };
        write_at(&self.shared.file, bytes, offset)?;
        Ok(Some(slot))
    }

    /// Bytes that records take at this moment.
    pub fn held_bytes(&self) -> u64 {
        let space = self.shared.space();
        space.end - space.free.iter().map(|(_, n)| n).sum::<u64>()
    }
}

impl Slot {
    pub fn n_bytes(&self) -> u64 {
        self.n_bytes
    }

    pub fn read(&self) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; self.n_bytes as usize];
        read_at(&self.shared.file, &mut bytes, self.offset)?;
        if crc32c::crc32c(&bytes) != self.crc {
            return Err(io::Error::other("a record in the spill file is damaged"));
        }
        Ok(bytes)
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.shared.space().give(self.offset, self.n_bytes);
    }
}

impl Shared {
    fn space(&self) -> MutexGuard<'_, Space> {
        // Nothing that holds the lock can panic half way.
        self.space
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

impl Space {
    /// The first gap that is large enough, else the end.
    fn take(&mut self, n_bytes: u64, max_bytes: u64) -> Option<u64> {
        if let Some(ix) = self.free.iter().position(|(_, free)| *free >= n_bytes) {
            let (offset, free) = self.free[ix];
            if free == n_bytes {
                self.free.remove(ix);
            } else {
                self.free[ix] = (offset + n_bytes, free - n_bytes);
            }
            return Some(offset);
        }
        let offset = self.end;
        let end = offset
            .checked_add(n_bytes)
            .filter(|end| *end <= max_bytes)?;
        self.end = end;
        Some(offset)
    }

    fn give(&mut self, offset: u64, n_bytes: u64) {
        if n_bytes == 0 {
            return;
        }
        let ix = self.free.partition_point(|(other, _)| *other < offset);
        self.free.insert(ix, (offset, n_bytes));
        if let Some((next, n_next)) = self.free.get(ix + 1).copied()
            && offset + n_bytes == next
        {
            self.free[ix].1 += n_next;
            self.free.remove(ix + 1);
        }
        if ix > 0 && self.free[ix - 1].0 + self.free[ix - 1].1 == offset {
            self.free[ix - 1].1 += self.free[ix].1;
            self.free.remove(ix);
        }
        if let Some((last, n_last)) = self.free.last().copied()
            && last + n_last == self.end
        {
            self.end = last;
            self.free.pop();
        }
    }
}

#[cfg(unix)]
fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset)
}

#[cfg(unix)]
fn write_at(file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::write_all_at(file, bytes, offset)
}

#[cfg(windows)]
fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    let mut done = 0;
    while done < bytes.len() {
        let at = offset + done as u64;
        match std::os::windows::fs::FileExt::seek_read(file, &mut bytes[done..], at)? {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            n => done += n,
        }
    }
    Ok(())
}

#[cfg(windows)]
fn write_at(file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
    let mut done = 0;
    while done < bytes.len() {
        let at = offset + done as u64;
        done += std::os::windows::fs::FileExt::seek_write(file, &bytes[done..], at)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_come_back_and_their_space_is_used_again() {
        let folder = tempfile::tempdir().unwrap();
        // Four records of up to 160 bytes, and gaps between them.
        let spill = Spill::new(folder.path(), 1600).unwrap();
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            0,
            "the file has no name"
        );
        let record = |k: u8| vec![k; 100 + usize::from(k)];
        let mut held: Vec<(u8, Slot)> = Vec::new();
        for k in 0..60_u8 {
            let slot = spill.put(&record(k)).unwrap();
            held.push((k, slot.expect("space of what is gone is free")));
            if held.len() > 4 {
                // Now the first, now one between others.
                held.remove(usize::from(k) % 3);
            }
            for (k, slot) in &held {
                assert!(slot.read().unwrap() == record(*k));
            }
        }
        held.clear();
        assert_eq!(spill.held_bytes(), 0);
        assert!(
            spill.put(&[0; 1601]).unwrap().is_none(),
            "the file has a limit"
        );
    }

    #[test]
    fn a_record_that_was_changed_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let spill = Spill::new(folder.path(), 1000).unwrap();
        let slot = spill.put(b"a record").unwrap().unwrap();
        write_at(&spill.shared.file, b"B", 2).unwrap();
        assert!(slot.read().is_err());
    }
}
