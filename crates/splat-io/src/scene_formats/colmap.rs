//! A COLMAP model (`cameras` and `images`, binary or text) -> views.
//!
//! COLMAP's pixel centres lie at +0.5, as here; its poses are `cam_from_world`.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DQuat, DVec3};

use crate::error::SourceError;
use crate::scene_formats::binary::Binary;
use crate::scene_formats::listed::{Listed, MAX_VIEWS, excerpt, fault};
use crate::small_file::read_small;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};
use splat_types::transform::Rigid;

/// Text models: larger ones are better kept as binary.
const MAX_TEXT_BYTES: u64 = 512 << 20;
/// Cameras of one model.
const MAX_CAMERAS: u64 = 1_000_000;
/// Most parameters of any camera model (FULL_OPENCV).
const MAX_PARAMS: usize = 12;
/// Longest side of an image, as the decoder has it.
const MAX_SIDE_PX: u64 = 16384;
/// A 2D point in images.bin: x, y, id of its 3D point.
const POINT_BYTES: u64 = 24;

/// COLMAP's numbers, names and counts of parameters (colmap/sensor/models.h).
const MODELS: [(i32, &str, usize); 11] = [
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (7, "FOV", 5),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
    (10, "THIN_PRISM_FISHEYE", 12),
];

/// Cameras by id.
type Cameras = BTreeMap<i32, CameraModel>;

pub(crate) fn read(model: &Path) -> Result<Vec<Listed>, SourceError> {
    let is_binary = |name: &str| model.join(name).with_extension("bin").is_file();
    let file = |name: &str| {
        let extension = if is_binary(name) { "bin" } else { "txt" };
        model.join(name).with_extension(extension)
    };
    let (cameras_file, images_file) = (file("cameras"), file("images"));
    let cameras = if is_binary("cameras") {
        cameras_of_binary(&cameras_file)
    } else {
        text_of(&cameras_file).and_then(|text| cameras_of_text(&text))
    };
    let cameras = cameras.map_err(|reason| {
        let way_out = "export the model again, undistorted (colmap image_undistorter) if need be";
        fault("cameras of a COLMAP model", reason, way_out, &cameras_file)
    })?;
    let images = if is_binary("images") {
        images_of_binary(&images_file, &cameras)
    } else {
        text_of(&images_file).and_then(|text| images_of_text(&text, &cameras))
    };
    images.map_err(|reason| {
        let way_out = "export the model again (colmap model_converter)";
        fault("images of a COLMAP model", reason, way_out, &images_file)
    })
}

fn text_of(path: &Path) -> Result<String, String> {
    read_small(path, MAX_TEXT_BYTES).map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
}

fn cameras_of_binary(path: &Path) -> Result<Cameras, String> {
    let mut file = Binary::open(path)?;
    let n = file.u64("the number of cameras")?;
    if n > MAX_CAMERAS {
        return Err(format!("{n} cameras, at most {MAX_CAMERAS} are read"));
    }
    let mut cameras = Cameras::new();
    for _ in 0..n {
        let (id, model) = (file.i32("a camera")?, file.i32("a camera")?);
        let size = (file.u64("a camera")?, file.u64("a camera")?);
        let known = MODELS.iter().find(|m| m.0 == model);
        let &(_, name, n_params) =
            known.ok_or_else(|| format!("camera {id} has the unknown model {model}"))?;
        let mut params = [0.0; MAX_PARAMS];
        for param in &mut params[..n_params] {
            [*param] = file.f64s("a camera")?;
        }
        cameras.insert(id, lens(id, name, size, &params[..n_params])?);
    }
    Ok(cameras)
}

/// Lines `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`.
fn cameras_of_text(text: &str) -> Result<Cameras, String> {
    let mut cameras = Cameras::new();
    for line in text.lines().map(str::trim).filter(|l| is_content(l)) {
        let bad = || format!("line {:?} is no camera", excerpt(line));
        let words: Vec<&str> = line.split_whitespace().take(5 + MAX_PARAMS).collect();
        let [id, name, width, height, params @ ..] = &words[..] else {
            return Err(bad());
        };
        let id = id.parse().ok().ok_or_else(bad)?;
        let size = (
            width.parse().ok().ok_or_else(bad)?,
            height.parse().ok().ok_or_else(bad)?,
        );
        let known = MODELS.iter().find(|m| m.1 == *name);
        let &(_, name, n_params) = known
            .ok_or_else(|| format!("camera {id} has the unknown model {:?}", excerpt(name)))?;
        let params: Option<Vec<f64>> = params.iter().map(|p| p.parse().ok()).collect();
        let params = params.filter(|p| p.len() == n_params).ok_or_else(bad)?;
        cameras.insert(id, lens(id, name, size, &params)?);
    }
    Ok(cameras)
}

/// `params` has as many numbers as the model.
fn lens(id: i32, model: &str, size: (u64, u64), params: &[f64]) -> Result<CameraModel, String> {
    let (fx, fy, cx, cy, k) = match (model, params) {
        (
            "PINHOLE" | "OPENCV" | "OPENCV_FISHEYE" | "FULL_OPENCV",
            &[fx, fy, cx, cy, ref k @ ..],
        ) => (fx, fy, cx, cy, k),
        (
            "SIMPLE_PINHOLE"
            | "SIMPLE_RADIAL"
            | "RADIAL"
            | "SIMPLE_RADIAL_FISHEYE"
            | "RADIAL_FISHEYE",
            &[f, cx, cy, ref k @ ..],
        ) => (f, f, cx, cy, k),
        _ => {
            return Err(format!(
                "camera {id} has the model {model}, expected SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or a FISHEYE of these"
            ));
        }
    };
    let at = |ix: usize| k.get(ix).copied().unwrap_or(0.0);
    let distortion = match model {
        "OPENCV_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE" => {
            Distortion::Equidistant([at(0), at(1), at(2), at(3)])
        }
        "FULL_OPENCV" => Distortion::Rational(std::array::from_fn(at)),
        "OPENCV" => Distortion::PlumbBob([at(0), at(1), at(2), at(3), 0.0]),
        _ => Distortion::PlumbBob([at(0), at(1), 0.0, 0.0, 0.0]),
    };
    let side = |px: u64| u32::try_from(px.min(MAX_SIDE_PX + 1)).unwrap_or(u32::MAX);
    let intrinsics = Intrinsics {
        width_px: side(size.0),
        height_px: side(size.1),
        fx,
        fy,
        cx,
        cy,
    };
    let fits = size.0 <= MAX_SIDE_PX && size.1 <= MAX_SIDE_PX;
    if !fits || !intrinsics.is_plausible() || !distortion.is_finite() {
        return Err(format!(
            "camera {id} of {}x{} px has the parameters {params:?}",
            size.0, size.1
        ));
    }
    Ok(CameraModel {
        intrinsics,
        distortion: if distortion.is_none() {
            Distortion::None
        } else {
            distortion
        },
    })
}

fn images_of_binary(path: &Path, cameras: &Cameras) -> Result<Vec<Listed>, String> {
    let mut file = Binary::open(path)?;
    let n = file.u64("the number of images")?;
    if n > MAX_VIEWS as u64 {
        return Err(format!("{n} images, at most {MAX_VIEWS} are read"));
    }
    let mut views = Vec::new();
    for _ in 0..n {
        let id = file.i32("an image")?;
        let pose: [f64; 7] = file.f64s("an image")?;
        let camera = file.i32("an image")?;
        let name = file.name()?;
        let n_points = file.u64("an image")?;
        file.skip(n_points, POINT_BYTES, "points of an image")?;
        views.push(listed(id, pose, camera, name, cameras)?);
    }
    Ok(views)
}

/// Two lines per image: `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, then its points, which may be none.
fn images_of_text(text: &str, cameras: &Cameras) -> Result<Vec<Listed>, String> {
    let mut views = Vec::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let line = line.trim();
        if !is_content(line) {
            continue;
        }
        let bad = || format!("line {:?} is no image", excerpt(line));
        let mut words = line.split_whitespace();
        let mut word = || words.next().ok_or_else(bad);
        let id = word()?.parse().ok().ok_or_else(bad)?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = word()?.parse().ok().ok_or_else(bad)?;
        }
        let camera = word()?.parse().ok().ok_or_else(bad)?;
        // Names may hold spaces.
        let name = words.collect::<Vec<_>>().join(" ");
        views.push(listed(id, pose, camera, name, cameras)?);
        if views.len() > MAX_VIEWS {
            return Err(format!("more than {MAX_VIEWS} images"));
        }
        lines.next();
    }
    Ok(views)
}

fn listed(
    id: i32,
    [qw, qx, qy, qz, tx, ty, tz]: [f64; 7],
    camera: i32,
    name: String,
    cameras: &Cameras,
) -> Result<Listed, String> {
    let lens = cameras
        .get(&camera)
        .ok_or_else(|| format!("image {id} has camera {camera}, which is not in the model"))?;
    let rotation = DQuat::from_xyzw(qx, qy, qz, qw).normalize();
    let cam_from_gt = Rigid::new(rotation, DVec3::new(tx, ty, tz));
    if !cam_from_gt.is_finite() {
        return Err(format!(
            "image {id} has the pose {qw} {qx} {qy} {qz} {tx} {ty} {tz}"
        ));
    }
    Ok(Listed {
        name,
        gt_from_cam: cam_from_gt.inverse(),
        lens: Some(*lens),
        depth: None,
        is_held_out: false,
    })
}

fn is_content(line: &str) -> bool {
    !line.is_empty() && !line.starts_with('#')
}
