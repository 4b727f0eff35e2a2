//! A section of a `.splatmap` file: tag, length, content, CRC32C of all three.

use std::fs::File;
use std::io::{self, Read, Write};

use byteorder::{LittleEndian, ReadBytesExt, WriteBytesExt};

/// Tag, length, and behind the content the CRC.
const SECTION_FRAME_BYTES: u64 = 16;

type Section = ([u8; 4], Vec<u8>);

pub(crate) fn write_section(
    file: &mut dyn Write,
    tag: [u8; 4],
    n_bytes: u64,
    fill: &dyn Fn(&mut dyn Write) -> io::Result<()>,
) -> io::Result<()> {
    let mut section = Checked {
        file,
        crc: 0,
        n_bytes: 0,
    };
    section.write_all(&tag)?;
    section.write_all(&n_bytes.to_le_bytes())?;
    fill(&mut section)?;
    let Checked {
        file,
        crc,
        n_bytes: n_written,
    } = section;
    assert_eq!(
        n_written,
        n_bytes + SECTION_FRAME_BYTES - 4,
        "a section is as long as it says"
    );
    file.write_u32::<LittleEndian>(crc)
}

/// Counts and checks what goes through.
struct Checked<'a> {
    file: &'a mut dyn Write,
    crc: u32,
    n_bytes: u64,
}

impl Write for Checked<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = self.file.write(bytes)?;
        self.crc = crc32c::crc32c_append(self.crc, &bytes[..n]);
        self.n_bytes += n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// The outer result is the disk's, the inner one the format's.
pub(crate) fn read_section(
    file: &mut File,
    remaining_bytes: &mut u64,
) -> io::Result<Result<Section, String>> {
    if *remaining_bytes < SECTION_FRAME_BYTES {
        return Ok(Err(format!(
            "the file ends, {remaining_bytes} bytes are left"
        )));
    }
    let mut tag = [0; 4];
    file.read_exact(&mut tag)?;
    let mut length = [0; 8];
    file.read_exact(&mut length)?;
    let n_bytes = u64::from_le_bytes(length);
    *remaining_bytes -= SECTION_FRAME_BYTES;
    if n_bytes > *remaining_bytes {
        return Ok(Err(format!(
            "{n_bytes} bytes announced, {remaining_bytes} are left"
        )));
    }
    *remaining_bytes -= n_bytes;
    let mut content = vec![0; n_bytes as usize];
    file.read_exact(&mut content)?;
    let crc = file.read_u32::<LittleEndian>()?;
    let parts: [&[u8]; 3] = [&tag, &length, &content];
    let found = parts.into_iter().fold(0, crc32c::crc32c_append);
    if crc != found {
        return Ok(Err(format!("the CRC of its {n_bytes} bytes does not fit")));
    }
    Ok(Ok((tag, content)))
}
