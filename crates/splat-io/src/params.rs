//! Parameters of sources, cameras and recordings: `source.*`, `record.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use splat_types::inertial::ImuModel;

/// Parameters `source.*`: which frames of which topics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SourceParams {
    /// Image topic of a recording; empty takes the first by name with a CameraInfo beside it.
    pub image_topic: String,
    /// CameraInfo topic; empty takes the one beside the image topic.
    pub camera_info_topic: String,
    /// Calibration of a camera or a recording: a file of ROS's camera_calibration (YAML), as a path or file://
    /// URL; it goes before a recording's own.
    pub camera_info_url: String,
    /// PoseStamped ground truth (camera to world); empty takes the first found, tf next.
    pub pose_topic: String,
    /// Depth images (16UC1 mm or 32FC1 m, raw or compressedDepth) for geometry rgbd and ground_truth, aligned to colour
    /// or with CameraInfo and tf of their own; of a recording, empty takes the first found.
    pub depth_topic: String,
    /// A depth image belongs to the colour image whose stamp is nearest, if they are no farther apart.
    #[schemars(range(min = 0.0, max = 1.0), extend("unit" = "s"))]
    pub depth_tolerance: f64,
    /// Image topic of the second camera of a stereo pair, the right one; of a recording, empty takes the one whose name
    /// says so (left and right, cam0 and cam1, infra1 and infra2), if its calibration states a baseline.
    pub second_image_topic: String,
    /// CameraInfo topic of the second camera; empty takes the one beside its image topic.
    pub second_camera_info_topic: String,
    /// Images of a pair whose stamps are farther apart are no pair.
    #[schemars(range(min = 0.0, max = 0.1), extend("unit" = "s"))]
    pub stereo_tolerance: f64,
    /// nav_msgs/Odometry; empty takes the first there is, else tf from the frame odom to the camera.
    pub odometry_topic: String,
    /// sensor_msgs/Imu, 100 to 1000 Hz; of a recording, empty takes the first found that /tf_static leads to from the camera.
    pub imu_topic: String,
    /// Where the IMU sits where no transform says: "x y z qx qy qz qw" in the camera's axes (x right, y down, z forward),
    /// metres and a quaternion.
    pub imu_extrinsic: String,
    /// Noise density of the gyroscope, as data sheets have it.
    #[schemars(range(min = 1e-6, max = 1.0), extend("unit" = "rad/s/√Hz"))]
    pub imu_gyro_noise: f64,
    /// Noise density of the accelerometer.
    #[schemars(range(min = 1e-6, max = 10.0), extend("unit" = "m/s²/√Hz"))]
    pub imu_accelerometer_noise: f64,
    /// Images of a folder or scene to use: beginnings of their file names, separated by commas; empty = all.
    pub include_prefixes: String,
    /// Of those, the images that are kept out of optimisation to measure quality, besides map.holdout: beginnings
    /// of their file names; empty = none.
    pub holdout_prefixes: String,
    /// Number of those images to use, drawn by the seed; 0 = all.
    #[schemars(range(min = 0, max = 1000000))]
    pub subsample: usize,
    /// Longer side of the working image; larger input is scaled down.
    #[schemars(range(min = 32, max = 4096), extend("unit" = "px"))]
    pub max_side: u32,
    /// Stop after so many frames; 0 reads all.
    #[schemars(range(min = 0, max = 4294967295_u64))]
    pub max_frames: u64,
    /// Undistort to a pinhole image where CameraInfo gives the lens distortion.
    pub rectify: bool,
    /// Replay speed as a multiple of the recording's; 0 = as fast as possible.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub rate: f64,
    /// Cameras that are read directly.
    pub camera: CameraParams,
}

impl Default for SourceParams {
    fn default() -> Self {
        Self {
            image_topic: String::new(),
            camera_info_topic: String::new(),
            camera_info_url: String::new(),
            pose_topic: String::new(),
            depth_topic: String::new(),
            depth_tolerance: 0.02,
            second_image_topic: String::new(),
            second_camera_info_topic: String::new(),
            stereo_tolerance: 0.003,
            odometry_topic: String::new(),
            imu_topic: String::new(),
            imu_extrinsic: String::new(),
            imu_gyro_noise: ImuModel::default().gyro_noise,
            imu_accelerometer_noise: ImuModel::default().accelerometer_noise,
            include_prefixes: String::new(),
            holdout_prefixes: String::new(),
            subsample: 0,
            max_side: 640,
            max_frames: 0,
            rectify: true,
            rate: 0.0,
            camera: CameraParams::default(),
        }
    }
}

/// Parameters `source.camera.*`: what is requested from a camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CameraParams {
    /// Pixel formats that may be requested from a camera, the best first; size and rate go before this order.
    pub formats: String,
    /// Requested width; the smallest size of the camera that is no smaller is taken, else its largest.
    #[schemars(range(min = 16, max = 16384), extend("unit" = "px"))]
    pub width: u32,
    /// Requested height.
    #[schemars(range(min = 16, max = 16384), extend("unit" = "px"))]
    pub height: u32,
    /// Requested rate; a format that reaches it goes before one that does not.
    #[schemars(range(min = 0.1, max = 1000.0), extend("unit" = "Hz"))]
    pub rate: f64,
    /// Images that the driver may fill before one is read.
    #[schemars(range(min = 2, max = 32))]
    pub buffers: u32,
    /// Exposure time with automatic exposure off; 0 leaves both unchanged.
    #[schemars(range(min = 0.0, max = 10.0), extend("unit" = "s"))]
    pub exposure: f64,
    /// Gain in the camera's own unit with automatic gain off; -1 leaves both unchanged.
    #[schemars(range(min = -1, max = 65535))]
    pub gain: i32,
    /// Automatic focus off, so that the focal length stays.
    pub lock_focus: bool,
    /// Focus in the camera's own unit with automatic focus off; -1 leaves the lens unchanged.
    #[schemars(range(min = -1, max = 65535))]
    pub focus: i32,
    /// Further controls by the names that doctor lists, for example "sharpness=0,power_line_frequency=1".
    pub controls: String,
}

impl Default for CameraParams {
    fn default() -> Self {
        Self {
            formats: "mjpeg,yuyv,nv12,uyvy,rgb24,bgr24,grey,bayer".to_owned(),
            width: 640,
            height: 480,
            rate: 30.0,
            buffers: 4,
            exposure: 0.0,
            gain: -1,
            lock_focus: false,
            focus: -1,
            controls: String::new(),
        }
    }
}

/// Parameters `record.*`: topics, chunks and files of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RecordParams {
    /// Topics are NAMESPACE/image_raw, or NAMESPACE/image_raw/compressed, and NAMESPACE/camera_info.
    pub namespace: String,
    /// Frame of the headers: x right, y down, z forward.
    pub frame_id: String,
    /// A chunk is written to disk when it holds this much before compression.
    #[schemars(range(min = 16, max = 262144), extend("unit" = "KiB"))]
    pub chunk_kib: u64,
    /// A chunk is also written after this time, which a crash may lose.
    #[schemars(range(min = 0.05, max = 3600.0), extend("unit" = "s"))]
    pub chunk_secs: f64,
    /// Level of zstd; 0 = none.
    #[schemars(range(min = 0, max = 19))]
    pub compression_level: u32,
    /// A further file begins when one has this size; 0 = never.
    #[schemars(range(min = 0, max = 1048576), extend("unit" = "MiB"))]
    pub max_file_mib: u64,
    /// A further file also begins after this time; 0 = never.
    #[schemars(range(min = 0.0, max = 1e6), extend("unit" = "s"))]
    pub max_file_secs: f64,
    /// The oldest file is deleted when there are more; 0 keeps all.
    #[schemars(range(min = 0, max = 100000))]
    pub max_files: usize,
}

impl Default for RecordParams {
    fn default() -> Self {
        Self {
            namespace: "/camera".to_owned(),
            frame_id: "camera_optical".to_owned(),
            chunk_kib: 4096,
            chunk_secs: 1.0,
            compression_level: 1,
            max_file_mib: 0,
            max_file_secs: 0.0,
            max_files: 0,
        }
    }
}
