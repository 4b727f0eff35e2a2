//! `points3D` of a COLMAP model, binary or text -> points in the frame of its poses.

use std::path::Path;

use glam::DVec3;

use crate::error::SourceError;
use crate::scene_formats::binary::Binary;
use crate::scene_formats::listed::{MAX_POINTS, check_count, check_position, excerpt, fault};
use crate::small_file::read_small;
use splat_types::sparse_point::SparsePoint;

/// Text models: larger ones are better kept as binary.
const MAX_TEXT_BYTES: u64 = 512 << 20;
/// An observation in points3D.bin: image, number of its 2D point.
const OBSERVATION_BYTES: u64 = 8;

/// Empty where the model has neither file.
pub(crate) fn read(model: &Path) -> Result<Vec<SparsePoint>, SourceError> {
    let file = |extension: &str| model.join("points3D").with_extension(extension);
    let (binary, text) = (file("bin"), file("txt"));
    let (path, points) = if binary.is_file() {
        let points = of_binary(&binary);
        (binary, points)
    } else if text.is_file() {
        let points = of_text(&text);
        (text, points)
    } else {
        return Ok(Vec::new());
    };
    points.map_err(|reason| {
        let way_out = "export the model again (colmap model_converter), or start from depth (train.start=depth)";
        fault("points of a COLMAP model", reason, way_out, &path)
    })
}

fn of_binary(path: &Path) -> Result<Vec<SparsePoint>, String> {
    let mut file = Binary::open(path)?;
    let n = file.u64("the number of points")?;
    check_count(usize::try_from(n).unwrap_or(usize::MAX))?;
    let mut points = Vec::new();
    for _ in 0..n {
        let id = file.u64("a point")?;
        let position = DVec3::from_array(file.f64s("a point")?);
        let rgb = file.u8s("a point")?;
        let [error] = file.f64s("a point")?;
        let n_images = file.u64("a point")?;
        file.skip(n_images, OBSERVATION_BYTES, "observations of a point")?;
        check_position(id, position)?;
        points.push(SparsePoint {
            position_in_gt: position,
            rgb,
            error_px: error as f32,
            n_images: u32::try_from(n_images).unwrap_or(u32::MAX),
        });
    }
    Ok(points)
}

/// Lines `POINT3D_ID X Y Z R G B ERROR`, then image and number of the 2D point of each observation.
fn of_text(path: &Path) -> Result<Vec<SparsePoint>, String> {
    let bytes = read_small(path, MAX_TEXT_BYTES)?;
    let mut points = Vec::new();
    for line in bytes.split(|byte| *byte == b'\n') {
        let line = String::from_utf8_lossy(line);
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if points.len() == MAX_POINTS {
            check_count(MAX_POINTS + 1)?;
        }
        let point = of_line(line)?;
        points.push(point.ok_or_else(|| format!("line {:?} is no point", excerpt(line)))?);
    }
    Ok(points)
}

/// `None`: it is no point.
fn of_line(line: &str) -> Result<Option<SparsePoint>, String> {
    let mut words = line.split_whitespace();
    let parsed = (|| {
        let id: u64 = words.next()?.parse().ok()?;
        let mut number = || words.next()?.parse::<f64>().ok();
        let position = DVec3::new(number()?, number()?, number()?);
        let mut channel = || words.next()?.parse::<u8>().ok();
        let rgb = [channel()?, channel()?, channel()?];
        let error: f64 = words.next()?.parse().ok()?;
        Some((id, position, rgb, error))
    })();
    let Some((id, position, rgb, error)) = parsed else {
        return Ok(None);
    };
    check_position(id, position)?;
    Ok(Some(SparsePoint {
        position_in_gt: position,
        rgb,
        error_px: error as f32,
        n_images: (words.count() / 2) as u32,
    }))
}
