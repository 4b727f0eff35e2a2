//! ONNX files from nothing: the few protobuf messages of which a graph is made, byte by byte.

use std::path::{Path, PathBuf};

use crate::scenes::ignored;

/// ONNX: numbers of the types of tensors and of attributes.
const FLOAT: u64 = 1;
const INT64: u64 = 7;
const INT: u64 = 2;
const INTS: u64 = 7;
/// Fields of a graph.
pub(crate) const INPUT: u64 = 11;
pub(crate) const OUTPUT: u64 = 12;

/// Protobuf: a number, and bytes, under a field.
pub(crate) fn number(field: u64, value: u64) -> Vec<u8> {
    [varint(field << 3), varint(value)].concat()
}

pub(crate) fn bytes(field: u64, content: &[u8]) -> Vec<u8> {
    [
        &varint(field << 3 | 2),
        &varint(content.len() as u64),
        content,
    ]
    .concat()
}

fn varint(mut value: u64) -> Vec<u8> {
    let mut out = Vec::new();
    while value >= 128 {
        out.push((value % 128) as u8 | 128);
        value /= 128;
    }
    out.push(value as u8);
    out
}

pub(crate) fn node(op: &str, inputs: &[&str], output: &str, attributes: &[u8]) -> Vec<u8> {
    let mut content: Vec<u8> = inputs.iter().flat_map(|i| bytes(1, i.as_bytes())).collect();
    content.extend(bytes(2, output.as_bytes()));
    content.extend(bytes(4, op.as_bytes()));
    content.extend(attributes);
    bytes(1, &content)
}

/// Attributes of a node.
pub(crate) fn int(name: &str, value: u64) -> Vec<u8> {
    let content = [bytes(1, name.as_bytes()), number(3, value), number(20, INT)];
    bytes(5, &content.concat())
}

pub(crate) fn ints(name: &str, values: &[u64]) -> Vec<u8> {
    let mut content = bytes(1, name.as_bytes());
    content.extend(values.iter().flat_map(|v| number(8, *v)));
    content.extend(number(20, INTS));
    bytes(5, &content)
}

/// A named f32 tensor; sides that are words are free.
pub(crate) fn tensor(field: u64, name: &str, sides: &[&str]) -> Vec<u8> {
    tensor_of(field, name, sides, FLOAT)
}

pub(crate) fn tensor_of(field: u64, name: &str, sides: &[&str], element: u64) -> Vec<u8> {
    let side = |side: &&str| match side.parse() {
        Ok(n) => bytes(1, &number(1, n)),
        Err(_) => bytes(1, &bytes(2, side.as_bytes())),
    };
    let shape: Vec<u8> = sides.iter().flat_map(side).collect();
    let of_type = bytes(1, &[number(1, element), bytes(2, &shape)].concat());
    bytes(
        field,
        &[bytes(1, name.as_bytes()), bytes(2, &of_type)].concat(),
    )
}

/// Weights. Numbers that are missing or too many are written as they are.
pub(crate) fn floats(name: &str, sides: &[u64], values: &[f32]) -> Vec<u8> {
    let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    initializer(name, sides, FLOAT, &raw)
}

pub(crate) fn whole_numbers(name: &str, values: &[i64]) -> Vec<u8> {
    let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    initializer(name, &[values.len() as u64], INT64, &raw)
}

fn initializer(name: &str, sides: &[u64], element: u64, raw: &[u8]) -> Vec<u8> {
    let mut content: Vec<u8> = sides.iter().flat_map(|side| number(1, *side)).collect();
    content.extend(number(2, element));
    content.extend(bytes(8, name.as_bytes()));
    content.extend(bytes(9, raw));
    bytes(5, &content)
}

/// The file of a graph of these parts.
pub(crate) fn model(parts: &[Vec<u8>]) -> Vec<u8> {
    let graph = [parts.concat(), bytes(2, b"made_by_a_test")].concat();
    let opset = [bytes(1, b""), number(2, 13)].concat();
    [number(1, 8), bytes(7, &graph), bytes(8, &opset)].concat()
}

/// The library that scripts/setup test put into target/onnxruntime, or the one that is named. Without it: fails under
/// CI=true, else says so, and the test returns.
pub(crate) fn library() -> Option<PathBuf> {
    let named = std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from);
    let folder = Path::new("target/onnxruntime/onnxruntime/capi");
    let is_library = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("libonnxruntime.so")
    };
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let installed = entries.map(|entry| entry.path()).find(is_library);
    let found = named
        .or(installed)
        .and_then(|path| path.canonicalize().ok());
    if found.is_none() {
        ignored("no ONNX Runtime in target/onnxruntime; run scripts/setup test");
    }
    found
}
