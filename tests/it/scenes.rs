//! Where the real scenes are: outside the project, in SPLAT_MAPPER_DATA or beside the checkout.

use std::path::PathBuf;

/// Folder of a scene. Without the scenes: fails under CI=true, else says so and gives `None`, and the test returns.
pub fn scene(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SPLAT_MAPPER_DATA")
        .map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folder = root.join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    ignored(&format!(
        "no scene {name:?}; set SPLAT_MAPPER_DATA to the folder of the scenes: {}",
        folder.display()
    ));
    None
}

/// A test lacks what it needs and is about to return: fails under CI=true, else says so.
pub fn ignored(reason: &str) {
    assert!(std::env::var("CI").as_deref() != Ok("true"), "{reason}");
    eprintln!("ignored: {reason}");
}
