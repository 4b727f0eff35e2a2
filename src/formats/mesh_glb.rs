//! A coloured mesh -> glTF 2.0 in one binary file, drawn with its own colours and without light (KHR_materials_unlit), from both sides.
//!
//! The level frame has x ahead, y left, z up; glTF has x left, y up, z ahead.

use std::io::{self, Write};

use serde_json::json;

use crate::formats::glb::{Arrays, UNSIGNED_BYTE, container, linear_byte};
use splat_volume::mesh::Mesh;

const UNSIGNED_INT: u32 = 5125;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const TRIANGLES: u32 = 4;
const UNLIT: &str = "KHR_materials_unlit";

/// Writes the whole file to `out`; `colours` per vertex, sRGB.
pub fn write(mesh: &Mesh, colours: &[[u8; 3]], name: &str, out: &mut dyn Write) -> io::Result<()> {
    if mesh.triangles.is_empty() {
        // A primitive without vertices is no valid glTF.
        return Err(io::Error::other("the mesh has no triangles"));
    }
    let mut arrays = Arrays::default();
    let places = mesh.vertices.iter();
    let places: Vec<f32> = places.flat_map(|[x, y, z]| [*y, *z, *x]).collect();
    arrays.add_places(&places);
    let colours: Vec<u8> = colours
        .iter()
        .flat_map(|rgb| {
            let [r, g, b] = rgb.map(|v| linear_byte(f32::from(v) / 255.0));
            [r, g, b, 255]
        })
        .collect();
    let accessor = json!({ "componentType": UNSIGNED_BYTE, "type": "VEC4", "normalized": true });
    arrays.add("COLOR_0", mesh.vertices.len(), &colours, accessor);
    // The axes change places in a circle, so the sense of the triangles stays.
    let indices: Vec<u8> = mesh
        .triangles
        .iter()
        .flatten()
        .flat_map(|ix| ix.to_le_bytes())
        .collect();
    let accessor = json!({ "componentType": UNSIGNED_INT, "type": "SCALAR" });
    let of_indices = arrays.add_array(3 * mesh.triangles.len(), &indices, accessor);
    let view = arrays.accessors[of_indices]["bufferView"].as_u64();
    arrays.views[view.unwrap_or(0) as usize]["target"] = json!(ELEMENT_ARRAY_BUFFER);
    let material = json!({
        "name": "surface", "doubleSided": true, "extensions": { UNLIT: {} },
        "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 1.0 },
    });
    let primitive = json!({
        "mode": TRIANGLES, "attributes": arrays.attributes, "indices": of_indices, "material": 0,
    });
    let described = arrays.document(name, UNLIT, &primitive, Some(&material));
    container(&described, &arrays.bytes, out)
}
