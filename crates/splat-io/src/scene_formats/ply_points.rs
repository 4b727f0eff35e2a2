//! A PLY point cloud, text or binary little endian -> points, as nerfstudio names one in `ply_file_path`.
//!
//! Only the vertices are read: x, y, z, and red, green, blue where they are; whatever else a vertex has is passed over.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use glam::DVec3;

use crate::scene_formats::listed::{check_count, check_position, excerpt};
use splat_types::sparse_point::SparsePoint;

/// Headers and lines of vertices are short; what is longer is no PLY.
const MAX_LINE_BYTES: u64 = 16 * 1024;
const MAX_HEADER_LINES: usize = 4096;
/// More than any program writes per vertex.
const MAX_PROPERTIES: usize = 256;
/// Of points without a colour.
const GREY: u8 = 128;

/// Names of the numbers that are read, in the order of [`Table::columns`].
const WANTED: [&str; 6] = ["x", "y", "z", "red", "green", "blue"];

/// How a number lies in a binary file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// What the header says of the vertices.
#[derive(Debug, Default)]
struct Table {
    is_text: bool,
    n_vertices: usize,
    properties: Vec<(String, Kind)>,
    /// Place of each of `WANTED` among the properties.
    columns: [Option<usize>; 6],
}

/// Errors are sentences without the path.
pub(crate) fn read(path: &Path) -> Result<Vec<SparsePoint>, String> {
    if !std::fs::metadata(path).is_ok_and(|m| m.is_file()) {
        return Err("not a regular file".to_owned());
    }
    let mut file = BufReader::new(File::open(path).map_err(|e| e.to_string())?);
    let table = header(&mut file)?;
    let mut points = Vec::new();
    for ix in 0..table.n_vertices {
        let row = if table.is_text {
            text_row(&mut file, &table)?
        } else {
            binary_row(&mut file, &table)?
        };
        points.push(point(ix as u64, &row, &table)?);
    }
    Ok(points)
}

fn header(file: &mut impl BufRead) -> Result<Table, String> {
    let mut table = Table::default();
    let mut is_vertex = false;
    for number in 0..MAX_HEADER_LINES {
        let text = line(file)?;
        let words: Vec<&str> = text.split_whitespace().take(8).collect();
        match words.as_slice() {
            ["ply"] if number == 0 => {}
            _ if number == 0 => return Err("it does not begin with \"ply\"".to_owned()),
            ["format", "ascii", _] => table.is_text = true,
            ["format", "binary_little_endian", _] => table.is_text = false,
            ["format", other, ..] => {
                return Err(format!(
                    "format {:?}, expected ascii or binary_little_endian",
                    excerpt(other)
                ));
            }
            ["element", "vertex", n] if table.properties.is_empty() => {
                let bad = || format!("{:?} vertices", excerpt(n));
                table.n_vertices = n.parse().ok().ok_or_else(bad)?;
                check_count(table.n_vertices)?;
                is_vertex = true;
            }
            ["element", ..] if !is_vertex && table.properties.is_empty() => {
                return Err("its first element is no vertex".to_owned());
            }
            ["element", ..] => is_vertex = false,
            ["property", kind, name] if is_vertex => {
                let bad = || format!("property {:?} of a vertex", excerpt(&text));
                let kind = Kind::of_name(kind).ok_or_else(bad)?;
                table.properties.push(((*name).to_owned(), kind));
                if table.properties.len() > MAX_PROPERTIES {
                    return Err(format!("more than {MAX_PROPERTIES} properties of a vertex"));
                }
            }
            ["property", ..] if is_vertex => {
                return Err(format!("property {:?} of a vertex", excerpt(&text)));
            }
            ["end_header"] => return table.with_columns(),
            _ => {}
        }
    }
    Err("a header without end".to_owned())
}

impl Table {
    fn with_columns(mut self) -> Result<Self, String> {
        for (column, wanted) in self.columns.iter_mut().zip(WANTED) {
            *column = self.properties.iter().position(|(name, _)| name == wanted);
        }
        if self.columns[..3].contains(&None) {
            return Err("its vertices have no x, y and z".to_owned());
        }
        Ok(self)
    }
}

impl Kind {
    fn of_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }

    fn read(self, file: &mut impl Read) -> Result<f64, String> {
        Ok(match self {
            Self::I8 => f64::from(i8::from_le_bytes(bytes(file)?)),
            Self::U8 => f64::from(u8::from_le_bytes(bytes(file)?)),
            Self::I16 => f64::from(i16::from_le_bytes(bytes(file)?)),
            Self::U16 => f64::from(u16::from_le_bytes(bytes(file)?)),
            Self::I32 => f64::from(i32::from_le_bytes(bytes(file)?)),
            Self::U32 => f64::from(u32::from_le_bytes(bytes(file)?)),
            Self::F32 => f64::from(f32::from_le_bytes(bytes(file)?)),
            Self::F64 => f64::from_le_bytes(bytes(file)?),
        })
    }
}

fn text_row(file: &mut impl BufRead, table: &Table) -> Result<Vec<f64>, String> {
    let text = line(file)?;
    let row: Vec<f64> = text
        .split_whitespace()
        .map_while(|word| word.parse().ok())
        .take(table.properties.len())
        .collect();
    if row.len() < table.properties.len() {
        return Err(format!("line {:?} is no vertex", excerpt(&text)));
    }
    Ok(row)
}

fn binary_row(file: &mut impl Read, table: &Table) -> Result<Vec<f64>, String> {
    let kinds = table.properties.iter().map(|(_, kind)| *kind);
    kinds.map(|kind| kind.read(file)).collect()
}

fn point(id: u64, row: &[f64], table: &Table) -> Result<SparsePoint, String> {
    let number = |column: usize| Some(row[table.columns[column]?]);
    let [x, y, z] = [0, 1, 2].map(|column| number(column).unwrap_or(f64::NAN));
    let position = DVec3::new(x, y, z);
    check_position(id, position)?;
    let channel = |column: usize| {
        let (value, at) = (number(column)?, table.columns[column]?);
        // As a fraction it is a share of white.
        let is_share = table.properties[at].1.is_float();
        Some(if is_share { 255.0 * value } else { value }.round() as u8)
    };
    Ok(SparsePoint {
        position_in_gt: position,
        rgb: [3, 4, 5].map(|column| channel(column).unwrap_or(GREY)),
        error_px: -1.0,
        n_images: 0,
    })
}

fn line(file: &mut impl BufRead) -> Result<String, String> {
    let mut bytes = Vec::new();
    let mut limited = file.by_ref().take(MAX_LINE_BYTES);
    limited
        .read_until(b'\n', &mut bytes)
        .map_err(|e| e.to_string())?;
    match bytes.last() {
        None => Err("it ends before its last vertex".to_owned()),
        Some(b'\n') => Ok(String::from_utf8_lossy(&bytes).into_owned()),
        Some(_) if bytes.len() as u64 == MAX_LINE_BYTES => Err("a line without end".to_owned()),
        Some(_) => Ok(String::from_utf8_lossy(&bytes).into_owned()),
    }
}

fn bytes<const N: usize>(file: &mut impl Read) -> Result<[u8; N], String> {
    let mut bytes = [0; N];
    file.read_exact(&mut bytes).map_err(|e| match e.kind() {
        std::io::ErrorKind::UnexpectedEof => "it ends before its last vertex".to_owned(),
        _ => e.to_string(),
    })?;
    Ok(bytes)
}
