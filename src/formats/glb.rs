//! glTF 2.0 in one binary file, with the extension KHR_gaussian_splatting (a release candidate in November 2026).
//!
//! One mesh of points; each attribute is an array of f32 of its own. Programs that do not know the extension draw coloured points. Axes: x left,
//! y up, z forward.

use std::io::{self, Write};

use serde_json::{Value, json};

use crate::formats::axes::{self, Axes};
use splat_types::splats::splats::Splats;

const AXES: Axes = Axes::LeftUpForward;
const EXTENSION: &str = "KHR_gaussian_splatting";
const MAGIC: u32 = 0x4654_6c67;
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BINARY_CHUNK: u32 = 0x004e_4942;
const FLOAT: u32 = 5126;
pub(crate) const UNSIGNED_BYTE: u32 = 5121;
const ARRAY_BUFFER: u32 = 34962;
const POINTS: u32 = 0;

/// The binary chunk, and what the JSON says of it.
#[derive(Default)]
pub(crate) struct Arrays {
    pub(crate) bytes: Vec<u8>,
    pub(crate) views: Vec<Value>,
    pub(crate) accessors: Vec<Value>,
    pub(crate) attributes: serde_json::Map<String, Value>,
}

impl Arrays {
    /// An attribute of the vertices.
    pub(crate) fn add(&mut self, name: &str, n: usize, bytes: &[u8], accessor: Value) {
        let at = self.add_array(n, bytes, accessor);
        self.attributes.insert(name.to_owned(), json!(at));
    }

    /// -> the index of its accessor.
    pub(crate) fn add_array(&mut self, n: usize, bytes: &[u8], mut accessor: Value) -> usize {
        let view = json!({
            "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len(), "target": ARRAY_BUFFER,
        });
        accessor["bufferView"] = json!(self.views.len());
        accessor["count"] = json!(n);
        self.views.push(view);
        self.accessors.push(accessor);
        self.bytes.extend(bytes);
        self.accessors.len() - 1
    }

    /// Of the vertices, with the bounds that the format asks for; before all other arrays.
    pub(crate) fn add_places(&mut self, places: &[f32]) {
        self.add_floats("POSITION", 3, places);
        let ends = |pick: fn(f32, f32) -> f32| -> Vec<f32> {
            let of_axis = |k: usize| places.iter().skip(k).step_by(3).copied().reduce(pick);
            (0..3).filter_map(of_axis).collect()
        };
        self.accessors[0]["min"] = json!(ends(f32::min));
        self.accessors[0]["max"] = json!(ends(f32::max));
    }

    /// One mesh of one primitive, in a scene of its own.
    pub(crate) fn document(
        &self,
        name: &str,
        extension: &str,
        primitive: &Value,
        material: Option<&Value>,
    ) -> Value {
        let generator = concat!("splat-mapper ", env!("CARGO_PKG_VERSION"));
        let mut document = json!({
            "asset": { "version": "2.0", "generator": generator },
            "extensionsUsed": [extension],
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
            "nodes": [{ "mesh": 0, "name": name }],
            "meshes": [{ "primitives": [primitive] }],
            "buffers": [{ "byteLength": self.bytes.len() }],
            "bufferViews": self.views,
            "accessors": self.accessors,
        });
        if let Some(material) = material {
            document["materials"] = json!([material]);
        }
        document
    }

    fn add_floats(&mut self, name: &str, width: usize, values: &[f32]) {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        let accessor = json!({ "componentType": FLOAT, "type": kind });
        self.add(name, values.len() / width, &bytes, accessor);
    }
}

/// Writes the whole file to `out`; splats that are not finite are left out. `name`: of the node, what a scene graph shows.
pub fn write(splats: &Splats, name: &str, out: &mut dyn Write) -> io::Result<()> {
    let order = axes::finite(splats);
    if order.is_empty() {
        // A mesh without vertices is no valid glTF.
        return Err(io::Error::other("there are no splats to write"));
    }
    let arrays = arrays_of(splats, &order);
    container(&described(&arrays, name), &arrays.bytes, out)
}

/// Both chunks; `bytes` are a multiple of four.
pub(crate) fn container(document: &Value, bytes: &[u8], out: &mut dyn Write) -> io::Result<()> {
    let mut json = serde_json::to_vec(document).map_err(io::Error::other)?;
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + json.len() + 8 + bytes.len();
    let total = u32::try_from(total)
        .map_err(|_too_long| io::Error::other("more than 4 GiB: glTF cannot hold it"))?;
    let word = |value: u32| value.to_le_bytes();
    out.write_all(&[word(MAGIC), word(2), word(total)].concat())?;
    out.write_all(&[word(json.len() as u32), word(JSON_CHUNK)].concat())?;
    out.write_all(&json)?;
    out.write_all(&[word(bytes.len() as u32), word(BINARY_CHUNK)].concat())?;
    out.write_all(bytes)
}

fn described(arrays: &Arrays, name: &str) -> Value {
    let of_splats = json!({
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective", "sortingMethod": "cameraDistance",
    });
    let primitive = json!({
        "mode": POINTS, "attributes": arrays.attributes, "extensions": { EXTENSION: of_splats },
    });
    arrays.document(name, EXTENSION, &primitive, None)
}

fn arrays_of(splats: &Splats, order: &[usize]) -> Arrays {
    let mut arrays = Arrays::default();
    let all = || order.iter().copied();
    let means: Vec<f32> = all().flat_map(|ix| AXES.mean(splats.means[ix])).collect();
    arrays.add_places(&means);
    let colours: Vec<u8> = all().flat_map(|ix| point_colour(splats, ix)).collect();
    let accessor = json!({ "componentType": UNSIGNED_BYTE, "type": "VEC4", "normalized": true });
    arrays.add("COLOR_0", order.len(), &colours, accessor);
    let named = |name: &str| format!("{EXTENSION}:{name}");
    let quats: Vec<f32> = all()
        .flat_map(|ix| {
            let [w, x, y, z] = AXES.quat(axes::unit_quat(splats.quats[ix]));
            [x, y, z, w]
        })
        .collect();
    arrays.add_floats(&named("ROTATION"), 4, &quats);
    let scales: Vec<f32> = all()
        .flat_map(|ix| splats.log_scales[ix].map(f32::exp))
        .collect();
    arrays.add_floats(&named("SCALE"), 3, &scales);
    let opacities: Vec<f32> = all()
        .map(|ix| axes::opacity(splats.opacity_logits[ix]))
        .collect();
    arrays.add_floats(&named("OPACITY"), 1, &opacities);
    let mut k = 0;
    for degree in 0..=usize::from(splats.sh_degree) {
        for coefficient in 0..2 * degree + 1 {
            let values: Vec<f32> = all()
                .flat_map(|ix| {
                    let at = ix * splats.sh_stride() + 3 * k;
                    [0, 1, 2].map(|c| AXES.sh_sign(k) * splats.sh[at + c])
                })
                .collect();
            arrays.add_floats(
                &named(&format!("SH_DEGREE_{degree}_COEF_{coefficient}")),
                3,
                &values,
            );
            k += 1;
        }
    }
    arrays
}

/// For programs that draw points: linear light, as glTF has vertex colours, and opacity.
fn point_colour(splats: &Splats, ix: usize) -> [u8; 4] {
    let [r, g, b] = axes::base_colour(splats, ix).map(linear_byte);
    [r, g, b, byte(axes::opacity(splats.opacity_logits[ix]))]
}

fn byte(share: f32) -> u8 {
    (255.0 * share).round().clamp(0.0, 255.0) as u8
}

/// sRGB, 0 to 1 -> linear light.
pub(crate) fn linear_byte(shown: f32) -> u8 {
    let shown = shown.clamp(0.0, 1.0);
    byte(if shown <= 0.040_45 {
        shown / 12.92
    } else {
        ((shown + 0.055) / 1.055).powf(2.4)
    })
}
