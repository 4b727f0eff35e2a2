//! The second camera of a stereo pair: which topic it is, how it is mounted, and its images.

use std::sync::{Arc, Mutex, PoisonError};

use glam::{DMat3, DQuat, DVec3};

use crate::calibration::is_rectified;
use crate::ground_truth::Transforms;
use crate::intake::{Extras, Intake};
use crate::params::SourceParams;
use crate::ros_image::decode_into;
use splat_image::jpeg::decoder::Jpeg;
use splat_msgs::ros::CameraInfo;
use splat_types::camera::CameraModel;
use splat_types::frame::{DecodedImage, SecondImage};
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// How drivers name the two cameras of a pair.
const NAMES: [(&str, &str); 5] = [
    ("left", "right"),
    ("cam0", "cam1"),
    ("infra1", "infra2"),
    ("camera0", "camera1"),
    ("first", "second"),
];
/// A baseline outside of these is no stereo pair, in metres.
const BASELINES: std::ops::RangeInclusive<f64> = 0.005..=5.0;

/// The topic that goes with an image topic as its second camera by name; `None` where the name is not that of a first one.
pub fn partner_of(image_topic: &str) -> Option<String> {
    let named = |(first, second): &(&str, &str)| {
        let at = image_topic.rfind(first)?;
        let (before, after) = (&image_topic[..at], &image_topic[at + first.len()..]);
        Some(format!("{before}{second}{after}"))
    };
    NAMES.iter().find_map(named)
}

/// How the second camera is mounted, by the calibrations of a rectified pair (REP 104): the first column of P that differs is
/// `-fx` times the baseline, and R turns each camera into the rectified pair. `second_from_first`, of the images as they come.
/// `None` where the calibrations are those of single cameras.
fn second_from_first(
    (first_topic, first): (&str, &CameraInfo),
    (second_topic, second): (&str, &CameraInfo),
) -> Option<Rigid> {
    let shift = |info: &CameraInfo| {
        let fx = info.p[0];
        (fx > 0.0).then(|| info.p[3] / fx)
    };
    let along = DVec3::X * (shift(second)? - shift(first)?);
    let mounted = second_from_rectified(second_topic, second)
        * Rigid::new(DQuat::IDENTITY, along)
        * second_from_rectified(first_topic, first).inverse();
    is_pair(&mounted).then_some(mounted)
}

/// A camera of a pair: its image topic, the frame of its images, its calibration.
#[derive(Debug, Clone, Copy)]
pub struct OfPair<'a> {
    pub topic: &'a str,
    pub frame_id: &'a str,
    pub info: &'a CameraInfo,
}

/// How the second camera is mounted, by both calibrations, else by the fixed transforms between their frames. `None` where neither
/// says so.
pub fn mounted(first: &OfPair<'_>, second: &OfPair<'_>, transforms: &Transforms) -> Option<Rigid> {
    let by_calibration = second_from_first((first.topic, first.info), (second.topic, second.info));
    let by_transforms = || {
        transforms
            .between(second.frame_id, first.frame_id)
            .filter(is_pair)
    };
    by_calibration.or_else(by_transforms)
}

/// Whether two cameras mounted like that can be a stereo pair.
fn is_pair(second_from_first: &Rigid) -> bool {
    second_from_first.is_finite() && BASELINES.contains(&second_from_first.translation.length())
}

/// What turns rays of the rectified camera into those of the images.
fn second_from_rectified(topic: &str, info: &CameraInfo) -> Rigid {
    let rectified_from_raw = DMat3::from_cols_array(&info.r).transpose();
    let is_rotation = (rectified_from_raw.determinant() - 1.0).abs() < 1e-3;
    if is_rectified(topic, info) || !is_rotation {
        return Rigid::IDENTITY;
    }
    let raw_from_rectified = DQuat::from_mat3(&rectified_from_raw.transpose());
    Rigid::new(raw_from_rectified.normalize(), DVec3::ZERO)
}

/// Makes second images of messages of the second camera.
#[derive(Debug)]
pub struct SecondCamera {
    second_from_first: Rigid,
    is_compressed: bool,
    /// Images are decoded by whoever looks at them first.
    decoder: Arc<Mutex<Decoder>>,
}

#[derive(Debug)]
struct Decoder {
    intake: Intake,
    jpeg: Jpeg,
}

impl SecondCamera {
    pub fn new(
        params: &SourceParams,
        lens: CameraModel,
        second_from_first: Rigid,
        is_compressed: bool,
    ) -> Self {
        let baseline_m = second_from_first.translation.length();
        tracing::info!(baseline_m, "stereo pair");
        let params = SourceParams {
            rate: 0.0,
            max_frames: 0,
            ..params.clone()
        };
        let decoder = Decoder {
            intake: Intake::new(&params, Some(lens)),
            jpeg: Jpeg::default(),
        };
        Self {
            second_from_first,
            is_compressed,
            decoder: Arc::new(Mutex::new(decoder)),
        }
    }

    /// The second image of an `Image` or `CompressedImage`.
    pub fn image(&self, stamp: Stamp, payload: Vec<u8>) -> SecondImage {
        let decoder = Arc::clone(&self.decoder);
        let is_compressed = self.is_compressed;
        SecondImage::new(self.second_from_first, move || {
            let mut decoder = decoder.lock().unwrap_or_else(PoisonError::into_inner);
            decoder.decoded(stamp, &payload, is_compressed)
        })
    }
}

impl Decoder {
    fn decoded(
        &mut self,
        stamp: Stamp,
        payload: &[u8],
        is_compressed: bool,
    ) -> Option<DecodedImage> {
        let mut image = self.intake.spare();
        if let Err(reason) = decode_into(payload, is_compressed, &mut self.jpeg, &mut image) {
            let text = format!("images of the second camera are left out: {reason}");
            self.intake.warn_once("second", &text);
            return None;
        }
        // Keyframes are looked at in any order.
        self.intake.begin_anew();
        let arrival = self.intake.arrive(stamp)?;
        let frame = self.intake.frame(arrival, image, Extras::default())?;
        Some(DecodedImage {
            image: frame.image,
            intrinsics: frame.intrinsics?,
        })
    }
}

#[cfg(test)]
mod tests;
