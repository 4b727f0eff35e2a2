//! Little-endian numbers and names from a file that may lie about its lengths: nothing is reserved, all is counted.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

/// Longest name of an image, as file systems have it.
const MAX_NAME_BYTES: u64 = 4096;

/// A file read from its beginning. Errors are sentences without the path.
#[derive(Debug)]
pub(crate) struct Binary {
    file: BufReader<File>,
}

impl Binary {
    pub(crate) fn open(path: &Path) -> Result<Self, String> {
        let is_file = std::fs::metadata(path).is_ok_and(|m| m.is_file());
        if !is_file {
            return Err("not a regular file".to_owned());
        }
        let file = File::open(path).map_err(|e| e.to_string())?;
        Ok(Self {
            file: BufReader::new(file),
        })
    }

    pub(crate) fn u64(&mut self, what: &str) -> Result<u64, String> {
        self.bytes(what).map(u64::from_le_bytes)
    }

    pub(crate) fn i32(&mut self, what: &str) -> Result<i32, String> {
        self.bytes(what).map(i32::from_le_bytes)
    }

    pub(crate) fn f64s<const N: usize>(&mut self, what: &str) -> Result<[f64; N], String> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.bytes(what)?);
        }
        Ok(values)
    }

    pub(crate) fn u8s<const N: usize>(&mut self, what: &str) -> Result<[u8; N], String> {
        self.bytes(what)
    }

    /// Up to a zero byte.
    pub(crate) fn name(&mut self) -> Result<String, String> {
        let mut bytes = Vec::new();
        let mut limited = self.file.by_ref().take(MAX_NAME_BYTES);
        limited
            .read_until(0, &mut bytes)
            .map_err(|e| e.to_string())?;
        if bytes.pop() != Some(0) {
            return Err("a name without end".to_owned());
        }
        String::from_utf8(bytes).map_err(|e| format!("a name that is no UTF-8: {e}"))
    }

    /// Passes over `n` rows of so many bytes.
    pub(crate) fn skip(&mut self, n: u64, row_bytes: u64, what: &str) -> Result<(), String> {
        let too_short = || format!("it ends before its {n} {what}");
        let bytes = n.checked_mul(row_bytes).ok_or_else(too_short)?;
        let mut rest = self.file.by_ref().take(bytes);
        let passed = std::io::copy(&mut rest, &mut std::io::sink()).map_err(|e| e.to_string())?;
        if passed == bytes {
            Ok(())
        } else {
            Err(too_short())
        }
    }

    fn bytes<const N: usize>(&mut self, what: &str) -> Result<[u8; N], String> {
        let mut bytes = [0; N];
        self.file
            .read_exact(&mut bytes)
            .map_err(|e| match e.kind() {
                std::io::ErrorKind::UnexpectedEof => format!("it ends within {what}"),
                _ => e.to_string(),
            })?;
        Ok(bytes)
    }
}
