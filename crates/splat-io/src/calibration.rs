//! `CameraInfo` and `intrinsics.json` -> lens, with pixel centres moved from integers to +0.5.
//!
//! Refuses what cannot be a calibration; the text of the refusal says what was found.

use serde::Deserialize;

use splat_msgs::ros::CameraInfo;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};

/// Sides of the image and of the calibration may differ by so much in aspect, as rounding of a resize leaves.
const MAX_ASPECT_ERROR: f64 = 0.01;

/// `is_rectified`: the topic carries images that image_proc has undistorted, which `p` describes instead of `k`, `d`.
pub fn lens_of_camera_info(info: &CameraInfo, is_rectified: bool) -> Result<CameraModel, String> {
    let (fx, fy, cx, cy) = if is_rectified {
        (info.p[0], info.p[5], info.p[2], info.p[6])
    } else {
        (info.k[0], info.k[4], info.k[2], info.k[5])
    };
    let distortion = if is_rectified {
        Distortion::None
    } else {
        distortion_of(&info.distortion_model, &info.d)?
    };
    let roi = &info.roi;
    let has_roi = roi.width > 0 && roi.height > 0;
    let (left, top) = if has_roi {
        (f64::from(roi.x_offset), f64::from(roi.y_offset))
    } else {
        (0.0, 0.0)
    };
    let (width, height) = if has_roi {
        (roi.width, roi.height)
    } else {
        (info.width, info.height)
    };
    let (bin_x, bin_y) = (info.binning_x.max(1), info.binning_y.max(1));
    // CameraInfo describes the full sensor: first the cut, then the binning.
    let intrinsics = Intrinsics {
        width_px: width / bin_x,
        height_px: height / bin_y,
        fx: fx / f64::from(bin_x),
        fy: fy / f64::from(bin_y),
        cx: (cx + 0.5 - left) / f64::from(bin_x),
        cy: (cy + 0.5 - top) / f64::from(bin_y),
    };
    checked(CameraModel {
        intrinsics,
        distortion,
    })
}

/// image_proc publishes undistorted images as `image_rect` and `image_rect_color` beside the CameraInfo of the raw ones.
pub fn is_rectified(image_topic: &str, info: &CameraInfo) -> bool {
    let base = image_topic
        .strip_suffix("/compressed")
        .unwrap_or(image_topic);
    base.rsplit('/')
        .next()
        .is_some_and(|name| name.starts_with("image_rect"))
        && info.p[0] > 0.0
}

/// What `intrinsics.json` of a folder of images holds; other keys are ignored.
#[derive(Debug, Deserialize)]
struct IntrinsicsFile {
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    #[serde(default)]
    model: String,
    #[serde(default)]
    distortion_model: String,
    #[serde(default)]
    d: Vec<f64>,
}

/// `model` is PINHOLE or absent; `distortion_model` and `d` may stand beside it as in `CameraInfo`.
pub fn lens_of_json(text: &str) -> Result<CameraModel, String> {
    let file: IntrinsicsFile = serde_json::from_str(text).map_err(|e| e.to_string())?;
    if !file.model.is_empty() && !file.model.eq_ignore_ascii_case("pinhole") {
        return Err(format!(
            "camera model {:?}, expected PINHOLE with distortion_model and d beside it",
            file.model
        ));
    }
    let (width_px, height_px, fx, fy) = (file.width, file.height, file.fx, file.fy);
    let intrinsics = Intrinsics {
        width_px,
        height_px,
        fx,
        fy,
        cx: file.cx + 0.5,
        cy: file.cy + 0.5,
    };
    checked(CameraModel {
        intrinsics,
        distortion: distortion_of(&file.distortion_model, &file.d)?,
    })
}

/// The lens for images of this size; an image of another aspect is another crop, which the calibration is not for.
pub fn lens_for_size(
    lens: &CameraModel,
    width_px: u32,
    height_px: u32,
) -> Result<CameraModel, String> {
    let own = &lens.intrinsics;
    let aspect = |w: u32, h: u32| f64::from(w) / f64::from(h);
    let error = aspect(width_px, height_px) / aspect(own.width_px, own.height_px) - 1.0;
    if error.abs() > MAX_ASPECT_ERROR {
        let (w, h) = (own.width_px, own.height_px);
        return Err(format!(
            "calibration for {w}x{h} px, images of {width_px}x{height_px} px"
        ));
    }
    Ok(lens.resized(width_px, height_px))
}

fn checked(lens: CameraModel) -> Result<CameraModel, String> {
    let i = &lens.intrinsics;
    if !i.is_plausible() {
        return Err(format!(
            "fx {} fy {} cx {} cy {} for {}x{} px",
            i.fx, i.fy, i.cx, i.cy, i.width_px, i.height_px
        ));
    }
    if !lens.distortion.is_finite() {
        return Err(format!("distortion {:?}", lens.distortion));
    }
    Ok(lens)
}

fn distortion_of(model: &str, d: &[f64]) -> Result<Distortion, String> {
    // Drivers pad with zeros or leave trailing ones off; both mean the same lens.
    let padded = |n: usize| {
        let rest_is_zero = d.iter().skip(n).all(|&c| c == 0.0);
        rest_is_zero.then(|| {
            (0..n)
                .map(|ix| d.get(ix).copied().unwrap_or(0.0))
                .collect::<Vec<_>>()
        })
    };
    let too_many = || format!("{} coefficients of distortion model {model:?}", d.len());
    let distortion = match model {
        _ if d.is_empty() && model != "equidistant" && model != "fisheye" => Distortion::None,
        "" if d.iter().all(|&c| c == 0.0) => Distortion::None,
        "plumb_bob" => array(padded(5))
            .map(Distortion::PlumbBob)
            .ok_or_else(too_many)?,
        "rational_polynomial" => array(padded(8))
            .map(Distortion::Rational)
            .ok_or_else(too_many)?,
        "equidistant" | "fisheye" => array(padded(4))
            .map(Distortion::Equidistant)
            .ok_or_else(too_many)?,
        _ => {
            return Err(format!(
                "distortion model {model:?}, expected plumb_bob, rational_polynomial or equidistant"
            ));
        }
    };
    Ok(if distortion.is_none() {
        Distortion::None
    } else {
        distortion
    })
}

fn array<const N: usize>(values: Option<Vec<f64>>) -> Option<[f64; N]> {
    values.and_then(|values| values.try_into().ok())
}
