//! Scenes with poses as other programs leave them, a COLMAP model or a transforms.json -> views in order of names.
//!
//! Poses are `world_from_cam` with OpenCV axes. A view whose image is missing stays in the list: it has its place in
//! the order, from which stamps are generated, and in the reference of `eval`.

use std::path::{Path, PathBuf};

use crate::error::SourceError;
use crate::ground_truth::stamp_of_decimal;
use crate::scene_formats::{colmap, colmap_points, image_files, transforms};
use crate::small_file::natural_order;
use splat_types::camera::CameraModel;
use splat_types::sparse_point::SparsePoint;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Gap between stamps where the names of the images are no times.
pub const DEFAULT_GAP_NANOS: i64 = 100_000_000;
/// Whole digits from which on a number is seconds since 1970, and nanoseconds since 1970.
const SECOND_DIGITS: usize = 9;
const NANO_DIGITS: usize = 16;
/// An image of a scene.
#[derive(Debug, Clone)]
pub struct SceneView {
    /// As the scene spells it, relative to its folder of images.
    pub name: String,
    pub stamp: Stamp,
    pub gt_from_cam: Rigid,
    /// Of the image at its full size; `None` where the scene says too little.
    pub lens: Option<CameraModel>,
    /// Where the image is or should be.
    pub image: PathBuf,
    /// 16-bit PNG, millimetres.
    pub depth: Option<PathBuf>,
    /// The scene itself says that it is for measuring quality.
    pub is_held_out: bool,
}

/// Where a scene lies and in which format.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Layout {
    /// `cameras`, `images` and perhaps `points3D`, binary or text, in `model`.
    Colmap { root: PathBuf, model: PathBuf },
    /// Files of training views, and of views for measuring.
    Transforms {
        root: PathBuf,
        train: PathBuf,
        held_out: Option<PathBuf>,
    },
}

impl Layout {
    /// The scene that a folder or a transforms.json is; `None`: neither.
    pub fn find(path: &Path) -> Option<Self> {
        if path.is_file() {
            let is_json = path
                .extension()
                .is_some_and(|e| e.eq_ignore_ascii_case("json"));
            let root = path.parent().unwrap_or(Path::new("")).to_owned();
            let train = path.to_owned();
            return is_json.then_some(Self::Transforms {
                root,
                train,
                held_out: None,
            });
        }
        Self::transforms(path).or_else(|| Self::colmap(path))
    }

    fn transforms(folder: &Path) -> Option<Self> {
        let existing = |name: &str| Some(folder.join(name)).filter(|path| path.is_file());
        let (train, held_out) = match existing("transforms.json") {
            Some(all) => (all, None),
            None => (
                existing("transforms_train.json")?,
                existing("transforms_test.json"),
            ),
        };
        Some(Self::Transforms {
            root: folder.to_owned(),
            train,
            held_out,
        })
    }

    fn colmap(folder: &Path) -> Option<Self> {
        let is_model = |model: &PathBuf| {
            let has = |name: &str| {
                ["bin", "txt"]
                    .iter()
                    .any(|e| model.join(name).with_extension(e).is_file())
            };
            has("cameras") && has("images")
        };
        let places = ["sparse/0", "sparse", "colmap/sparse/0", ""];
        let model = places
            .iter()
            .map(|place| folder.join(place))
            .find(is_model)?;
        Some(Self::Colmap {
            root: image_files::root_of(folder),
            model,
        })
    }

    /// The views in natural order of their names. Of folders with the same images at several sizes, the one with the
    /// smallest that are no smaller than `max_side_px` is taken.
    pub fn views(&self, max_side_px: u32) -> Result<Vec<SceneView>, SourceError> {
        let (root, mut listed) = match self {
            Self::Colmap { root, model } => (root, colmap::read(model)?),
            Self::Transforms {
                root,
                train,
                held_out,
            } => {
                let mut listed = transforms::read(train, root, false)?;
                if let Some(file) = held_out {
                    listed.extend(transforms::read(file, root, true)?);
                }
                (root, listed)
            }
        };
        listed.sort_by(|a, b| natural_order(&a.name, &b.name));
        listed.dedup_by(|a, b| a.name == b.name);
        let names: Vec<&str> = listed.iter().map(|view| view.name.as_str()).collect();
        let stamps = stamps_of(&names);
        let images = image_files::Images::find(root, &names, max_side_px);
        let views = listed
            .into_iter()
            .zip(stamps)
            .map(|(view, stamp)| SceneView {
                stamp,
                gt_from_cam: view.gt_from_cam,
                lens: view.lens,
                image: images.path_of(&view.name),
                depth: view.depth.and_then(|name| image_files::inside(root, &name)),
                is_held_out: view.is_held_out,
                name: view.name,
            });
        Ok(views.collect())
    }

    /// The sparse points in the frame of the poses; empty where the scene has none.
    pub fn points(&self) -> Result<Vec<SparsePoint>, SourceError> {
        match self {
            Self::Colmap { model, .. } => colmap_points::read(model),
            Self::Transforms { root, train, .. } => transforms::points(train, root),
        }
    }
}

/// Whether the file name of a view begins with one of the beginnings, which commas part.
pub fn is_named(name: &str, beginnings: &str) -> bool {
    let file = name.rsplit('/').next().unwrap_or(name);
    let mut beginnings = beginnings
        .split(',')
        .map(str::trim)
        .filter(|b| !b.is_empty());
    beginnings.any(|b| file.starts_with(b) || name.starts_with(b))
}

/// Stamps for names in order: the times that they are, where all of them are, else 0.1 s apart.
fn stamps_of(names: &[&str]) -> Vec<Stamp> {
    let given: Option<Vec<Stamp>> = names.iter().map(|name| stamp_of_name(name)).collect();
    let default_stamps = || {
        let nth = |ix| Stamp::from_nanos(ix * DEFAULT_GAP_NANOS);
        (0..names.len() as i64).map(nth).collect()
    };
    given
        .filter(|stamps| stamps.is_sorted_by(|a, b| a < b))
        .unwrap_or_else(default_stamps)
}

/// `1305031102.175304.png`, `1403715273262142976.png`; frame numbers are no times.
fn stamp_of_name(name: &str) -> Option<Stamp> {
    let stem = Path::new(name).file_stem()?.to_str()?;
    let whole = stem.split('.').next().unwrap_or_default();
    if !whole.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    match whole.len() {
        n if n >= NANO_DIGITS => stem.parse().ok().map(Stamp::from_nanos),
        n if n >= SECOND_DIGITS => stamp_of_decimal(stem),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_stamps_only_where_all_of_them_are_times() {
        let nanos =
            |names: &[&str]| -> Vec<i64> { stamps_of(names).iter().map(|s| s.nanos).collect() };
        assert_eq!(
            nanos(&["rgb/1305031102.175304.png", "rgb/1305031102.211214.png"]),
            [1_305_031_102_175_304_000, 1_305_031_102_211_214_000]
        );
        assert_eq!(
            nanos(&["1403715273262142976.png"]),
            [1_403_715_273_262_142_976]
        );
        assert_eq!(nanos(&["0001.jpg", "0002.jpg"]), [0, 100_000_000]);
        assert_eq!(nanos(&["1305031102.1.png", "a.png"]), [0, 100_000_000]);
        assert_eq!(nanos(&["20230101.png", "DSC07956.JPG"]), [0, 100_000_000]);
    }

    #[test]
    fn beginnings_are_of_the_file_or_of_the_whole_name() {
        assert!(is_named("clutter001.jpg", "clutter,extra"));
        assert!(is_named("images/extra001.jpg", "clutter, extra"));
        assert!(is_named("train/r_0", "train"));
        assert!(!is_named("clean001.jpg", "clutter,extra"));
        assert!(!is_named("clean001.jpg", ""));
    }
}
