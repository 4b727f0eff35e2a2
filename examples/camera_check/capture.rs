//! Images of every format: their number, size, order, time and colours.

use std::path::Path;

use anyhow::{Context, ensure};

use splat_image::jpeg::decoder::Jpeg;
use splat_image::limits::empty;
use splat_image::pixel_format::PixelFormat;
use splat_io::camera::driver::{Coding, Layout, decode};
use splat_io::camera::live::Live;
use splat_io::params::SourceParams;
use splat_io::v4l2;
use splat_mapper::doctor::checks;
use splat_mapper::params::settings::Settings;
use splat_types::image::RgbImage;
use splat_types::time::{Stamp, Stopwatch};

/// Images taken in each format.
const N_IMAGES: usize = 12;
/// A machine that is emulated beside other work may run late by so much.
const MAX_RATE_ERROR: f64 = 0.25;
/// Grey levels between a bar and what it must be: YUV has 8 bits and half the columns.
const MAX_COLOUR_ERROR: u8 = 12;
/// vivid's first test pattern, bars of 75 % from left to right.
const BARS: [[u8; 3]; 8] = [
    [191, 191, 191],
    [191, 191, 0],
    [0, 191, 191],
    [0, 191, 0],
    [191, 0, 191],
    [191, 0, 0],
    [0, 0, 191],
    [0, 0, 0],
];

/// An image as it came.
pub(crate) struct Taken {
    pub layout: Layout,
    pub stamp: Stamp,
    pub arrived: Stamp,
    pub bytes: Vec<u8>,
}

pub(crate) fn params(settings: &[&str]) -> anyhow::Result<SourceParams> {
    let mut all = Settings::shipped();
    for setting in settings {
        all.merge_setting(setting)?;
    }
    Ok(all.params()?.source)
}

pub(crate) fn open(device: &Path, settings: &[&str]) -> anyhow::Result<Live> {
    let opener = v4l2::camera::opener(device, &params(settings)?);
    Ok(Live::open(device.display().to_string(), opener)?)
}

pub(crate) fn take(live: &mut Live) -> anyhow::Result<Taken> {
    let taken = live.next(|layout, stamp, bytes| Taken {
        layout: *layout,
        stamp,
        arrived: Stamp::now(),
        bytes: bytes.to_vec(),
    });
    taken.context("the camera ended")
}

pub(crate) fn listing(device: &Path, is_vivid: bool) -> anyhow::Result<()> {
    let checks = checks::doctor();
    let camera: Vec<_> = checks.into_iter().filter(|c| c.name == "camera").collect();
    println!("{}", checks::format_checks(&camera));
    let cameras = v4l2::list::list();
    let found = cameras.into_iter().find(|(path, _)| path == device);
    let found = found.context("the camera is not listed")?.1?;
    if is_vivid {
        let has = |name: &str, width: u32, rate: u32| {
            found.offers.iter().any(|offer| {
                offer.format.name == name
                    && offer.width_px == width
                    && offer.intervals.contains(&(1, rate))
            })
        };
        ensure!(has("yuyv", 640, 15) && has("nv12", 320, 60) && has("grey", 1280, 10));
        ensure!(found.controls.iter().any(|c| c.starts_with("disconnect=")));
    }
    Ok(())
}

pub(crate) fn each_format(device: &Path, is_vivid: bool) -> anyhow::Result<()> {
    let (_, found) = v4l2::list::list()
        .into_iter()
        .find(|(path, _)| path == device)
        .context("the camera is not listed")?;
    let mut names: Vec<&str> = found?
        .offers
        .iter()
        .map(|offer| offer.format.name)
        .collect();
    names.dedup();
    for name in names {
        let wanted = format!("source.camera.formats={name}");
        open(device, &[&wanted, "source.camera.rate=15"])
            .and_then(|live| check_images(live, name, is_vivid))
            .with_context(|| name.to_owned())?;
    }
    Ok(())
}

/// Images are of the right number, size, order and age, and differ.
pub(crate) fn check_images(mut live: Live, name: &str, is_vivid: bool) -> anyhow::Result<()> {
    let layout = live.layout();
    let mut images = Vec::new();
    let mut jpeg = Jpeg::default();
    let mut image = empty();
    let mut decode_ms = Vec::new();
    let started = Stamp::now();
    for _ in 0..N_IMAGES {
        let taken = take(&mut live)?;
        let watch = Stopwatch::start();
        decode(&taken.layout, &taken.bytes, &mut jpeg, &mut image)?;
        decode_ms.push(watch.secs() * 1e3);
        images.push(taken);
    }
    let hashes: Vec<u64> = images.iter().map(|p| hash(&p.bytes)).collect();
    for (taken, hash) in images.iter().zip(&hashes) {
        let (stamp, late) = (taken.stamp, taken.arrived.secs_since(taken.stamp) * 1e3);
        println!(
            "  {name} {stamp} {hash:016x} {} bytes, {late:.1} ms old",
            taken.bytes.len()
        );
    }
    decode_ms.sort_by(f64::total_cmp);
    let missed = live.take_tally().missed;
    println!(
        "  {name} {layout:?}: {missed} missed, decoded in {:.2} ms",
        decode_ms[N_IMAGES / 2]
    );
    if let Coding::Raw(format, _) = layout.coding {
        let step = layout.step.max(format.row_bytes(layout.width_px));
        let n_bytes = (step * format.n_rows(layout.height_px)) as usize;
        ensure!(
            images.iter().all(|p| p.bytes.len() == n_bytes),
            "sizes are not {n_bytes}"
        );
    }
    ensure!(
        images.windows(2).all(|p| p[0].stamp < p[1].stamp),
        "stamps do not increase"
    );
    ensure!(
        images.iter().all(|p| p.stamp <= p.arrived),
        "a stamp lies in the future"
    );
    let oldest = started.secs_since(images[0].stamp);
    ensure!(
        oldest < 1.0,
        "the first stamp is {oldest} s before the start"
    );
    let n_distinct = hashes
        .iter()
        .collect::<std::collections::BTreeSet<_>>()
        .len();
    ensure!(n_distinct == N_IMAGES, "{n_distinct} distinct images");
    if let Some(rate) = layout.rate_hz {
        // Missed ones took their time too.
        let secs = images[N_IMAGES - 1].stamp.secs_since(images[0].stamp);
        let found = (N_IMAGES as f64 - 1.0 + missed as f64) / secs;
        ensure!(
            (found / rate - 1.0).abs() < MAX_RATE_ERROR,
            "{found} Hz, expected {rate}"
        );
    }
    if is_vivid {
        ensure!(
            (layout.width_px, layout.height_px) == (640, 480),
            "{layout:?}"
        );
        check_bars(&image, &layout)?;
    }
    Ok(())
}

/// The colour bars, low in the image where no text lies above them.
pub(crate) fn check_bars(image: &RgbImage, layout: &Layout) -> anyhow::Result<()> {
    let is_grey = matches!(layout.coding, Coding::Raw(PixelFormat::Grey, _));
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let seen = |ix: usize| {
        let (x, y) = ((2 * ix + 1) * width / 16, height * 3 / 4);
        let at = (y * width + x) * 3;
        [0, 1, 2].map(|channel| image.pixels[at + channel])
    };
    for (ix, bar) in BARS.iter().enumerate() {
        let found = seen(ix);
        // How vivid weighs colours for grey is its own; the bars are in order of their luma.
        let is_right = if is_grey {
            found[0] == found[2] && (ix == 0 || found[0] < seen(ix - 1)[0])
        } else {
            let off = |(f, e): (&u8, &u8)| f.abs_diff(*e) <= MAX_COLOUR_ERROR;
            found.iter().zip(bar).all(off)
        };
        ensure!(is_right, "bar {ix} is {found:?}, expected {bar:?}");
    }
    println!("  the eight bars have their colours");
    Ok(())
}

/// FNV-1a, for the log.
pub(crate) fn hash(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
    })
}
