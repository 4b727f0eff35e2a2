//! The map's page store as a file without a name: records go out of memory and come back. The file goes with the process,
//! also after a crash.
//!
//! Each record has a CRC32C. The space of dropped records is used again, and the file has a limit.

use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

use splat_types::pages::{Page, PageStore};

/// A file with room for `max_bytes` of records, created when the first record comes.
#[derive(Debug)]
pub struct PageFile {
    folder: PathBuf,
    max_bytes: u64,
    file: OnceLock<Arc<Shared>>,
}

/// A record in the file.
#[derive(Debug)]
struct Record {
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

impl PageFile {
    /// In `folder`, or where temporary files go.
    pub fn new(folder: Option<&Path>, max_bytes: u64) -> Self {
        Self {
            folder: folder.map_or_else(std::env::temp_dir, Path::to_owned),
            max_bytes,
            file: OnceLock::new(),
        }
    }

    /// Bytes that records take at this moment.
    pub fn held_bytes(&self) -> u64 {
        self.file.get().map_or(0, |shared| {
            let space = shared.space();
            space.end - space.free.iter().map(|(_, n)| n).sum::<u64>()
        })
    }

    /// The file, created at its first use; an error is tried again at the next one.
    fn shared(&self) -> io::Result<&Arc<Shared>> {
        if let Some(shared) = self.file.get() {
            return Ok(shared);
        }
        let fresh = Arc::new(Shared {
            file: unnamed_file(&self.folder)?,
            max_bytes: self.max_bytes,
            space: Mutex::default(),
        });
        Ok(self.file.get_or_init(|| fresh))
    }
}

impl PageStore for PageFile {
    fn put(&self, bytes: &[u8]) -> io::Result<Option<Box<dyn Page>>> {
        let shared = self.shared()?;
        let n_bytes = bytes.len() as u64;
        let Some(offset) = shared.space().take(n_bytes, shared.max_bytes) else {
            return Ok(None);
        };
        let record = Record {
            offset,
            n_bytes,
            crc: crc32c::crc32c(bytes),
            shared: Arc::clone(shared),
        };
        write_at(&shared.file, bytes, offset)?;
        Ok(Some(Box::new(record)))
    }

    fn describe(&self) -> String {
        let mib = self.max_bytes >> 20;
        format!("a file of at most {mib} MiB in {}", self.folder.display())
    }
}

impl Page for Record {
    fn n_bytes(&self) -> u64 {
        self.n_bytes
    }

    fn read(&self) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; self.n_bytes as usize];
        read_at(&self.shared.file, &mut bytes, self.offset)?;
        if crc32c::crc32c(&bytes) != self.crc {
            return Err(io::Error::other("a record of the page file is damaged"));
        }
        Ok(bytes)
    }
}

/// A file whose name is taken away at once.
fn unnamed_file(folder: &Path) -> io::Result<File> {
    let mut number = 0_u32;
    let (file, path) = loop {
        let path = folder.join(format!(".pages-{}-{number}", std::process::id()));
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
    Ok(file)
}

impl Drop for Record {
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
        let store = PageFile::new(Some(folder.path()), 1600);
        drop(store.put(&[1]).unwrap());
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            0,
            "the file has no name"
        );
        let record = |k: u8| vec![k; 100 + usize::from(k)];
        let mut held: Vec<(u8, Box<dyn Page>)> = Vec::new();
        for k in 0..60_u8 {
            let page = store.put(&record(k)).unwrap();
            held.push((k, page.expect("space of what is gone is free")));
            if held.len() > 4 {
                // Now the first, now one between others.
                held.remove(usize::from(k) % 3);
            }
            for (k, page) in &held {
                assert!(page.read().unwrap() == record(*k));
            }
        }
        held.clear();
        assert_eq!(store.held_bytes(), 0);
        assert!(
            store.put(&[0; 1601]).unwrap().is_none(),
            "the file has a limit"
        );
    }

    #[test]
    fn a_record_that_was_changed_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let store = PageFile::new(Some(folder.path()), 1000);
        let page = store.put(b"a record").unwrap().unwrap();
        write_at(&store.shared().unwrap().file, b"B", 2).unwrap();
        assert!(page.read().is_err());
    }
}
