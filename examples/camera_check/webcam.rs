//! The same cameras through nokhwa, which knows less of them.

use std::path::Path;

use anyhow::{Context, bail, ensure};

use crate::Check;
use crate::capture::{check_images, params};
use crate::faults::unplugged;
use splat_io::camera::live::Live;
use splat_io::v4l2;
use splat_io::webcam;

/// nokhwa 0.1.4 for Linux does not know the kernel's name of grey images.
const FORMATS: [&str; 4] = ["yuyv", "nv12", "rgb24", "bgr24"];

pub(crate) const ALL: [(&str, Check); 3] = [
    ("a webcam gives its images in each format", each_format),
    ("an unplugged webcam is said and comes back", unplug),
    ("a webcam that is not there says so", no_webcam),
];

fn open(index: &str, settings: &[&str]) -> anyhow::Result<Live> {
    let opener = webcam::opener(index, &params(settings)?)?;
    Ok(Live::open(format!("webcam:{index}"), opener)?)
}

/// Of the first camera, as `device` is.
fn each_format(_: &Path, is_vivid: bool) -> anyhow::Result<()> {
    for name in FORMATS {
        let wanted = format!("source.camera.formats={name}");
        open("0", &[&wanted, "source.camera.rate=15"])
            .and_then(|live| check_images(live, name, is_vivid))
            .with_context(|| name.to_owned())?;
    }
    Ok(())
}

fn unplug(device: &Path, _: bool) -> anyhow::Result<()> {
    unplugged(open("0", &["source.camera.rate=15"])?, device)
}

fn no_webcam(_: &Path, _: bool) -> anyhow::Result<()> {
    match open("7", &[]) {
        Ok(_) => bail!("there is no eighth camera"),
        Err(error) => println!("  {error:#}"),
    }
    ensure!(
        !v4l2::list::list().is_empty(),
        "the cameras that are there stay listed"
    );
    Ok(())
}
