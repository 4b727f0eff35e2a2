//! Calibration files of ROS's `camera_calibration` (YAML) -> `CameraInfo`.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::calibration::lens_of_camera_info;
use crate::error::SourceError;
use crate::small_file::read_small;
use splat_msgs::ros::CameraInfo;
use splat_types::camera::CameraModel;

/// A calibration has some dozen numbers.
const MAX_FILE_BYTES: u64 = 1 << 20;

#[derive(Debug, Deserialize)]
struct CalibrationFile {
    image_width: u32,
    image_height: u32,
    camera_matrix: Matrix,
    #[serde(default)]
    distortion_model: String,
    distortion_coefficients: Option<Matrix>,
    rectification_matrix: Option<Matrix>,
    projection_matrix: Option<Matrix>,
}

/// `rows` and `cols` stand beside `data`, but the use of a matrix fixes them.
#[derive(Debug, Default, Deserialize)]
struct Matrix {
    data: Vec<f64>,
}

/// What the parameter `source.camera_info_url` names, and its lens: a path or `file://` URL; `None` when it is empty.
pub fn of_url(url: &str) -> Result<Option<(CameraInfo, CameraModel)>, SourceError> {
    if url.is_empty() {
        return Ok(None);
    }
    let path = path_of(url).map_err(|reason| fail(reason, Path::new(url)))?;
    let bytes = read_small(&path, MAX_FILE_BYTES).map_err(|reason| fail(reason, &path))?;
    let info = of_yaml(&String::from_utf8_lossy(&bytes)).map_err(|reason| fail(reason, &path))?;
    let lens = lens_of_camera_info(&info, false).map_err(|reason| fail(reason, &path))?;
    Ok(Some((info, lens)))
}

fn fail(reason: String, path: &Path) -> SourceError {
    SourceError::Open {
        what: "calibration",
        reason,
        way_out: "name a file that camera_calibration wrote in source.camera_info_url, or leave it empty",
        path: path.to_owned(),
    }
}

fn path_of(url: &str) -> Result<PathBuf, String> {
    let is_variable = url.contains("${");
    match url.split_once("://") {
        _ if is_variable => Err("variables in URLs are not resolved here".to_owned()),
        Some(("file", path)) if path.starts_with('/') => Ok(PathBuf::from(path)),
        Some(("file", _)) => Err("a file:// URL has an absolute path".to_owned()),
        Some((scheme, _)) => Err(format!("{scheme}:// is not read, only paths and file://")),
        None => Ok(PathBuf::from(url)),
    }
}

/// The text of a calibration file.
pub fn of_yaml(text: &str) -> Result<CameraInfo, String> {
    let file: CalibrationFile = serde_saphyr::from_str(text).map_err(|e| e.to_string())?;
    let k: [f64; 9] = array(file.camera_matrix.data, "camera_matrix")?;
    let r = match file.rectification_matrix {
        Some(matrix) => array(matrix.data, "rectification_matrix")?,
        None => [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
    };
    let p = match file.projection_matrix {
        Some(matrix) => array(matrix.data, "projection_matrix")?,
        None => [
            k[0], k[1], k[2], 0.0, k[3], k[4], k[5], 0.0, k[6], k[7], k[8], 0.0,
        ],
    };
    Ok(CameraInfo {
        height: file.image_height,
        width: file.image_width,
        distortion_model: file.distortion_model,
        d: file.distortion_coefficients.unwrap_or_default().data,
        k,
        r,
        p,
        ..CameraInfo::default()
    })
}

fn array<const N: usize>(data: Vec<f64>, name: &str) -> Result<[f64; N], String> {
    data.try_into()
        .map_err(|data: Vec<f64>| format!("{name} has {} numbers, expected {N}", data.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [500.5, 0, 319.5, 0, 501, 239.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.25, 0.1, 0.001, 0, 0]}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [480, 0, 320, 0, 0, 482, 240, 0, 0, 0, 1, 0]
";

    #[test]
    fn a_calibration_file_gives_a_lens_with_centres_at_half() {
        let info = of_yaml(FILE).unwrap();
        let lens = lens_of_camera_info(&info, false).unwrap();
        let i = lens.intrinsics;
        assert_eq!(
            (i.width_px, i.height_px, i.fx, i.fy),
            (640, 480, 500.5, 501.0)
        );
        assert_eq!((i.cx, i.cy, info.p[0]), (320.0, 240.0, 480.0));
        assert_eq!(
            lens.distortion,
            splat_types::camera::Distortion::PlumbBob([-0.25, 0.1, 0.001, 0.0, 0.0])
        );
    }

    #[test]
    fn a_url_that_cannot_be_read_says_why_and_where() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("head.yaml");
        std::fs::write(&path, FILE).unwrap();
        let url = format!("file://{}", path.display());
        assert!(of_url(&url).unwrap().is_some());
        assert!(of_url("").unwrap().is_none());
        let message = |url: &str| of_url(url).unwrap_err().to_string();
        assert!(message("package://robot/head.yaml").contains("package:// is not read"));
        assert!(message("file://${HOME}/head.yaml").contains("variables"));
        std::fs::write(&path, FILE.replace("500.5, 0,", "")).unwrap();
        assert!(message(&url).contains("camera_matrix has 7 numbers, expected 9"));
        std::fs::write(&path, FILE.replace("500.5", "-1")).unwrap();
        assert!(message(&url).contains("fx -1"));
    }
}
