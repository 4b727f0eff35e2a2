//! Survey of a recording -> which of its topics are the image, the calibration, the depth and the ground truth.

use std::path::Path;
use std::sync::Arc;

use crate::calibration::{is_rectified, lens_of_camera_info};
use crate::error::SourceError;
use crate::ground_truth::{GroundTruth, Odometry};
use crate::imu::{MountedImu, extrinsic_of};
use crate::params::SourceParams;
use crate::second_camera::{OfPair, mounted, partner_of};
use crate::survey::{Survey, Topic};
use splat_msgs::ros::Message as _;
use splat_msgs::ros::imu::Imu;
use splat_types::camera::CameraModel;
use splat_types::transform::Rigid;

pub(crate) fn image_topic_of(
    survey: &Survey,
    params: &SourceParams,
    path: &Path,
) -> Result<String, SourceError> {
    let none = || SourceError::NoImageTopic {
        found: survey.listing(),
        path: path.to_owned(),
    };
    if !params.image_topic.is_empty() {
        let topic = survey.topics.get(&params.image_topic).ok_or_else(none)?;
        if topic.is_image() {
            return Ok(params.image_topic.clone());
        }
        let found = format!("{} ({})", topic.type_name, topic.message_encoding);
        return Err(SourceError::TopicType {
            topic: params.image_topic.clone(),
            found,
            path: path.to_owned(),
        });
    }
    let candidates = || {
        survey
            .topics
            .iter()
            .filter(|(name, topic)| is_candidate(name, topic, params))
            .map(|(name, _)| name)
    };
    let calibrated = candidates().find(|name| survey.infos.contains_key(&info_beside(name)));
    calibrated
        .or_else(|| candidates().next())
        .cloned()
        .ok_or_else(none)
}

fn is_candidate(name: &str, topic: &Topic, params: &SourceParams) -> bool {
    topic.is_image()
        && !topic.is_depth()
        && !name.ends_with("/compressedDepth")
        && name != params.depth_topic
}

/// `/camera/image_raw/compressed` and `/camera/image_raw` have `/camera/camera_info` beside them.
pub fn info_beside(image_topic: &str) -> String {
    let base = image_topic
        .strip_suffix("/compressed")
        .unwrap_or(image_topic);
    format!(
        "{}/camera_info",
        base.rsplit_once('/').map_or("", |(parent, _)| parent)
    )
}

/// The CameraInfo topic of an image topic: the one that is named, else the one beside it.
pub fn info_topic_of(named: &str, image_topic: &str) -> String {
    if named.is_empty() {
        info_beside(image_topic)
    } else {
        named.to_owned()
    }
}

pub(crate) fn depth_topic_of(survey: &Survey, params: &SourceParams) -> Option<String> {
    if params.depth_topic.is_empty() {
        return survey
            .topics
            .iter()
            .find(|(_, topic)| topic.is_image() && topic.is_depth())
            .map(|(name, _)| name.clone());
    }
    if !survey.topics.contains_key(&params.depth_topic) {
        tracing::warn!(
            "no messages on depth topic {:?}; found {}",
            params.depth_topic,
            survey.listing()
        );
    }
    Some(params.depth_topic.clone())
}

/// The second camera of a stereo pair.
pub(crate) struct SecondTopic {
    pub(crate) name: String,
    pub(crate) is_compressed: bool,
    pub(crate) lens: CameraModel,
    pub(crate) second_from_first: Rigid,
}

/// The topic of the second camera that the parameters name, or that goes with the image topic by its name; `None` where there is
/// none, or nothing says how it is mounted.
pub(crate) fn second_topic_of(
    survey: &Survey,
    image_topic: &str,
    params: &SourceParams,
) -> Option<SecondTopic> {
    let is_named = !params.second_image_topic.is_empty();
    let name = if is_named {
        params.second_image_topic.clone()
    } else {
        partner_of(image_topic)?
    };
    let complain = |what: &str| {
        if is_named {
            tracing::warn!("no stereo: {what}; found {}", survey.listing());
        }
    };
    let Some(topic) = survey.topics.get(&name).filter(|topic| topic.is_image()) else {
        complain(&format!("no images on {name:?}"));
        return None;
    };
    let first_topic = info_topic_of(&params.camera_info_topic, image_topic);
    let second_topic = info_topic_of(&params.second_camera_info_topic, &name);
    let infos = survey.infos.get(&first_topic);
    let Some((first, second)) = infos.zip(survey.infos.get(&second_topic)) else {
        complain(&format!(
            "no CameraInfo on {first_topic:?} or {second_topic:?}"
        ));
        return None;
    };
    let lens = lens_of_camera_info(second, is_rectified(&name, second)).ok()?;
    let first = OfPair {
        topic: image_topic,
        frame_id: survey.topics.get(image_topic)?.frame_id.as_str(),
        info: first,
    };
    let of_second = OfPair {
        topic: &name,
        frame_id: &topic.frame_id,
        info: second,
    };
    let mounted = mounted(&first, &of_second, &survey.transforms);
    if mounted.is_none() {
        complain(&format!(
            "neither P of {second_topic:?} nor /tf_static says how far the cameras are apart"
        ));
    }
    Some(SecondTopic {
        is_compressed: topic.is_compressed(),
        lens,
        second_from_first: mounted?,
        name,
    })
}

pub(crate) fn lens_of(
    survey: &Survey,
    image_topic: &str,
    params: &SourceParams,
) -> Option<CameraModel> {
    let topic = if !params.camera_info_topic.is_empty() {
        params.camera_info_topic.clone()
    } else {
        let beside = info_beside(image_topic);
        let n_cameras = survey
            .topics
            .iter()
            .filter(|(name, topic)| is_candidate(name, topic, params))
            .count();
        let only = (survey.infos.len() == 1 && n_cameras == 1)
            .then(|| survey.infos.keys().next().cloned());
        if survey.infos.contains_key(&beside) {
            beside
        } else {
            only.flatten().unwrap_or(beside)
        }
    };
    let Some(info) = survey.infos.get(&topic) else {
        tracing::warn!("no CameraInfo on {topic:?}: the camera counts as uncalibrated");
        return None;
    };
    let found = lens_of_camera_info(info, is_rectified(image_topic, info));
    found
        .inspect_err(|found| {
            tracing::warn!("camera counts as uncalibrated, {topic:?} says: {found}");
        })
        .ok()
}

pub(crate) fn odometry_of(
    survey: &mut Survey,
    image_topic: &str,
    params: &SourceParams,
) -> Odometry {
    let wanted = &params.odometry_topic;
    let name = if wanted.is_empty() {
        survey.odometry.keys().next().cloned()
    } else {
        Some(wanted.clone())
    };
    let camera_frame = survey
        .topics
        .get(image_topic)
        .map(|topic| topic.frame_id.clone())
        .unwrap_or_default();
    if let Some((base, track)) = name.and_then(|name| survey.odometry.remove(&name)) {
        let mounted = survey.transforms.fixed(&base, &camera_frame);
        if mounted.is_none() {
            tracing::warn!(
                "no fixed transforms from {base:?} to the camera {camera_frame:?}: it counts as mounted where odometry turns"
            );
        }
        return Odometry::Messages {
            track,
            base_from_cam: mounted.unwrap_or(Rigid::IDENTITY),
        };
    }
    if !wanted.is_empty() {
        let listing = survey.listing();
        tracing::warn!("no odometry on topic {wanted:?}; found {listing}");
    } else if survey.transforms.reaches_odometry(&camera_frame) {
        return Odometry::Transforms {
            transforms: Arc::clone(&survey.transforms),
            camera_frame,
        };
    }
    Odometry::None
}

/// The topic of an IMU, and how it is mounted.
#[derive(Debug)]
pub(crate) struct ImuTopic {
    pub(crate) name: String,
    pub(crate) mounted: MountedImu,
}

/// The IMU that the parameters name, else the first one whose place beside the camera is known; `None`, and a warning, where there
/// are some and of none it is.
pub(crate) fn imu_topic_of(
    survey: &Survey,
    image_topic: &str,
    params: &SourceParams,
) -> Result<Option<ImuTopic>, String> {
    let by_params = extrinsic_of(params)?;
    let camera = survey.topics.get(image_topic).map_or("", |t| &t.frame_id);
    let is_imu = |topic: &Topic| topic.is_cdr() && topic.type_name == Imu::TYPE_NAME;
    let all = survey.topics.iter().filter(|(_, topic)| is_imu(topic));
    let wanted = &params.imu_topic;
    let candidates: Vec<_> = all
        .filter(|(name, _)| wanted.is_empty() || *name == wanted)
        .collect();
    let mounted = candidates.iter().find_map(|(name, topic)| {
        let is_named = !camera.is_empty() && !topic.frame_id.is_empty();
        let by_tf = survey.transforms.between(camera, &topic.frame_id);
        let by_tf = by_tf.filter(|_| is_named);
        let cam_from_imu = by_tf.or(by_params)?;
        Some(ImuTopic {
            name: (*name).clone(),
            mounted: MountedImu::new(&cam_from_imu, params),
        })
    });
    if mounted.is_none() {
        if let Some((name, topic)) = candidates.first() {
            tracing::warn!(
                "the IMU on {name:?} is left out: /tf_static does not lead from the camera {camera:?} to its frame {:?}; source.imu_extrinsic says it, too",
                topic.frame_id
            );
        } else if !wanted.is_empty() {
            tracing::warn!(
                "no sensor_msgs/msg/Imu on topic {wanted:?}; found {}",
                survey.listing()
            );
        }
    }
    Ok(mounted)
}

pub(crate) fn truth_of(
    mut survey: Survey,
    image_topic: &str,
    params: &SourceParams,
) -> GroundTruth {
    if !params.pose_topic.is_empty() {
        return match survey.poses.remove(&params.pose_topic) {
            Some(track) => GroundTruth::Track(track),
            None => {
                tracing::warn!(
                    "no poses on topic {:?}; found {}",
                    params.pose_topic,
                    survey.listing()
                );
                GroundTruth::None
            }
        };
    }
    // A goal that someone clicked is a PoseStamped too.
    let named = |words: &[&str]| {
        survey
            .poses
            .keys()
            .find(|name| words.iter().any(|word| name.contains(word)))
            .cloned()
    };
    let other = || {
        survey
            .poses
            .keys()
            .find(|name| !name.contains("goal"))
            .cloned()
    };
    if let Some(track) = named(&["truth", "/gt"])
        .or_else(other)
        .and_then(|name| survey.poses.remove(&name))
    {
        return GroundTruth::Track(track);
    }
    let camera_frame = survey
        .topics
        .get(image_topic)
        .map(|topic| topic.frame_id.clone())
        .unwrap_or_default();
    if survey.transforms.reaches_world(&camera_frame) {
        return GroundTruth::Transforms {
            transforms: survey.transforms,
            camera_frame,
        };
    }
    GroundTruth::None
}
