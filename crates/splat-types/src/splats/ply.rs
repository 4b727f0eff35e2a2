//! Splats <-> the PLY that 3D Gaussian splatting programs share.
//!
//! Binary little endian, one `vertex` a splat, all numbers f32 and before activation, in the map frame. The numbers
//! are those of `Splats`, bit for bit; anchors do not travel and come back as 0. docs/FORMATS.md.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

use byteorder::{ByteOrder, LittleEndian};

use crate::splats::layout::{self, MAX_SH_DEGREE};
use crate::splats::splats::Splats;

#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error("cannot write the export: {reason}: {}", path.display())]
    Write { reason: String, path: PathBuf },
    #[error("cannot read the splats: {reason}: {}", path.display())]
    Read { reason: String, path: PathBuf },
    #[error("this is no 3D Gaussian splat PLY: {reason}: {}", path.display())]
    Format { reason: String, path: PathBuf },
}

/// A header of ours has under 2 kB; other programs add comments.
const MAX_HEADER_BYTES: u64 = 64 * 1024;
/// Rows written or read at once.
const ROWS_AT_ONCE: usize = 1024;
/// More than any program writes per vertex; bounds the row that a synthetic header asks for.
const MAX_PROPERTIES: usize = 512;

/// Writes the whole file to `out`, front to back.
pub fn write(splats: &Splats, out: &mut dyn Write) -> io::Result<()> {
    out.write_all(header(splats).as_bytes())?;
    let mut row = Vec::new();
    let mut bytes = Vec::new();
    for splat_ix in 0..splats.len() {
        row.clear();
        fill_row(splats, splat_ix, &mut row);
        bytes.resize(4 * row.len(), 0);
        LittleEndian::write_f32_into(&row, &mut bytes);
        out.write_all(&bytes)?;
    }
    Ok(())
}

/// Reads a PLY of ours or another program's: properties in any order, more of them allowed, all of them f32.
/// Asks for no more memory than the file has bytes.
pub fn read(path: &Path) -> Result<Splats, ExportError> {
    let io_fault = |e: io::Error| ExportError::Read {
        reason: e.to_string(),
        path: path.to_owned(),
    };
    let format_fault = |reason: String| ExportError::Format {
        reason,
        path: path.to_owned(),
    };
    let file = File::open(path).map_err(io_fault)?;
    let file_info = file.metadata().map_err(io_fault)?;
    if !file_info.is_file() {
        return Err(io_fault(io::Error::other("not a regular file")));
    }
    let mut file = BufReader::new(file);
    let (lines, header_bytes) = read_header(&mut file)
        .map_err(io_fault)?
        .map_err(format_fault)?;
    let table = parse_header(&lines).map_err(format_fault)?;
    let columns = Columns::find(&table.properties).map_err(format_fault)?;
    let expected_bytes = (table.n_vertices as u64).checked_mul(4 * table.properties.len() as u64);
    let found_bytes = file_info.len().saturating_sub(header_bytes);
    if expected_bytes.is_none_or(|expected| expected > found_bytes) {
        return Err(format_fault(format!(
            "the header promises {} vertices of {} numbers, {found_bytes} bytes follow",
            table.n_vertices,
            table.properties.len()
        )));
    }
    let splats = read_rows(&mut file, &table, &columns).map_err(io_fault)?;
    match layout::fault(&splats) {
        Some(reason) => Err(format_fault(reason)),
        None => Ok(splats),
    }
}

/// Coefficients above the base colour, per colour channel.
fn n_rest_per_channel(sh_degree: u8) -> usize {
    (usize::from(sh_degree) + 1).pow(2) - 1
}

fn property_names(sh_degree: u8) -> Vec<String> {
    let names = |names: &[&str]| {
        names
            .iter()
            .map(|name| (*name).to_owned())
            .collect::<Vec<_>>()
    };
    let mut all = names(&[
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2",
    ]);
    all.extend((0..3 * n_rest_per_channel(sh_degree)).map(|ix| format!("f_rest_{ix}")));
    all.extend(names(&[
        "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]));
    all
}

fn header(splats: &Splats) -> String {
    let mut text = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n",
        splats.len()
    );
    for name in property_names(splats.sh_degree) {
        text.push_str("property float ");
        text.push_str(&name);
        text.push('\n');
    }
    text.push_str("end_header\n");
    text
}

/// One vertex in the order of `property_names`.
fn fill_row(splats: &Splats, splat_ix: usize, row: &mut Vec<f32>) {
    let sh = &splats.sh[splat_ix * splats.sh_stride()..][..splats.sh_stride()];
    row.extend_from_slice(&splats.means[splat_ix]);
    // Normals mean nothing for splats, but readers of the first program's files expect the columns.
    row.extend_from_slice(&[0.0; 3]);
    row.extend_from_slice(&sh[..3]);
    // Here channel after channel, in memory coefficient after coefficient.
    for channel in 0..3 {
        row.extend(sh[3..].iter().skip(channel).step_by(3));
    }
    row.push(splats.opacity_logits[splat_ix]);
    row.extend_from_slice(&splats.log_scales[splat_ix]);
    row.extend_from_slice(&splats.quats[splat_ix]);
}

/// The vertex element of a header.
struct Table {
    n_vertices: usize,
    properties: Vec<String>,
}

/// Where in a row the numbers of a splat stand.
struct Columns {
    mean: [usize; 3],
    log_scale: [usize; 3],
    quat: [usize; 4],
    opacity_logit: usize,
    /// Coefficient after coefficient, r g b each.
    sh: Vec<usize>,
    sh_degree: u8,
}

impl Columns {
    fn find(properties: &[String]) -> Result<Self, String> {
        let column = |name: &str| {
            let found = properties.iter().position(|property| property == name);
            found.ok_or_else(|| format!("no property {name}"))
        };
        let n_rest = properties
            .iter()
            .filter(|name| name.starts_with("f_rest_"))
            .count();
        let sh_degree = (0..=MAX_SH_DEGREE)
            .find(|degree| 3 * n_rest_per_channel(*degree) == n_rest)
            .ok_or_else(|| format!("{n_rest} properties f_rest_*, expected 0, 9, 24 or 45"))?;
        let mut sh = vec![column("f_dc_0")?, column("f_dc_1")?, column("f_dc_2")?];
        let per_channel = n_rest_per_channel(sh_degree);
        for coefficient in 0..per_channel {
            for channel in 0..3 {
                sh.push(column(&format!(
                    "f_rest_{}",
                    channel * per_channel + coefficient
                ))?);
            }
        }
        Ok(Self {
            mean: [column("x")?, column("y")?, column("z")?],
            log_scale: [column("scale_0")?, column("scale_1")?, column("scale_2")?],
            quat: [
                column("rot_0")?,
                column("rot_1")?,
                column("rot_2")?,
                column("rot_3")?,
            ],
            opacity_logit: column("opacity")?,
            sh,
            sh_degree,
        })
    }
}

/// Lines up to `end_header`, and how many bytes they took.
fn read_header(file: &mut impl BufRead) -> io::Result<Result<(Vec<String>, u64), String>> {
    let mut limited = file.take(MAX_HEADER_BYTES);
    let mut lines = Vec::new();
    let mut n_bytes = 0;
    let mut line = Vec::new();
    loop {
        line.clear();
        n_bytes += limited.read_until(b'\n', &mut line)? as u64;
        if line.last() != Some(&b'\n') {
            return Ok(Err(format!(
                "no line end_header in the first {n_bytes} bytes"
            )));
        }
        // Comments may be in any encoding; what matters is plain ASCII.
        let text = String::from_utf8_lossy(&line).trim_end().to_owned();
        if lines.is_empty() && text != "ply" {
            return Ok(Err(format!(
                "it begins with {:?}, expected \"ply\"",
                text.chars().take(16).collect::<String>()
            )));
        }
        if text == "end_header" {
            return Ok(Ok((lines, n_bytes)));
        }
        lines.push(text);
    }
}

fn parse_header(lines: &[String]) -> Result<Table, String> {
    let mut table: Option<Table> = None;
    let mut format_is_known = false;
    for line in &lines[1..] {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["format", "binary_little_endian", "1.0"] => format_is_known = true,
            ["format", ..] => return Err(format!("{line:?}, expected binary_little_endian 1.0")),
            ["element", "vertex", count] if table.is_none() => {
                let n_vertices = count
                    .parse()
                    .map_err(|e| format!("{line:?} counts nothing: {e}"))?;
                table = Some(Table {
                    n_vertices,
                    properties: Vec::new(),
                });
            }
            // Whatever stands behind the vertices is no splat.
            ["element", ..] if table.is_some() => break,
            ["element", ..] => return Err(format!("{line:?} stands before the vertices")),
            ["property", "float" | "float32", name] => {
                let table = table
                    .as_mut()
                    .ok_or_else(|| format!("{line:?} belongs to no element"))?;
                if table.properties.len() == MAX_PROPERTIES {
                    return Err(format!("more than {MAX_PROPERTIES} properties"));
                }
                table.properties.push(name.to_owned());
            }
            ["property", ..] => return Err(format!("{line:?} is not of type float")),
            // Empty lines, comments and obj_info say nothing about splats.
            _ => {}
        }
    }
    if !format_is_known {
        return Err("no line format".to_owned());
    }
    table.ok_or_else(|| "no element vertex".to_owned())
}

fn read_rows(file: &mut impl Read, table: &Table, columns: &Columns) -> io::Result<Splats> {
    let n_columns = table.properties.len();
    let mut splats = Splats {
        sh_degree: columns.sh_degree,
        ..Splats::default()
    };
    let mut bytes = vec![0; 4 * n_columns * ROWS_AT_ONCE.min(table.n_vertices)];
    let mut numbers = vec![0.0; bytes.len() / 4];
    let mut n_left = table.n_vertices;
    while n_left > 0 {
        let n_numbers = n_columns * n_left.min(ROWS_AT_ONCE);
        file.read_exact(&mut bytes[..4 * n_numbers])?;
        LittleEndian::read_f32_into(&bytes[..4 * n_numbers], &mut numbers[..n_numbers]);
        for row in numbers[..n_numbers].chunks_exact(n_columns) {
            splats.means.push(columns.mean.map(|ix| row[ix]));
            splats.log_scales.push(columns.log_scale.map(|ix| row[ix]));
            splats.quats.push(columns.quat.map(|ix| row[ix]));
            splats.opacity_logits.push(row[columns.opacity_logit]);
            splats.sh.extend(columns.sh.iter().map(|ix| row[*ix]));
            splats.anchors.push(0);
        }
        n_left -= n_left.min(ROWS_AT_ONCE);
    }
    Ok(splats)
}
