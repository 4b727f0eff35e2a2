//! The tree is as ARCHITECTURE.md says: modules use only modules above them, outside crates have one home.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Modules in layer order, as `lib.rs` lists them.
fn layers() -> Vec<String> {
    let lib = fs::read_to_string("src/lib.rs").unwrap();
    let names = lib
        .lines()
        .filter_map(|line| line.strip_prefix("pub mod ")?.strip_suffix(';'));
    names.map(str::to_owned).collect()
}

fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(rust_files(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// Code without comments.
fn code(text: &str) -> String {
    let lines = text
        .lines()
        .map(|line| line.split("//").next().unwrap_or_default());
    lines.collect::<Vec<_>>().join("\n")
}

/// `src/geometry/sfm.rs` belongs to `geometry`, `src/pose.rs` to `pose`.
fn module_of(path: &Path) -> String {
    let inside = path.strip_prefix("src").unwrap();
    inside
        .components()
        .next()
        .unwrap()
        .as_os_str()
        .to_str()
        .unwrap()
        .trim_end_matches(".rs")
        .to_owned()
}

/// Uses of a module that stands below the user's own.
fn upward(layers: &[String], module: &str, text: &str) -> Vec<String> {
    let Some(own) = layers.iter().position(|layer| layer == module) else {
        return Vec::new();
    };
    let code = code(text);
    let names = code.split("crate::").skip(1).map(|rest| {
        rest.chars()
            .take_while(|c| c.is_alphanumeric() || *c == '_')
            .collect::<String>()
    });
    names
        .filter(|name| {
            layers
                .iter()
                .position(|layer| layer == name)
                .is_some_and(|ix| ix > own)
        })
        .collect()
}

#[test]
fn a_module_uses_only_modules_above_it() {
    let layers = layers();
    assert!(
        layers.len() > 10,
        "lib.rs lists its modules as `pub mod name;`"
    );
    for path in rust_files(Path::new("src")) {
        let text = fs::read_to_string(&path).unwrap();
        let found = upward(&layers, &module_of(&path), &text);
        assert!(
            found.is_empty(),
            "{} uses {found:?}, which stand below it in lib.rs",
            path.display()
        );
    }
}

#[test]
fn an_upward_use_would_be_seen() {
    let layers = layers();
    assert_eq!(
        upward(&layers, "pose", "use crate::map::SplatMap;"),
        ["map"]
    );
    assert!(upward(&layers, "map", "use crate::pose::Rigid; // crate::node").is_empty());
}

/// Crate -> the places that may name it. Maths and errors are everywhere; what talks to the outside is not.
fn homes() -> BTreeMap<&'static str, &'static [&'static str]> {
    BTreeMap::from([
        ("mcap", &["src/source/"][..]),
        ("zenoh", &["src/publish/zenoh"][..]),
        ("cdr_encoding", &["src/ros"][..]),
        ("maud", &["src/eval/"][..]),
        ("clap", &["src/cli/"][..]),
        ("indicatif", &["src/cli/"][..]),
        ("ctrlc", &["src/cli/"][..]),
        ("tracing_subscriber", &["src/node/run_dir.rs"][..]),
        ("serde_saphyr", &["src/config", "src/source/"][..]),
        ("yuv", &["src/source/"][..]),
        ("v4l", &["src/source/v4l2/sys.rs"][..]),
        ("libc", &["src/source/v4l2/"][..]),
        ("nokhwa", &["src/source/webcam.rs"][..]),
        ("zune_jpeg", &["src/source/jpeg.rs"][..]),
        ("wide", &["src/source/jpeg/"][..]),
        ("fast_image_resize", &["src/frame.rs", "src/source/"][..]),
        (
            "kornia_imgproc",
            &["src/select", "src/geometry/", "src/source/"][..],
        ),
        ("kornia_3d", &["src/geometry/"][..]),
        ("ort", &["src/onnx.rs"][..]),
        ("wgpu", &["src/gpu/"][..]),
        (
            "multiversion",
            &["src/splat/cpu/", "src/geometry/", "src/source/"][..],
        ),
        ("r2r", &["src/source/ros2/", "src/publish/ros2/"][..]),
        ("futures", &["src/source/ros2/"][..]),
    ])
}

#[test]
fn each_outside_crate_has_one_home() {
    for path in rust_files(Path::new("src")) {
        let code = code(&fs::read_to_string(&path).unwrap());
        for (name, places) in homes() {
            let is_used = code
                .split(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':'))
                .any(|word| word.starts_with(&format!("{name}::")));
            let is_home = places
                .iter()
                .any(|place| path.to_str().unwrap().starts_with(place));
            assert!(
                !is_used || is_home,
                "{name} is used outside {places:?}: {}",
                path.display()
            );
        }
    }
}

#[test]
fn files_stay_within_400_lines() {
    for folder in ["src", "tests", "benches", "examples"] {
        for path in rust_files(Path::new(folder)) {
            let n = fs::read_to_string(&path).unwrap().lines().count();
            assert!(
                n <= 400,
                "{} has {n} lines: split it by meaning",
                path.display()
            );
        }
    }
}
