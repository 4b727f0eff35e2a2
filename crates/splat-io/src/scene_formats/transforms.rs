//! transforms.json of nerfstudio, instant-ngp and Blender scenes -> views.
//!
//! Poses there are camera to world with OpenGL axes (x right, y up, z backward); pixel centres lie at +0.5. Where the
//! writer turned the world (`applied_transform`), the turn is undone: poses are again those of its COLMAP model.

use std::path::Path;

use glam::{DMat3, DQuat, DVec3};
use serde::Deserialize;

use crate::error::SourceError;
use crate::scene_formats::image_files::{Images, inside};
use crate::scene_formats::listed::{Listed, MAX_VIEWS, excerpt, fault};
use crate::scene_formats::ply_points;
use crate::small_file::read_small;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};
use splat_types::sparse_point::SparsePoint;
use splat_types::transform::Rigid;

/// A thousand bytes a frame, and thirty thousand frames.
const MAX_FILE_BYTES: u64 = 32 << 20;
/// Longest side of an image, as the decoder has it.
const MAX_SIDE_PX: f64 = 16384.0;
/// How far the axes of a pose may be from unit length, relative to each other, and from a right angle (cosine).
const AXES_SLACK: f64 = 0.02;

/// A camera's keys stand at the top or in a frame, which goes before.
#[derive(Debug, Clone, Default, Deserialize)]
struct CameraKeys {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct File {
    #[serde(flatten)]
    camera: CameraKeys,
    applied_transform: Option<Vec<Vec<f64>>>,
    /// Of a point cloud in the frame of the poses as they stand here.
    ply_file_path: Option<String>,
    frames: Vec<FrameKeys>,
    test_filenames: Option<Vec<String>>,
}

#[derive(Debug, Deserialize)]
struct FrameKeys {
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
    depth_file_path: Option<String>,
    #[serde(flatten)]
    camera: CameraKeys,
}

pub(crate) fn read(
    path: &Path,
    root: &Path,
    is_held_out: bool,
) -> Result<Vec<Listed>, SourceError> {
    let fail = |reason: String| malformed(path, reason);
    let file = parse(path)?;
    if file.frames.len() > MAX_VIEWS {
        return Err(fail(format!("{} frames", file.frames.len())));
    }
    let undo = file.undo().map_err(fail)?;
    let names: Vec<&str> = file.frames.iter().map(|f| f.file_path.as_str()).collect();
    let is_sized = |camera: &CameraKeys| camera.w.is_some() && camera.h.is_some();
    let all_sized = is_sized(&file.camera) || file.frames.iter().all(|f| is_sized(&f.camera));
    let size = if all_sized {
        None
    } else {
        Images::first_size(root, &names)
    };
    let tests = file.test_filenames.unwrap_or_default();
    let mut views = Vec::with_capacity(file.frames.len());
    for frame in file.frames {
        let at_frame = |reason: String| fail(format!("frame {:?}: {reason}", frame.file_path));
        let pose = rigid_of(&frame.transform_matrix)
            .ok_or_else(|| at_frame("transform_matrix is no turn and shift".to_owned()))?;
        let camera = frame.camera.over(&file.camera);
        let lens = camera.lens(size).map_err(at_frame)?;
        views.push(Listed {
            gt_from_cam: undo * opencv_from_opengl(pose),
            lens,
            is_held_out: is_held_out || tests.contains(&frame.file_path),
            depth: frame.depth_file_path,
            name: frame.file_path,
        });
    }
    Ok(views)
}

/// Points of the PLY that the file names; empty where it names none.
pub(crate) fn points(path: &Path, root: &Path) -> Result<Vec<SparsePoint>, SourceError> {
    let file = parse(path)?;
    let undo = file.undo().map_err(|reason| malformed(path, reason))?;
    let Some(name) = &file.ply_file_path else {
        return Ok(Vec::new());
    };
    let Some(cloud) = inside(root, name) else {
        let reason = format!("ply_file_path {:?} leads out of its folder", excerpt(name));
        return Err(malformed(path, reason));
    };
    let mut points = ply_points::read(&cloud).map_err(|reason| {
        let way_out = "write it again, or start from depth (train.start=depth)";
        fault("points of a transforms.json", reason, way_out, &cloud)
    })?;
    for point in &mut points {
        point.position_in_gt = undo.transform_point(point.position_in_gt);
    }
    Ok(points)
}

fn parse(path: &Path) -> Result<File, SourceError> {
    let fail = |reason: String| malformed(path, reason);
    let bytes = read_small(path, MAX_FILE_BYTES).map_err(fail)?;
    serde_json::from_slice(&bytes).map_err(|e| fail(e.to_string()))
}

fn malformed(path: &Path, reason: String) -> SourceError {
    let way_out = "expected frames with file_path and a 4x4 transform_matrix";
    fault("transforms.json", reason, way_out, path)
}

impl File {
    /// From the frame of the file to that of its COLMAP model.
    fn undo(&self) -> Result<Rigid, String> {
        match &self.applied_transform {
            Some(rows) => rigid_of(rows)
                .map(|applied| applied.inverse())
                .ok_or_else(|| "applied_transform is no turn and shift".to_owned()),
            None => Ok(Rigid::IDENTITY),
        }
    }
}

impl CameraKeys {
    /// Its own keys, and those of `other` where it has none.
    fn over(&self, other: &Self) -> Self {
        let text = |own: &Option<String>, theirs: &Option<String>| own.clone().or(theirs.clone());
        Self {
            camera_model: text(&self.camera_model, &other.camera_model),
            is_fisheye: self.is_fisheye.or(other.is_fisheye),
            fl_x: self.fl_x.or(other.fl_x),
            fl_y: self.fl_y.or(other.fl_y),
            cx: self.cx.or(other.cx),
            cy: self.cy.or(other.cy),
            w: self.w.or(other.w),
            h: self.h.or(other.h),
            camera_angle_x: self.camera_angle_x.or(other.camera_angle_x),
            camera_angle_y: self.camera_angle_y.or(other.camera_angle_y),
            k1: self.k1.or(other.k1),
            k2: self.k2.or(other.k2),
            k3: self.k3.or(other.k3),
            k4: self.k4.or(other.k4),
            p1: self.p1.or(other.p1),
            p2: self.p2.or(other.p2),
        }
    }

    /// `size`: of the images, where the file does not say. `None`: no focal length, or no size.
    fn lens(&self, size: Option<(u32, u32)>) -> Result<Option<CameraModel>, String> {
        let given = self.w.zip(self.h);
        let measured = size.map(|(w, h)| (f64::from(w), f64::from(h)));
        let Some((w, h)) = given.or(measured) else {
            return Ok(None);
        };
        let of_angle = |angle: Option<f64>, side: f64| angle.map(|a| 0.5 * side / (0.5 * a).tan());
        let fx = self.fl_x.or(of_angle(self.camera_angle_x, w));
        let fy = self.fl_y.or(of_angle(self.camera_angle_y, h));
        // One angle or focal length serves both ways: pixels are square.
        let Some((fx, fy)) = fx.or(fy).zip(fy.or(fx)) else {
            return Ok(None);
        };
        let is_side = |px: f64| (1.0..=MAX_SIDE_PX).contains(&px);
        if !is_side(w) || !is_side(h) {
            return Err(format!("images of {w}x{h} px"));
        }
        let intrinsics = Intrinsics {
            width_px: w as u32,
            height_px: h as u32,
            fx,
            fy,
            cx: self.cx.unwrap_or(0.5 * w),
            cy: self.cy.unwrap_or(0.5 * h),
        };
        if !intrinsics.is_plausible() {
            let (cx, cy) = (intrinsics.cx, intrinsics.cy);
            return Err(format!(
                "fl_x {fx} fl_y {fy} cx {cx} cy {cy} for {w}x{h} px"
            ));
        }
        let distortion = self.distortion()?;
        Ok(Some(CameraModel {
            intrinsics,
            distortion,
        }))
    }

    fn distortion(&self) -> Result<Distortion, String> {
        let [k1, k2, k3, k4, p1, p2] = [self.k1, self.k2, self.k3, self.k4, self.p1, self.p2]
            .map(|value| value.unwrap_or(0.0));
        let model = self.camera_model.as_deref().unwrap_or_default();
        let is_fisheye = self.is_fisheye.unwrap_or(false) || model.ends_with("FISHEYE");
        match model {
            "" | "SIMPLE_PINHOLE" | "PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV"
            | "OPENCV_FISHEYE" => {}
            other => {
                return Err(format!(
                    "camera_model {:?}, expected PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or OPENCV_FISHEYE",
                    other.chars().take(60).collect::<String>()
                ));
            }
        }
        let distortion = if is_fisheye {
            Distortion::Equidistant([k1, k2, k3, k4])
        } else if k4 == 0.0 {
            Distortion::PlumbBob([k1, k2, p1, p2, k3])
        } else {
            return Err(format!("k4 = {k4}, which only a fisheye has"));
        };
        if !distortion.is_finite() {
            return Err(format!("distortion {distortion:?}"));
        }
        Ok(if distortion.is_none() {
            Distortion::None
        } else {
            distortion
        })
    }
}

/// The same camera with y down and z forward.
fn opencv_from_opengl(gt_from_gl: Rigid) -> Rigid {
    let half_turn = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
    Rigid::new(gt_from_gl.rotation * half_turn, gt_from_gl.translation)
}

/// The upper three rows; `None` unless they are a rotation, as exact as files have it, and a shift.
fn rigid_of(rows: &[Vec<f64>]) -> Option<Rigid> {
    let row = |ix: usize| -> Option<[f64; 4]> { rows.get(ix)?.as_slice().try_into().ok() };
    let (x, y, z) = (row(0)?, row(1)?, row(2)?);
    let column = |ix: usize| DVec3::new(x[ix], y[ix], z[ix]);
    // Some writers scale the whole matrix: the axes then share one length, which is no part of a rotation.
    let lengths = [0, 1, 2].map(|ix| column(ix).length());
    let mean = lengths.iter().sum::<f64>() / 3.0;
    let is_even = lengths
        .iter()
        .all(|l| l.is_finite() && (l - mean).abs() <= AXES_SLACK * mean);
    if !(is_even && mean > 0.0 && column(3).is_finite()) {
        return None;
    }
    let [a, b, c] = [0, 1, 2].map(|ix| column(ix).normalize());
    let is_square = a.dot(b).abs() + b.dot(c).abs() + c.dot(a).abs() <= 3.0 * AXES_SLACK;
    let is_right_handed = a.cross(b).dot(c) > 0.0;
    let rotation = DQuat::from_mat3(&DMat3::from_cols(a, b, c)).normalize();
    (is_square && is_right_handed && rotation.is_finite()).then(|| Rigid::new(rotation, column(3)))
}
