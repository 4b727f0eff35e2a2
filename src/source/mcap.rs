//! MCAP recordings of ROS 2 topics -> frames.
//!
//! Surveys the recording once for its topics, calibration and ground truth, then replays the pictures.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use crate::camera::Lens;
use crate::clock::Stamp;
use crate::config::SourceParams;
use crate::frame::{DepthMap, Frame, RgbImage};
use crate::pose::Rigid;
use crate::ros::{self, CameraInfo, CompressedImage, Image};
use crate::source::bag::{Bag, not_mcap};
use crate::source::calibration::lens_of_camera_info;
use crate::source::intake::{Arrival, Extras, Intake};
use crate::source::survey::{Survey, Topic, header_stamp};
use crate::source::truth::{Track, Transforms, half_interval};
use crate::source::{Source, SourceCounts, SourceError, natural_order, read_small};

/// Pictures, and depth maps, that wait for each other: their messages may lie so far apart in the recording.
const MAX_AHEAD: usize = 32;
/// Memory for either.
const MAX_AHEAD_BYTES: usize = 64 << 20;
/// A metadata.yaml names files and topics; a larger one is something else.
const MAX_METADATA_BYTES: u64 = 16 << 20;

/// Where ground truth comes from.
#[derive(Debug)]
enum Truth {
    None,
    Track(Track),
    Transforms { transforms: Transforms, camera_frame: String },
}

impl Truth {
    fn at(&self, stamp: Stamp, within_nanos: i64) -> Option<Rigid> {
        match self {
            Self::None => None,
            Self::Track(track) => track.nearest(stamp, within_nanos),
            Self::Transforms { transforms, camera_frame } => transforms.world_from(camera_frame, stamp, within_nanos),
        }
    }
}

/// A message that waits; the stamp is `None` where not even that can be read.
#[derive(Debug)]
struct Waiting {
    stamp: Option<Stamp>,
    payload: Vec<u8>,
}

#[derive(Debug)]
pub struct McapSource {
    bag: Bag,
    image_topic: String,
    is_compressed: bool,
    depth_topic: Option<String>,
    truth: Truth,
    truth_within_nanos: i64,
    n_images: u64,
    max_frames: u64,
    images: VecDeque<Waiting>,
    depths: VecDeque<Waiting>,
    is_read: bool,
    intake: Intake,
}

impl McapSource {
    /// `path` is a `.mcap` file, or a rosbag2 folder whose files are read in the order of its metadata.yaml.
    pub fn open(path: &Path, params: &SourceParams) -> Result<Self, SourceError> {
        let files = files_of(path)?;
        if let Some(reason) = files.first().and_then(|first| not_mcap(first)) {
            let way_out = "record with ros2 bag record -s mcap, or convert with mcap convert";
            return Err(SourceError::Open { what: "recording", reason, way_out, path: path.to_owned() });
        }
        let survey = Survey::of(files.clone());
        let image_topic = image_topic_of(&survey, params, path)?;
        let topic = &survey.topics[&image_topic];
        if survey.has_left_out {
            tracing::warn!("more poses than are kept: frames late in the recording have no ground truth");
        }
        let depth_topic = depth_topic_of(&survey, params);
        let lens = lens_of(&survey, &image_topic, params);
        let (is_compressed, n_images) = (topic.is_compressed(), topic.n_messages);
        let truth_within_nanos = half_interval(&topic.stamps);
        tracing::info!(topic = image_topic, frames = n_images, calibrated = lens.is_some(), "recording opened");
        Ok(Self {
            bag: Bag::new(files),
            is_compressed,
            depth_topic,
            truth_within_nanos,
            n_images,
            truth: truth_of(survey, &image_topic, params),
            image_topic,
            max_frames: params.max_frames,
            images: VecDeque::new(),
            depths: VecDeque::new(),
            is_read: false,
            intake: Intake::new(params, lens),
        })
    }

    /// Takes one message in.
    fn read_on(&mut self) {
        let message = match self.bag.next_message() {
            Ok(Some(message)) => message,
            Ok(None) => {
                self.is_read = true;
                return;
            }
            Err(fault) => {
                self.is_read = true;
                self.intake.fault(fault);
                return;
            }
        };
        let waiting = if message.channel.topic == self.image_topic {
            &mut self.images
        } else if Some(&message.channel.topic) == self.depth_topic.as_ref() {
            &mut self.depths
        } else {
            return;
        };
        let stamp = header_stamp(message.payload, message.log_nanos);
        waiting.push_back(Waiting { stamp, payload: message.payload.to_vec() });
        while self.depths.len() > MAX_AHEAD || (self.depths.len() > 1 && bytes_of(&self.depths) > MAX_AHEAD_BYTES) {
            self.depths.pop_front();
        }
    }

    /// The oldest picture, once its depth map is here or will not come.
    fn take_ready(&mut self) -> Option<Waiting> {
        let stamp = self.images.front()?.stamp;
        let newest_depth = self.depths.iter().filter_map(|depth| depth.stamp).max();
        let is_ready = self.is_read
            || self.depth_topic.is_none()
            || stamp.is_none()
            || newest_depth >= stamp
            || self.images.len() > MAX_AHEAD
            || bytes_of(&self.images) > MAX_AHEAD_BYTES;
        if is_ready { self.images.pop_front() } else { None }
    }

    fn frame_of(&mut self, waiting: &Waiting) -> Option<Frame> {
        let Some(stamp) = waiting.stamp else {
            self.intake.unreadable("its message has no CDR header");
            return None;
        };
        let arrival = self.intake.arrive(stamp)?;
        match picture_of(&waiting.payload, self.is_compressed) {
            Ok(picture) => self.frame_with(arrival, picture),
            Err(reason) => {
                self.intake.undecodable(arrival.seq, &reason);
                None
            }
        }
    }

    fn frame_with(&mut self, arrival: Arrival, picture: RgbImage) -> Option<Frame> {
        let truth = self.truth.at(arrival.stamp, self.truth_within_nanos);
        let depth = self.depths.iter().find(|depth| depth.stamp == Some(arrival.stamp));
        let truth_depth = match depth.map(|depth| depth_of(&depth.payload)) {
            Some(Ok(depth)) => Some(depth),
            Some(Err(reason)) => {
                self.intake.warn_once("depth", &format!("depth maps are left out: {reason}"));
                None
            }
            None => None,
        };
        self.intake.frame(arrival, picture, Extras { truth, truth_depth })
    }
}

impl Source for McapSource {
    fn next(&mut self) -> Option<Frame> {
        while !self.intake.is_full() {
            if let Some(waiting) = self.take_ready() {
                if let Some(frame) = self.frame_of(&waiting) {
                    return Some(frame);
                }
            } else if self.is_read {
                return None;
            } else {
                self.read_on();
            }
        }
        None
    }

    fn counts(&self) -> SourceCounts {
        self.intake.counts()
    }

    fn len_hint(&self) -> Option<u64> {
        let counts = self.intake.counts();
        let left = self.n_images.saturating_sub(counts.received);
        let frames_out = counts.received - counts.undecodable - counts.out_of_order;
        let room = if self.max_frames == 0 { u64::MAX } else { self.max_frames.saturating_sub(frames_out) };
        Some(left.min(room))
    }
}

fn bytes_of(queue: &VecDeque<Waiting>) -> usize {
    queue.iter().map(|waiting| waiting.payload.len()).sum()
}

fn picture_of(payload: &[u8], is_compressed: bool) -> Result<RgbImage, String> {
    if is_compressed {
        let message: CompressedImage = ros::decode(payload).map_err(|e| e.to_string())?;
        return super::decode::compressed(&message.data).map_err(|e| e.to_string());
    }
    let message: Image = ros::decode(payload).map_err(|e| e.to_string())?;
    super::decode::raw(&message).map_err(|e| e.to_string())
}

fn depth_of(payload: &[u8]) -> Result<DepthMap, String> {
    let message: Image = ros::decode(payload).map_err(|e| e.to_string())?;
    super::decode::depth(&message).map_err(|e| e.to_string())
}

/// The files of a recording in order.
fn files_of(path: &Path) -> Result<Vec<PathBuf>, SourceError> {
    let fail = |reason: String, way_out| SourceError::Open { what: "recording", reason, way_out, path: path.to_owned() };
    let metadata = std::fs::metadata(path).map_err(|e| fail(e.to_string(), "name an .mcap file or a rosbag2 folder"))?;
    if !metadata.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path).map_err(|e| fail(e.to_string(), "make the folder readable"))?;
    let mut found: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    let is_packed = |file: &PathBuf| file.to_string_lossy().ends_with(".mcap.zstd");
    let has_packed = found.iter().any(is_packed);
    found.retain(|file| file.extension().is_some_and(|extension| extension == "mcap"));
    found.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
    let listed = listed_files(path);
    if !listed.is_empty() && listed.iter().all(|file| file.is_file()) {
        return Ok(listed);
    }
    if !listed.is_empty() && !found.is_empty() {
        tracing::warn!("metadata.yaml lists files that are not there; all .mcap files are read by name: {}", path.display());
    }
    if found.is_empty() {
        let (reason, way_out) = if has_packed {
            ("its files are compressed as a whole", "unpack them with zstd -d --rm *.zstd and run ros2 bag reindex")
        } else {
            ("no .mcap file is in it", "convert a .db3 bag with ros2 bag convert to storage mcap")
        };
        return Err(fail(reason.to_owned(), way_out));
    }
    Ok(found)
}

/// What metadata.yaml says; empty when there is none or it makes no sense. Names that leave the folder make none.
fn listed_files(folder: &Path) -> Vec<PathBuf> {
    let Ok(text) = read_small(&folder.join("metadata.yaml"), MAX_METADATA_BYTES) else { return Vec::new() };
    let Ok(tree) = serde_saphyr::from_str::<serde_json::Value>(&String::from_utf8_lossy(&text)) else {
        tracing::warn!("metadata.yaml is not YAML, all .mcap files are read by name: {}", folder.display());
        return Vec::new();
    };
    let names = tree.pointer("/rosbag2_bagfile_information/relative_file_paths").and_then(|v| v.as_array());
    let plain = |name: &serde_json::Value| {
        let name = name.as_str()?;
        let is_plain = Path::new(name).components().all(|part| matches!(part, std::path::Component::Normal(_)));
        (is_plain && !name.is_empty() && name.ends_with(".mcap")).then(|| folder.join(name))
    };
    names.and_then(|names| names.iter().map(plain).collect()).unwrap_or_default()
}

fn image_topic_of(survey: &Survey, params: &SourceParams, path: &Path) -> Result<String, SourceError> {
    let none = || SourceError::NoImageTopic { found: survey.listing(), path: path.to_owned() };
    if !params.image_topic.is_empty() {
        let topic = survey.topics.get(&params.image_topic).ok_or_else(none)?;
        if topic.is_image() {
            return Ok(params.image_topic.clone());
        }
        let found = format!("{} ({})", topic.type_name, topic.message_encoding);
        return Err(SourceError::TopicType { topic: params.image_topic.clone(), found, path: path.to_owned() });
    }
    let candidates = || survey.topics.iter().filter(|(name, topic)| is_candidate(name, topic, params)).map(|(name, _)| name);
    let calibrated = candidates().find(|name| survey.infos.contains_key(&info_beside(name)));
    calibrated.or_else(|| candidates().next()).cloned().ok_or_else(none)
}

fn is_candidate(name: &str, topic: &Topic, params: &SourceParams) -> bool {
    topic.is_image() && !topic.is_depth() && !name.ends_with("/compressedDepth") && name != params.depth_topic
}

/// `/camera/image_raw/compressed` and `/camera/image_raw` have `/camera/camera_info` beside them.
fn info_beside(image_topic: &str) -> String {
    let base = image_topic.strip_suffix("/compressed").unwrap_or(image_topic);
    format!("{}/camera_info", base.rsplit_once('/').map_or("", |(parent, _)| parent))
}

fn depth_topic_of(survey: &Survey, params: &SourceParams) -> Option<String> {
    if params.depth_topic.is_empty() {
        return survey.topics.iter().find(|(_, topic)| topic.is_image() && topic.is_depth()).map(|(name, _)| name.clone());
    }
    if !survey.topics.contains_key(&params.depth_topic) {
        tracing::warn!("no messages on depth topic {:?}; found {}", params.depth_topic, survey.listing());
    }
    Some(params.depth_topic.clone())
}

fn lens_of(survey: &Survey, image_topic: &str, params: &SourceParams) -> Option<Lens> {
    let topic = if !params.camera_info_topic.is_empty() {
        params.camera_info_topic.clone()
    } else {
        let beside = info_beside(image_topic);
        let n_cameras = survey.topics.iter().filter(|(name, topic)| is_candidate(name, topic, params)).count();
        let only = (survey.infos.len() == 1 && n_cameras == 1).then(|| survey.infos.keys().next().cloned());
        if survey.infos.contains_key(&beside) { beside } else { only.flatten().unwrap_or(beside) }
    };
    let Some(info) = survey.infos.get(&topic) else {
        tracing::warn!("no CameraInfo on {topic:?}: the camera counts as uncalibrated");
        return None;
    };
    let found = lens_of_camera_info(info, is_rectified(image_topic, info));
    found.inspect_err(|found| tracing::warn!("camera counts as uncalibrated, {topic:?} says: {found}")).ok()
}

/// image_proc publishes undistorted pictures as `image_rect` and `image_rect_color` beside the CameraInfo of the raw ones.
fn is_rectified(image_topic: &str, info: &CameraInfo) -> bool {
    let base = image_topic.strip_suffix("/compressed").unwrap_or(image_topic);
    base.rsplit('/').next().is_some_and(|name| name.starts_with("image_rect")) && info.p[0] > 0.0
}

fn truth_of(mut survey: Survey, image_topic: &str, params: &SourceParams) -> Truth {
    if !params.pose_topic.is_empty() {
        return match survey.poses.remove(&params.pose_topic) {
            Some(track) => Truth::Track(track),
            None => {
                tracing::warn!("no poses on topic {:?}; found {}", params.pose_topic, survey.listing());
                Truth::None
            }
        };
    }
    // A goal that someone clicked is a PoseStamped too.
    let named = |words: &[&str]| survey.poses.keys().find(|name| words.iter().any(|word| name.contains(word))).cloned();
    let other = || survey.poses.keys().find(|name| !name.contains("goal")).cloned();
    if let Some(track) = named(&["truth", "/gt"]).or_else(other).and_then(|name| survey.poses.remove(&name)) {
        return Truth::Track(track);
    }
    let camera_frame = survey.topics.get(image_topic).map(|topic| topic.frame_id.clone()).unwrap_or_default();
    if survey.transforms.reaches_world(&camera_frame) {
        return Truth::Transforms { transforms: survey.transforms, camera_frame };
    }
    Truth::None
}
