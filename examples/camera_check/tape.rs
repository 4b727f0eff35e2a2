//! A camera is recorded, and the recording is read back.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, ensure};

use crate::Check;
use crate::capture::{check_bars, hash, params};
use splat_image::pixel_format::{PixelFormat, YuvColour};
use splat_io::camera::driver::{Coding, Layout};
use splat_io::frame_source::Source;
use splat_io::recording::{Wanted, record};
use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;

pub(crate) const ALL: [(&str, Check); 2] = [
    (
        "a recording has every image, its stamp and the calibration",
        recorded,
    ),
    ("a live source gives frames until it is asked to end", live),
];

const CALIBRATION: &str = "image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [600, 0, 320, 0, 600, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
";

fn recorded(device: &Path, _: bool) -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let (yaml, bag) = (
        folder.path().join("camera.yaml"),
        folder.path().join("drive.mcap"),
    );
    std::fs::write(&yaml, CALIBRATION)?;
    let url = format!("source.camera_info_url=file://{}", yaml.display());
    let wanted = Wanted {
        out: bag.clone(),
        duration_secs: Some(3.0),
    };
    let settings = Settings::shipped().params()?;
    let from = params(&[&url, "source.camera.rate=15"])?;
    let (uri, asked) = (format!("v4l2:{}", device.display()), Arc::default());
    let input = open_source::open_input(&uri, &from, 0, wanted.duration_secs, &asked)?;
    let done = record(input, &wanted, &settings.record, &asked, &mut |_| {})?;
    println!("  {done:?}");
    ensure!(done.n_images + done.n_dropped >= 30, "{done:?}");
    let mut replay = open_source::open(&format!("mcap:{}", bag.display()), &params(&[])?, 0)?;
    let mut last = None;
    let mut n_frames = 0;
    while let Some(frame) = replay.next() {
        ensure!(last < Some(frame.stamp), "stamps do not increase");
        last = Some(frame.stamp);
        n_frames += 1;
        let intrinsics = frame.intrinsics.context("the calibration is missing")?;
        ensure!(
            (intrinsics.fx, intrinsics.cx) == (600.0, 320.5),
            "{intrinsics:?}"
        );
        if n_frames == 1 {
            let layout = Layout {
                width_px: 640,
                height_px: 480,
                coding: Coding::Raw(PixelFormat::Yuyv, YuvColour::default()),
                step: 0,
                rate_hz: None,
            };
            check_bars(&frame.image, &layout)?;
        }
    }
    ensure!(
        n_frames == done.n_images,
        "{n_frames} frames of {}",
        done.n_images
    );
    ensure!(replay.counts().fault.is_none(), "{:?}", replay.counts());
    let size = std::fs::metadata(&bag)?.len();
    println!("  {n_frames} frames read back from {size} bytes");
    Ok(())
}

fn live(device: &Path, _: bool) -> anyhow::Result<()> {
    let uri = format!("v4l2:{}", device.display());
    let mut camera = open_source::open(&uri, &params(&["source.max_frames=10"])?, 0)?;
    ensure!(camera.is_live());
    let mut seqs = Vec::new();
    while let Some(frame) = camera.next() {
        println!(
            "  frame {} {} {:016x}",
            frame.seq,
            frame.stamp,
            hash(&frame.image.pixels)
        );
        seqs.push(frame.seq);
    }
    ensure!(
        seqs.len() == 10 && seqs.windows(2).all(|s| s[0] < s[1]),
        "{seqs:?}"
    );
    let asked = Arc::new(std::sync::atomic::AtomicBool::new(true));
    let mut camera = reopened(camera, &uri)?;
    camera.end_when(&asked);
    ensure!(camera.next().is_none());
    Ok(())
}

fn reopened(camera: Box<dyn Source>, uri: &str) -> anyhow::Result<Box<dyn Source>> {
    drop(camera);
    Ok(open_source::open(uri, &params(&[])?, 0)?)
}
