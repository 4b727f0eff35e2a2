//! Takes -> recordings: an MCAP file of ROS 2 messages with images, calibration, exact poses and depth.
//!
//! The file appears under its name only when it is whole. Depth has the pixels of the image as filmed, distortion
//! included, at a fifth of its size, as the drivers of depth cameras register it.

use std::fmt::Write as _;
use std::fs;
use std::io::{Seek, Write};
use std::path::Path;

use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

use crate::imu::{self, ImuTake};
use crate::odometry;
use crate::settings::{SynthError, SynthSettings};
use crate::take::Take;
use splat_io::bag_writer::{BagWriter, Topic, camera_info, options};
use splat_io::whole_file::write_file;
use splat_msgs::ros::imu::Imu;
use splat_msgs::ros::odometry::Odometry;
use splat_msgs::ros::{
    CameraInfo, CompressedImage, Header, Image, Pose, PoseStamped, TfMessage, TransformStamped,
};
use splat_types::camera::CameraModel;
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

const WORLD: &str = "map";
const CAMERA: &str = "camera_optical";
const BASE: &str = "base_link";
const ODOM: &str = "odom";
const IMU: &str = "imu_link";

/// Depth images have one pixel for so many of the colour image, along each side.
const DEPTH_DIVISOR: u32 = 5;

/// What a recording came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SynthSummary {
    pub n_frames: u32,
    pub n_messages: u64,
    pub bytes: u64,
}

/// Films everything into `out`, and the poses into a TUM file of the same name beside it.
pub fn write_recording(settings: &SynthSettings, out: &Path) -> Result<SynthSummary, SynthError> {
    write_recording_with(settings, out, |_| {})
}

/// The same; `on_frame` receives the number of frames done after each one.
pub fn write_recording_with(
    settings: &SynthSettings,
    out: &Path,
    mut on_frame: impl FnMut(u32),
) -> Result<SynthSummary, SynthError> {
    let take = Take::new(settings.clone())?;
    let failed = |what: &'static str, path: &Path| {
        let path = path.to_owned();
        move |e: std::io::Error| SynthError::Write {
            what,
            reason: e.to_string(),
            path,
        }
    };
    let mut n_messages = 0;
    write_file(out, |file| {
        n_messages = record(&take, file, &mut on_frame).map_err(std::io::Error::other)?;
        Ok(())
    })
    .map_err(failed("write", out))?;
    let tum = out.with_extension("tum");
    fs::write(&tum, tum_lines(&take)).map_err(failed("write the poses beside", &tum))?;
    let bytes = fs::metadata(out).map_err(failed("read back", out))?.len();
    Ok(SynthSummary {
        n_frames: settings.n_frames,
        n_messages,
        bytes,
    })
}

/// The exact trajectory as TUM lines, camera to world: `stamp tx ty tz qx qy qz qw`.
pub fn truth_tum(settings: &SynthSettings) -> Result<String, SynthError> {
    Ok(tum_lines(&Take::new(settings.clone())?))
}

fn tum_lines(take: &Take) -> String {
    let mut lines = String::from(
        "# timestamp tx ty tz qx qy qz qw (camera to world; x right, y down, z forward)\n",
    );
    for ix in 0..take.settings().n_frames {
        let pose = take.pose(ix);
        let (t, q) = (pose.translation, pose.rotation);
        let stamp = take.stamp(ix);
        writeln!(
            lines,
            "{stamp} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}",
            t.x, t.y, t.z, q.x, q.y, q.z, q.w
        )
        .expect("a String takes everything");
    }
    lines
}

fn record(
    take: &Take,
    file: impl Write + Seek,
    on_frame: &mut impl FnMut(u32),
) -> Result<u64, String> {
    // Only depth can be squeezed here, JPEG cannot: a high level costs little time.
    let mut out = BagWriter::new(options(12), file)?;
    let mut images = out.topic::<CompressedImage>("/camera/image_raw/compressed")?;
    let mut calibration = out.topic::<CameraInfo>("/camera/camera_info")?;
    let mut tf = out.topic::<TfMessage>("/tf")?;
    let mut wheels = Wheels::new(take, &mut out)?;
    let mut inertial = Inertial::new(take, &mut out)?;
    let mut poses = out.topic::<PoseStamped>("/ground_truth/pose")?;
    let mut depths = if take.settings().depth {
        Some(out.topic::<Image>("/camera/depth")?)
    } else {
        None
    };
    let lens = take.settings().lens();
    for ix in 0..take.settings().n_frames {
        let stamp = take.stamp(ix);
        let nanos = u64::try_from(stamp.nanos)
            .map_err(|e| format!("stamp {stamp} lies before the epoch: {e}"))?;
        let header = |frame_id: &str| Header {
            stamp: stamp.into(),
            frame_id: frame_id.to_owned(),
        };
        let pose = take.pose(ix).into();
        out.write(&mut calibration, nanos, &camera_info(&lens, header(CAMERA)))?;
        if let Some(wheels) = &mut wheels {
            wheels.write(&mut out, ix, nanos, header(ODOM))?;
        } else {
            // A frame has one parent: with wheels it is the base.
            let message = transform(header(WORLD), CAMERA, pose);
            out.write(&mut tf, nanos, &message)?;
        }
        if let Some(inertial) = &mut inertial {
            inertial.write(&mut out, ix)?;
        }
        out.write(
            &mut poses,
            nanos,
            &PoseStamped {
                header: header(WORLD),
                pose,
            },
        )?;
        if let Some(depths) = &mut depths {
            out.write(
                depths,
                nanos,
                &depth_image(&small_depth(take, ix, &lens), header(CAMERA)),
            )?;
        }
        let image = CompressedImage {
            header: header(CAMERA),
            format: "jpeg".to_owned(),
            data: jpeg(take, ix)?,
        };
        out.write(&mut images, nanos, &image)?;
        on_frame(ix + 1);
    }
    let n_messages = out.n_messages;
    out.finish()?;
    Ok(n_messages)
}

/// Samples of the IMU on their way into a file.
struct Inertial<'a> {
    take: &'a Take,
    samples: ImuTake<'a>,
    imu: Topic,
    mounted: Topic,
}

impl<'a> Inertial<'a> {
    fn new<W: Write + Seek>(
        take: &'a Take,
        out: &mut BagWriter<W>,
    ) -> Result<Option<Self>, String> {
        let Some(samples) = ImuTake::new(take) else {
            return Ok(None);
        };
        Ok(Some(Self {
            take,
            samples,
            imu: out.topic::<Imu>("/imu/data_raw")?,
            mounted: out.topic::<TfMessage>("/tf_static")?,
        }))
    }

    fn write<W: Write + Seek>(&mut self, out: &mut BagWriter<W>, ix: u32) -> Result<(), String> {
        if ix == 0 {
            let stamp = self.take.stamp(0);
            let header = Header {
                stamp: stamp.into(),
                frame_id: CAMERA.to_owned(),
            };
            let message = transform(header, IMU, imu::cam_from_imu().into());
            out.write(&mut self.mounted, stamp.nanos.unsigned_abs(), &message)?;
        }
        for sample in self.samples.until(self.take.stamp(ix)) {
            let mut message = Imu {
                angular_velocity: sample.angular_velocity.into(),
                linear_acceleration: sample.acceleration.into(),
                ..Imu::default()
            };
            message.header.stamp = sample.stamp.into();
            message.header.frame_id = IMU.to_owned();
            // It measures no orientation.
            message.orientation_covariance[0] = -1.0;
            out.write(&mut self.imu, sample.stamp.nanos.unsigned_abs(), &message)?;
        }
        Ok(())
    }
}

/// Odometry on its way into a file.
struct Wheels {
    track: Vec<Rigid>,
    odometry: Topic,
    mounted: Topic,
}

impl Wheels {
    fn new<W: Write + Seek>(take: &Take, out: &mut BagWriter<W>) -> Result<Option<Self>, String> {
        let Some(noise) = take.settings().odometry else {
            return Ok(None);
        };
        Ok(Some(Self {
            track: odometry::track(take, noise),
            odometry: out.topic::<Odometry>("/odom")?,
            mounted: out.topic::<TfMessage>("/tf_static")?,
        }))
    }

    fn write<W: Write + Seek>(
        &mut self,
        out: &mut BagWriter<W>,
        ix: u32,
        nanos: u64,
        header: Header,
    ) -> Result<(), String> {
        if ix == 0 {
            let base = Header {
                frame_id: BASE.to_owned(),
                ..header.clone()
            };
            let message = transform(base, CAMERA, odometry::base_from_cam().into());
            out.write(&mut self.mounted, nanos, &message)?;
        }
        let mut message = Odometry {
            header,
            child_frame_id: BASE.to_owned(),
            ..Odometry::default()
        };
        message.pose.pose = self.track[ix as usize].into();
        out.write(&mut self.odometry, nanos, &message)
    }
}

fn transform(header: Header, child: &str, transform: Pose) -> TfMessage {
    TfMessage {
        transforms: vec![TransformStamped {
            header,
            child_frame_id: child.to_owned(),
            transform,
        }],
    }
}

fn jpeg(take: &Take, ix: u32) -> Result<Vec<u8>, String> {
    let image = take.image(ix);
    let mut data = Vec::new();
    JpegEncoder::new_with_quality(&mut data, take.settings().jpeg_quality)
        .encode(
            &image.pixels,
            image.width_px,
            image.height_px,
            ExtendedColorType::Rgb8,
        )
        .map_err(|e| e.to_string())?;
    Ok(data)
}

fn small_depth(take: &Take, ix: u32, lens: &CameraModel) -> DepthMap {
    let (width, height) = (lens.intrinsics.width_px, lens.intrinsics.height_px);
    let intrinsics = lens.intrinsics.resized(
        width.div_ceil(DEPTH_DIVISOR),
        height.div_ceil(DEPTH_DIVISOR),
    );
    take.depth_through(
        ix,
        &CameraModel {
            intrinsics,
            distortion: lens.distortion,
        },
    )
}

/// Millimetres in 16 bits, as depth cameras send them; 0 where nothing is, or nothing within 65 m.
fn depth_image(map: &DepthMap, header: Header) -> Image {
    let millimetres = |depth: &f32| {
        let value = (1000.0 * depth).round();
        if value <= 65_535.0 { value as u16 } else { 0 }
    };
    Image {
        header,
        height: map.height_px,
        width: map.width_px,
        encoding: "16UC1".to_owned(),
        is_bigendian: 0,
        step: 2 * map.width_px,
        data: map
            .depth
            .iter()
            .flat_map(|depth| millimetres(depth).to_le_bytes())
            .collect(),
    }
}
