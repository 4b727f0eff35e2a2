//! Everything that vivid can break, and what a source makes of it.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{bail, ensure};

use crate::Check;
use crate::capture::{open, params, take};
use splat_io::camera::live::{CameraStatusWatch, Live, Tally};
use splat_io::v4l2;
use splat_mapper::node::open_source;
use splat_types::time::Stopwatch;

/// Bars of the task: an error is said, silence is noticed, frames come again.
const SAID_WITHIN: f64 = 1.0;
const SILENCE_SAID_WITHIN: f64 = 3.0;
const BACK_WITHIN: f64 = 2.0;

pub(crate) const ALL: [(&str, Check); 8] = [
    ("an unplugged camera is said and comes back", unplug),
    ("a camera in use says so", busy),
    ("sizes change from one opening to the next", sizes),
    ("damaged images are left out and counted", damaged),
    ("skipped numbers are counted, also across the wrap", dropped),
    ("a fatal fault of the stream is overcome", fatal),
    ("a silent camera is said and comes back", silent),
    ("a name that is no camera says so", no_camera),
];

fn set(device: &Path, name: &str, value: i32) -> anyhow::Result<()> {
    Ok(v4l2::camera::set_control(device, name, value)?)
}

/// Waits until the camera says that it streams, or does not, and returns the seconds.
fn until(health: &CameraStatusWatch, is_streaming: bool, within: f64) -> anyhow::Result<f64> {
    let watch = Stopwatch::start();
    while health.get().is_streaming != is_streaming {
        if watch.secs() > within {
            bail!("{:?} after {within} s", health.get());
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(watch.secs())
}

/// Reads on another thread, as the source's thread does, while `disturb` runs.
fn while_reading<T>(
    mut live: Live,
    disturb: impl FnOnce(&CameraStatusWatch) -> anyhow::Result<T>,
) -> anyhow::Result<(T, Tally, u64)> {
    let asked = Arc::new(AtomicBool::new(false));
    live.end_when(&asked);
    let health = live.health();
    for _ in 0..3 {
        take(&mut live)?;
    }
    let reader = std::thread::Builder::new().spawn(move || {
        let mut n_images = 0_u64;
        while live.next(|_, _, _| ()).is_some() {
            n_images += 1;
        }
        (live.take_tally(), n_images)
    })?;
    let disturbed = disturb(&health);
    asked.store(true, Ordering::Relaxed);
    let Ok((tally, n_images)) = reader.join() else {
        bail!("the reading thread broke");
    };
    Ok((disturbed?, tally, n_images))
}

fn unplug(device: &Path, _: bool) -> anyhow::Result<()> {
    unplugged(open(device, &["source.camera.rate=15"])?, device)
}

/// The camera goes away while it is read, and comes back.
pub(crate) fn unplugged(live: Live, device: &Path) -> anyhow::Result<()> {
    let (_, tally, n_images) = while_reading(live, |health| {
        // vivid stays unplugged while someone holds it open.
        let holder = std::fs::File::open(device)?;
        set(device, "disconnect", 1)?;
        let said = until(health, false, SAID_WITHIN)?;
        println!("  said after {said:.3} s: {:?}", health.get().fault);
        std::thread::sleep(Duration::from_secs(2));
        ensure!(
            !health.get().is_streaming,
            "it cannot stream while it is unplugged"
        );
        drop(holder);
        let back = until(health, true, BACK_WITHIN)?;
        println!("  back {back:.3} s after its return");
        Ok(())
    })?;
    println!("  {n_images} images, {tally:?}");
    ensure!(tally.interruptions == 1, "{tally:?}");
    Ok(())
}

fn busy(device: &Path, _: bool) -> anyhow::Result<()> {
    let mut live = open(device, &[])?;
    take(&mut live)?;
    let uri = format!("v4l2:{}", device.display());
    let Err(error) = open_source::open(&uri, &params(&[])?, 0) else {
        bail!("a second stream was opened");
    };
    println!("  {error}");
    ensure!(
        error.to_string().contains("in use by another program"),
        "{error}"
    );
    // The first one is none the worse for it.
    take(&mut live)?;
    drop(live);
    open_source::open(&uri, &params(&[])?, 0)?;
    Ok(())
}

fn sizes(device: &Path, _: bool) -> anyhow::Result<()> {
    for (width, height) in [(320_u32, 180_u32), (1280, 720), (640, 480)] {
        let (w, h) = (
            format!("source.camera.width={width}"),
            format!("source.camera.height={height}"),
        );
        let mut live = open(device, &[&w, &h, "source.camera.rate=5"])?;
        let taken = take(&mut live)?;
        println!("  {:?}, {} bytes", taken.layout, taken.bytes.len());
        let found = (taken.layout.width_px, taken.layout.height_px);
        ensure!(
            found == (width, height),
            "{found:?}, expected {width}x{height}"
        );
    }
    Ok(())
}

fn damaged(device: &Path, _: bool) -> anyhow::Result<()> {
    let live = open(device, &["source.camera.rate=15"])?;
    let (_, tally, n_images) = while_reading(live, |health| {
        set(device, "inject_v4l2_buf_flag_error", 1)?;
        std::thread::sleep(Duration::from_secs(1));
        ensure!(health.get().is_streaming);
        Ok(())
    })?;
    println!("  {n_images} images, {tally:?}");
    ensure!(tally.damaged == 1 && n_images >= 5, "{tally:?}");
    Ok(())
}

fn dropped(device: &Path, _: bool) -> anyhow::Result<()> {
    set(device, "percentage_of_dropped_buffers", 50)?;
    let live = open(device, &["source.camera.rate=15"])?;
    let (_, tally, n_images) = while_reading(live, |_| {
        std::thread::sleep(Duration::from_secs(3));
        Ok(())
    })?;
    set(device, "percentage_of_dropped_buffers", 0)?;
    println!("  {n_images} images, {tally:?}");
    let share = tally.missed as f64 / (tally.missed + n_images) as f64;
    ensure!(
        (0.25..0.75).contains(&share),
        "{share} missed, expected half"
    );

    set(device, "wrap_sequence_number", 1)?;
    let small = [
        "source.camera.width=320",
        "source.camera.height=180",
        "source.camera.rate=60",
    ];
    let live = open(device, &small)?;
    let (_, tally, n_images) = while_reading(live, |_| {
        std::thread::sleep(Duration::from_secs(4));
        Ok(())
    })?;
    set(device, "wrap_sequence_number", 0)?;
    println!("  across the wrap: {n_images} images, {tally:?}");
    // Numbers begin 128 before the wrap; a jump would count for thousands of millions.
    ensure!(n_images + tally.missed > 130, "the wrap was not reached");
    ensure!(tally.missed < n_images, "{tally:?}");
    Ok(())
}

fn fatal(device: &Path, _: bool) -> anyhow::Result<()> {
    let live = open(device, &["source.camera.rate=15"])?;
    let (_, tally, n_images) = while_reading(live, |health| {
        set(device, "inject_fatal_streaming_error", 1)?;
        let said = until(health, false, SAID_WITHIN)?;
        println!("  said after {said:.3} s: {:?}", health.get().fault);
        let back = until(health, true, BACK_WITHIN)?;
        println!("  back after {back:.3} s");
        std::thread::sleep(Duration::from_millis(500));
        Ok(())
    })?;
    println!("  {n_images} images, {tally:?}");
    ensure!(tally.interruptions == 1, "{tally:?}");
    Ok(())
}

fn silent(device: &Path, _: bool) -> anyhow::Result<()> {
    let live = open(device, &["source.camera.rate=15"])?;
    let (_, tally, _) = while_reading(live, |health| {
        // All images lost: the camera is there and sends nothing.
        set(device, "percentage_of_dropped_buffers", 100)?;
        let said = until(health, false, SILENCE_SAID_WITHIN)?;
        println!("  said after {said:.3} s: {:?}", health.get().fault);
        set(device, "percentage_of_dropped_buffers", 0)?;
        let back = until(health, true, BACK_WITHIN)?;
        println!("  back after {back:.3} s");
        Ok(())
    })?;
    ensure!(tally.interruptions == 1, "{tally:?}");
    Ok(())
}

fn no_camera(_: &Path, _: bool) -> anyhow::Result<()> {
    for (uri, expected) in [
        ("v4l2:/dev/video77", "no camera is there"),
        ("v4l2:/dev/null", "not a camera"),
        ("v4l2:/tmp", "cannot open the camera"),
    ] {
        let Err(error) = open_source::open(uri, &params(&[])?, 0) else {
            bail!("{uri} was opened");
        };
        println!("  {error}");
        ensure!(error.to_string().contains(expected), "{uri}: {error}");
    }
    Ok(())
}
