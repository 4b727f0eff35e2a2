//! Takes -> folders of images and poses in the layouts that other programs write: what `images:DIR` and `eval --reference` read.

use std::fs;
use std::path::Path;

use glam::DVec2;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _};

use crate::movers;
use crate::noise::hash;
use crate::settings::{SynthError, SynthSettings};
use crate::take::Take;
use splat_io::scene_formats::written::{self, WrittenView};
use splat_types::camera::Distortion;
use splat_types::image::RgbImage;
use splat_types::sparse_point::SparsePoint;

/// Of so many images one is held out where a layout says which.
const HOLDOUT: u32 = 8;
/// Points of a COLMAP scene that each image gives.
const POINTS_PER_IMAGE: u32 = 50;
/// Depth for them has one pixel for so many of the image, along each side.
const POINTS_DIVISOR: u32 = 8;

/// How a scene lies on the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FolderLayout {
    /// `images/`, and `cameras.txt`, `images.txt` and `points3D.txt` in `sparse/0`.
    Colmap,
    /// `images/` and `transforms.json`; every eighth image is in `test_filenames`.
    Nerfstudio,
    /// `train/` and `test/`, every eighth image, as PNG, and a `transforms_*.json` of each.
    Blender,
    /// COLMAP's, with names of images that say whether things that move are in them: `clutter*` and `extra*` (RobustNeRF).
    RobustNerf,
}

impl FolderLayout {
    /// By the name that a user gives.
    pub const NAMES: [(&'static str, Self); 4] = [
        ("colmap", Self::Colmap),
        ("nerfstudio", Self::Nerfstudio),
        ("blender", Self::Blender),
        ("robustnerf", Self::RobustNerf),
    ];

    /// As the scene names image `ix`, and where its file lies.
    fn names_of(self, ix: u32) -> (String, String) {
        let name = match self {
            Self::Colmap => format!("frame_{ix:05}.jpg"),
            Self::Nerfstudio => format!("images/frame_{ix:05}.jpg"),
            Self::Blender if is_held_out(ix) => format!("./test/r_{ix:03}"),
            Self::Blender => format!("./train/r_{ix:03}"),
            Self::RobustNerf if movers::is_clean(ix) => format!("extra{ix:03}.jpg"),
            Self::RobustNerf => format!("clutter{ix:03}.jpg"),
        };
        let file = match self {
            Self::Colmap | Self::RobustNerf => format!("images/{name}"),
            Self::Nerfstudio => name.clone(),
            Self::Blender => format!("{name}.png"),
        };
        (name, file)
    }
}

/// Films everything into `out`, a folder that is new or empty; `on_frame` receives the number of frames done after each one.
pub fn write_folder(
    settings: &SynthSettings,
    layout: FolderLayout,
    out: &Path,
    mut on_frame: impl FnMut(u32),
) -> Result<(), SynthError> {
    let take = Take::new(settings.clone())?;
    let lens = settings.lens();
    if layout == FolderLayout::Blender && lens.distortion != Distortion::None {
        return Err(SynthError::Value {
            key: "lens",
            found: "a distorted one".to_owned(),
            expected: "pinhole: Blender's layout has one angle of view and no distortion",
        });
    }
    let failed = |e: std::io::Error| write_error(e.to_string(), out);
    fs::create_dir_all(out).map_err(failed)?;
    if fs::read_dir(out).map_err(failed)?.next().is_some() {
        let reason = "the folder is not empty; name another one".to_owned();
        return Err(write_error(reason, out));
    }
    let mut views = Vec::new();
    let mut points = Vec::new();
    for ix in 0..settings.n_frames {
        let (name, file) = layout.names_of(ix);
        let image = take.image(ix);
        let has_movers = settings.movers > 0 && !movers::is_clean(ix);
        if layout != FolderLayout::Blender && !has_movers {
            points.extend(points_of(&take, ix, &image));
        }
        let bytes = encoded(&image, layout, settings.jpeg_quality);
        write(&out.join(file), &bytes.map_err(failed)?)?;
        views.push(WrittenView {
            name,
            world_from_cam: take.pose(ix),
            lens,
            is_held_out: is_held_out(ix),
        });
        on_frame(ix + 1);
    }
    let files = match layout {
        FolderLayout::Colmap | FolderLayout::RobustNerf => written::colmap(&views, &points),
        FolderLayout::Nerfstudio => written::nerfstudio(&views, &points),
        FolderLayout::Blender => written::blender(&views).unwrap_or_default(),
    };
    for (name, text) in files {
        write(&out.join(name), text.as_bytes())?;
    }
    Ok(())
}

fn write_error(reason: String, path: &Path) -> SynthError {
    SynthError::Write {
        what: "write",
        reason,
        path: path.to_owned(),
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), SynthError> {
    let folder = path.parent().unwrap_or(path);
    let written = fs::create_dir_all(folder).and_then(|()| fs::write(path, bytes));
    written.map_err(|e| write_error(e.to_string(), path))
}

fn is_held_out(ix: u32) -> bool {
    ix % HOLDOUT == HOLDOUT / 2
}

fn encoded(image: &RgbImage, layout: FolderLayout, quality: u8) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let (width, height) = (image.width_px, image.height_px);
    let (pixels, colour) = (&image.pixels, ExtendedColorType::Rgb8);
    let done = match layout {
        FolderLayout::Blender => {
            let png = (CompressionType::Fast, FilterType::Sub);
            PngEncoder::new_with_quality(&mut bytes, png.0, png.1)
                .write_image(pixels, width, height, colour)
        }
        _ => {
            JpegEncoder::new_with_quality(&mut bytes, quality).encode(pixels, width, height, colour)
        }
    };
    done.map_err(std::io::Error::other)?;
    Ok(bytes)
}

/// Points on surfaces at random pixels of image `ix`, with the colour there.
fn points_of(take: &Take, ix: u32, image: &RgbImage) -> Vec<(SparsePoint, usize)> {
    let (width, height) = (image.width_px, image.height_px);
    let small = take.settings().lens().resized(
        (width / POINTS_DIVISOR).max(1),
        (height / POINTS_DIVISOR).max(1),
    );
    let depth = take.depth_through(ix, &small);
    let point = |k: u32| {
        let at = hash(ix * POINTS_PER_IMAGE + k) % depth.depth.len() as u32;
        let (x, y) = (at % depth.width_px, at / depth.width_px);
        let z = f64::from(depth.depth[at as usize]);
        let ray = small.ray_in_cam(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5))?;
        let across = |at: u32, small: u32, whole: u32| (2 * at + 1) * whole / (2 * small);
        let shown = across(y, depth.height_px, height) * width + across(x, depth.width_px, width);
        let found = SparsePoint {
            position_in_gt: take.pose(ix).transform_point(ray * z),
            rgb: [0, 1, 2].map(|c| image.pixels[3 * shown as usize + c]),
            error_px: 0.5,
            n_images: 1,
        };
        (z > 0.0).then_some((found, ix as usize))
    };
    (0..POINTS_PER_IMAGE).filter_map(point).collect()
}
