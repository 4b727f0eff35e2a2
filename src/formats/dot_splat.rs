//! `.splat`, the format of the first web viewers: 32 bytes a splat, no view-dependent colour.
//!
//! mean 3 x f32, standard deviations 3 x f32, r g b opacity as bytes, then the quaternion w x y z as `128 q + 128`. Axes are the map's. Viewers draw
//! while they load, so that what fills most of an image comes first.

use std::io::{self, Write};

use crate::formats::axes;
use splat_types::splats::splats::Splats;

/// Writes the whole file to `out`; splats that are not finite are left out.
pub fn write(splats: &Splats, out: &mut dyn Write) -> io::Result<()> {
    let size = |ix: usize| {
        let log_volume: f32 = splats.log_scales[ix].iter().sum();
        log_volume.exp() * axes::opacity(splats.opacity_logits[ix])
    };
    let mut order = axes::finite(splats);
    order.sort_by(|a, b| size(*b).total_cmp(&size(*a)));
    for ix in order {
        out.write_all(&record(splats, ix))?;
    }
    Ok(())
}

fn record(splats: &Splats, ix: usize) -> [u8; 32] {
    let mut bytes = [0; 32];
    let scales = splats.log_scales[ix].map(f32::exp);
    let numbers = splats.means[ix].into_iter().chain(scales);
    for (place, number) in bytes.chunks_exact_mut(4).zip(numbers) {
        place.copy_from_slice(&number.to_le_bytes());
    }
    let byte = |share: f32| (255.0 * share).round().clamp(0.0, 255.0) as u8;
    let [r, g, b] = axes::base_colour(splats, ix).map(byte);
    let opacity = byte(axes::opacity(splats.opacity_logits[ix]));
    bytes[24..28].copy_from_slice(&[r, g, b, opacity]);
    let quat = axes::unit_quat(splats.quats[ix]);
    bytes[28..].copy_from_slice(&quat.map(|v| (128.0 * v + 128.0).round().clamp(0.0, 255.0) as u8));
    bytes
}
