//! Where the system keeps shared libraries, and which of them is the one that is asked for.

use std::path::{Path, PathBuf};

pub fn library_folders() -> Vec<PathBuf> {
    const STANDARD: [&str; 9] = [
        "/usr/local/lib",
        "/usr/lib/x86_64-linux-gnu",
        "/usr/lib/aarch64-linux-gnu",
        "/usr/lib64",
        "/usr/lib",
        "/lib/x86_64-linux-gnu",
        "/lib/aarch64-linux-gnu",
        "/lib64",
        "/lib",
    ];
    let named = std::env::var_os("LD_LIBRARY_PATH").unwrap_or_default();
    std::env::split_paths(&named)
        .filter(|path| !path.as_os_str().is_empty())
        .chain(STANDARD.map(PathBuf::from))
        .collect()
}

/// The library itself or a versioned name of it.
pub fn find_library(folders: &[PathBuf], name: &str) -> Option<PathBuf> {
    let matches = |path: &PathBuf| {
        let file = path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        file.strip_prefix(name)
            .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    folders
        .iter()
        .find_map(|folder| entries(folder).into_iter().find(matches))
}

/// Sorted content of a folder; nothing when it is not there.
pub fn entries(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
        .collect();
    paths.sort();
    paths
}
