//! Names of a scene's images -> files: which folder has them at a fitting size, and under which extension.

use std::path::{Component, Path, PathBuf};

/// Folders in which the same images may lie at full size and at shares of it.
const FOLDERS: [&str; 4] = ["images", "images_2", "images_4", "images_8"];
/// Tried when the name has no extension, or the file of that name another one.
const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "JPG", "PNG", "JPEG"];
/// Views asked for the size of a folder's images.
const MAX_ASKED: usize = 50;

/// The folder that was chosen for a scene.
#[derive(Debug)]
pub(crate) struct Images {
    root: PathBuf,
    /// One of `FOLDERS` under `root`; `None`: names are relative to the root itself.
    folder: Option<PathBuf>,
}

impl Images {
    pub(crate) fn find(root: &Path, names: &[&str], max_side_px: u32) -> Self {
        let folders = FOLDERS.iter().map(|folder| root.join(folder));
        let sized = folders.filter_map(|folder| {
            let side = names
                .iter()
                .take(MAX_ASKED)
                .find_map(|name| longest_side(&existing(&folder, tail(name))?))?;
            Some((side, folder))
        });
        let sized: Vec<(u32, PathBuf)> = sized.collect();
        let fitting = sized.iter().filter(|(side, _)| *side >= max_side_px);
        let chosen = fitting
            .min_by_key(|(side, _)| *side)
            .or_else(|| sized.iter().max_by_key(|(side, _)| *side));
        Self {
            root: root.to_owned(),
            folder: chosen.map(|(_, folder)| folder.clone()),
        }
    }

    /// The file of that name where there is one, else the path at which it is missing.
    pub(crate) fn path_of(&self, name: &str) -> PathBuf {
        let in_folder = self
            .folder
            .as_ref()
            .and_then(|folder| existing(folder, tail(name)));
        in_folder
            .or_else(|| existing(&self.root, name))
            .unwrap_or_else(|| {
                let place = self.folder.as_ref().unwrap_or(&self.root);
                place.join(Path::new(tail(name)).file_name().unwrap_or_default())
            })
    }

    pub(crate) fn first_size(root: &Path, names: &[&str]) -> Option<(u32, u32)> {
        let images = Self::find(root, names, u32::MAX);
        let mut asked = names.iter().take(MAX_ASKED);
        asked.find_map(|name| image::image_dimensions(images.path_of(name)).ok())
    }
}

/// Where the images of a COLMAP model are looked for: beside `sparse`, even when the model itself was named.
pub(crate) fn root_of(folder: &Path) -> PathBuf {
    let has_images = |root: &&Path| FOLDERS.iter().any(|name| root.join(name).is_dir());
    let mut above = folder.ancestors().take(3);
    above.find(has_images).unwrap_or(folder).to_owned()
}

/// A list from elsewhere must not make us read whatever else lies on the disk.
pub(crate) fn inside(root: &Path, name: &str) -> Option<PathBuf> {
    let mut parts = Path::new(name).components();
    let stays = parts.all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    (stays && !name.is_empty()).then(|| root.join(name))
}

/// transforms.json spells out the folder, COLMAP does not.
fn tail(name: &str) -> &str {
    let name = name.strip_prefix("./").unwrap_or(name);
    name.strip_prefix("images/").unwrap_or(name)
}

fn existing(root: &Path, name: &str) -> Option<PathBuf> {
    let exact = inside(root, name)?;
    if exact.is_file() {
        return Some(exact);
    }
    // `frame.0001` has no extension to replace, `r_0.png` has one.
    let has_extension = Path::new(name)
        .extension()
        .is_some_and(|e| EXTENSIONS.iter().any(|known| e.eq_ignore_ascii_case(known)));
    let with = |extension: &&str| {
        if has_extension {
            exact.with_extension(extension)
        } else {
            root.join(format!("{name}.{extension}"))
        }
    };
    EXTENSIONS.iter().map(with).find(|path| path.is_file())
}

fn longest_side(path: &Path) -> Option<u32> {
    let (width, height) = image::image_dimensions(path).ok()?;
    Some(width.max(height))
}
