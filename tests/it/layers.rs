//! The tree is as ARCHITECTURE.md says: crates and modules use only what stands above them, no files use each other in a
//! circle, and each outside crate has one home.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Crates in layer order, each with the crates of ours that it may use.
const CRATES: [(&str, &[&str]); 12] = [
    ("splat-types", &[]),
    ("splat-gpu", &[]),
    ("splat-image", &["splat-types"]),
    ("splat-msgs", &["splat-types"]),
    ("splat-engine", &["splat-types", "splat-gpu"]),
    (
        "splat-geometry",
        &["splat-types", "splat-image", "splat-gpu"],
    ),
    ("splat-io", &["splat-types", "splat-image", "splat-msgs"]),
    (
        "splat-synth",
        &["splat-types", "splat-image", "splat-msgs", "splat-io"],
    ),
    (
        "splat-slam",
        &[
            "splat-types",
            "splat-image",
            "splat-engine",
            "splat-geometry",
        ],
    ),
    ("splat-volume", &["splat-types"]),
    (
        "splat-ros",
        &[
            "splat-types",
            "splat-image",
            "splat-msgs",
            "splat-io",
            "splat-volume",
        ],
    ),
    (
        "splat-view",
        &["splat-types", "splat-msgs", "splat-volume", "splat-ros"],
    ),
];

/// Lines that a file may have; beyond it there are two meanings in one file.
const MAX_LINES: usize = 550;

/// `a::b` as `["a", "b"]`; the crate's root is empty.
type Module = Vec<String>;

/// A file of a crate: its module, the modules that it declares, in order, and the paths of its crate that it names.
#[derive(Debug, Default)]
struct SourceFile {
    path: PathBuf,
    declares: Vec<String>,
    paths: Vec<Module>,
}

/// The root of the sources of each crate, the node's last.
pub fn roots() -> Vec<(String, PathBuf)> {
    let of_crate = |(name, _): &(&str, _)| {
        let root = Path::new("crates").join(name).join("src");
        ((*name).to_owned(), root)
    };
    let mut roots: Vec<_> = CRATES.iter().map(of_crate).collect();
    roots.push(("splat-mapper".to_owned(), PathBuf::from("src")));
    roots
}

pub fn rust_files(folder: &Path) -> Vec<PathBuf> {
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

/// Code without comments and without the tests at the end of the file, which may use anything.
fn code(text: &str) -> String {
    let text = text
        .split("#[cfg(test)]\nmod tests {")
        .next()
        .unwrap_or(text);
    let lines = text
        .lines()
        .map(|line| line.split("//").next().unwrap_or_default());
    lines.collect::<Vec<_>>().join("\n")
}

fn module_of(root: &Path, path: &Path) -> Module {
    let inside = path.strip_prefix(root).unwrap().with_extension("");
    let mut module: Module = inside
        .iter()
        .map(|part| part.to_str().unwrap().to_owned())
        .collect();
    let is_folder = module.last().is_some_and(|last| last == "mod");
    if is_folder || module == ["lib"] {
        module.pop();
    }
    module
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// Every path behind `crate::`, groups of a `use` taken apart.
fn paths_in(code: &str) -> Vec<Module> {
    let mut found = Vec::new();
    for (at, _) in code.match_indices("crate::") {
        let is_start = !code[..at].ends_with(|c: char| is_word(c) || c == '$' || c == ':');
        if is_start {
            take_tree(&code[at + "crate::".len()..], &Vec::new(), &mut found);
        }
    }
    found
}

/// Reads `a::b` or `a::{b, c::d}` at the start of `rest`; returns what is behind it.
fn take_tree<'a>(rest: &'a str, prefix: &Module, found: &mut Vec<Module>) -> &'a str {
    let (mut rest, mut path) = (rest.trim_start(), prefix.clone());
    loop {
        if let Some(mut inside) = rest.strip_prefix('{') {
            loop {
                inside = take_tree(inside, &path, found).trim_start();
                match inside.strip_prefix(',') {
                    Some(next) => inside = next.trim_start(),
                    None => return inside.strip_prefix('}').unwrap_or(inside),
                }
                if let Some(behind) = inside.strip_prefix('}') {
                    return behind;
                }
            }
        }
        let end = rest.find(|c| !is_word(c)).unwrap_or(rest.len());
        if end > 0 {
            path.push(rest[..end].to_owned());
        }
        rest = &rest[end..];
        match rest.strip_prefix("::") {
            Some(next) if end > 0 => rest = next.trim_start(),
            _ => break,
        }
    }
    let behind = rest.trim_start();
    found.push(path);
    // `x as y`: the alias names nothing of ours.
    behind
        .strip_prefix("as ")
        .map_or(rest, |alias| alias.trim_start().trim_start_matches(is_word))
}

fn declared_in(text: &str) -> Vec<String> {
    let name_of = |line: &str| {
        let line = line.trim_start();
        let line = line.strip_prefix("pub(crate) ").unwrap_or(line);
        let line = line.strip_prefix("pub ").unwrap_or(line);
        Some(line.strip_prefix("mod ")?.strip_suffix(';')?.to_owned())
    };
    text.lines().filter_map(name_of).collect()
}

fn source_files(root: &Path) -> BTreeMap<Module, SourceFile> {
    let is_program = |path: &PathBuf| path.ends_with("main.rs") || path.ends_with("tests.rs");
    let files = rust_files(root).into_iter().filter(|p| !is_program(p));
    let read = |path: PathBuf| {
        let text = fs::read_to_string(&path).unwrap();
        let file = SourceFile {
            declares: declared_in(&text),
            paths: paths_in(&code(&text)),
            path: path.clone(),
        };
        (module_of(root, &path), file)
    };
    files.map(read).collect()
}

/// The file that a path leads into.
fn target<'a>(files: &'a BTreeMap<Module, SourceFile>, path: &Module) -> &'a Module {
    let lengths = (0..=path.len()).rev();
    let known = lengths.filter_map(|n| files.get_key_value(&path[..n]));
    known.map(|(module, _)| module).next().unwrap()
}

/// Which files each file uses, itself left out.
fn arrows(files: &BTreeMap<Module, SourceFile>) -> BTreeMap<&Module, BTreeSet<&Module>> {
    let of_file = |(module, file): (_, &SourceFile)| {
        let targets = file.paths.iter().map(|path| target(files, path));
        (module, targets.filter(|t| *t != module).collect())
    };
    files.iter().map(of_file).collect()
}

/// A use of a module that is declared behind the user's own: (user, used).
fn upward(files: &BTreeMap<Module, SourceFile>) -> Vec<(PathBuf, String)> {
    let mut found = Vec::new();
    for (module, targets) in arrows(files) {
        for target in targets {
            let shared = module
                .iter()
                .zip(target)
                .take_while(|(a, b)| a == b)
                .count();
            let (Some(own), Some(other)) = (module.get(shared), target.get(shared)) else {
                continue;
            };
            let order = &files[&module[..shared]].declares;
            let place = |name| order.iter().position(|declared| declared == name);
            if place(other) > place(own) {
                found.push((files[module].path.clone(), target.join("::")));
            }
        }
    }
    found
}

/// Files of one circle, if there is one.
fn circle(arrows: &BTreeMap<&Module, BTreeSet<&Module>>) -> Option<Vec<String>> {
    let mut left: BTreeSet<&Module> = arrows.keys().copied().collect();
    // Whoever uses nothing that is left is in no circle.
    loop {
        let free: Vec<_> = left
            .iter()
            .filter(|module| arrows[**module].is_disjoint(&left))
            .copied()
            .collect();
        if free.is_empty() {
            break;
        }
        free.iter().for_each(|module| {
            left.remove(module);
        });
    }
    let mut walk = vec![*left.first()?];
    loop {
        let next = *arrows[walk[walk.len() - 1]].intersection(&left).next()?;
        if let Some(start) = walk.iter().position(|module| *module == next) {
            return Some(walk[start..].iter().map(|m| m.join("::")).collect());
        }
        walk.push(next);
    }
}

#[test]
fn a_module_uses_only_modules_declared_above_it() {
    for (name, root) in roots() {
        let found = upward(&source_files(&root));
        assert!(
            found.is_empty(),
            "{name}: (file, module declared below it): {found:#?}"
        );
    }
}

#[test]
fn no_files_use_each_other_in_a_circle() {
    for (name, root) in roots() {
        let files = source_files(&root);
        assert_eq!(circle(&arrows(&files)), None, "{name}");
    }
}

fn file(module: &str, declares: &[&str], text: &str) -> (Module, SourceFile) {
    let file = SourceFile {
        path: PathBuf::from(module),
        declares: declares.iter().map(|d| (*d).to_owned()).collect(),
        paths: paths_in(&code(text)),
    };
    let parts = module.split("::").filter(|part| !part.is_empty());
    (parts.map(str::to_owned).collect(), file)
}

#[test]
fn an_upward_use_and_a_circle_would_be_seen() {
    let files = BTreeMap::from([
        file("", &["a", "b"], ""),
        file(
            "a",
            &[],
            "use crate::{b::{self, c::Deep as D}, x}; // crate::a",
        ),
        file("b", &["c"], ""),
        file("b::c", &[], "fn f() { crate::a::g() }"),
    ]);
    let found: Vec<_> = upward(&files).into_iter().map(|(_, used)| used).collect();
    assert_eq!(found, ["b", "b::c"]);
    assert!(circle(&arrows(&files)).is_some_and(|circle| circle.len() == 2));
    let calm = BTreeMap::from([
        file("", &["a", "b"], ""),
        file("a", &[], "mod tests {}"),
        file("b", &[], "use crate::a::g;"),
    ]);
    assert!(upward(&calm).is_empty() && circle(&arrows(&calm)).is_none());
}

#[test]
fn a_crate_uses_only_the_crates_that_it_may() {
    for (name, may_use) in CRATES {
        let manifest = fs::read_to_string(format!("crates/{name}/Cargo.toml")).unwrap();
        let normal = manifest
            .split("[dev-dependencies]")
            .next()
            .unwrap_or_default();
        let used = normal
            .lines()
            .filter_map(|line| line.split(['.', ' ', '=']).next())
            .filter(|word| word.starts_with("splat-") && CRATES.iter().any(|(c, _)| c == word));
        for other in used {
            assert!(
                may_use.contains(&other),
                "{name} depends on {other}; it may use {may_use:?}"
            );
        }
    }
}

/// Outside crate -> the places that may name it. Maths and errors are everywhere; what talks to the outside is not.
fn homes() -> BTreeMap<&'static str, &'static [&'static str]> {
    BTreeMap::from([
        (
            "mcap",
            &["crates/splat-io/", "crates/splat-ros/src/mcap_transport"][..],
        ),
        ("zenoh", &["crates/splat-ros/src/zenoh/"][..]),
        ("foxglove", &["crates/splat-ros/src/foxglove_transport"][..]),
        (
            "cdr_encoding",
            &[
                "crates/splat-msgs/",
                "crates/splat-slam/src/track/landmark_file",
            ][..],
        ),
        ("flate2", &["src/formats/spz.rs", "src/report/walk.rs"][..]),
        ("zstd", &["src/formats/spz.rs"][..]),
        ("axum", &["crates/splat-view/"][..]),
        ("hyper", &["crates/splat-view/src/server.rs"][..]),
        ("hyper_util", &["crates/splat-view/src/server.rs"][..]),
        ("tokio", &["crates/splat-view/"][..]),
        ("tokio_rustls", &["crates/splat-view/src/"][..]),
        ("rcgen", &["crates/splat-view/src/tls.rs"][..]),
        ("maud", &["src/report/"][..]),
        ("clap", &["src/cli"][..]),
        ("indicatif", &["src/cli"][..]),
        ("ctrlc", &["src/cli"][..]),
        ("tracing_subscriber", &["src/node/run_dir.rs"][..]),
        ("yuv", &["crates/splat-image/"][..]),
        ("nokhwa", &["crates/splat-io/src/webcam.rs"][..]),
        ("zune_jpeg", &["crates/splat-image/"][..]),
        ("wide", &["crates/splat-image/"][..]),
        ("ort", &["crates/splat-geometry/src/inference.rs"][..]),
        ("wgpu", &["crates/splat-gpu/"][..]),
        ("r2r", &["crates/splat-ros/src/ros2/"][..]),
        ("futures", &["crates/splat-ros/src/ros2/"][..]),
    ])
}

#[test]
fn each_outside_crate_has_one_home() {
    for path in roots().iter().flat_map(|(_, root)| rust_files(root)) {
        let code = code(&fs::read_to_string(&path).unwrap());
        for (name, places) in homes() {
            let is_used = code
                .split(|c: char| !(is_word(c) || c == ':'))
                .any(|word| word.starts_with(&format!("{name}::")));
            let is_home = places
                .iter()
                .any(|place| path.to_str().unwrap().starts_with(place));
            // A module of ours may have the name of a crate.
            let is_ours =
                code.contains(&format!("::{name};")) || code.contains(&format!("mod {name};"));
            assert!(
                !is_used || is_home || is_ours,
                "{name} is used outside {places:?}: {}",
                path.display()
            );
        }
    }
}

#[test]
fn files_have_one_meaning_and_a_bound() {
    for folder in ["src", "crates", "tests", "benches", "examples"] {
        for path in rust_files(Path::new(folder)) {
            let n = fs::read_to_string(&path).unwrap().lines().count();
            assert!(
                n <= MAX_LINES,
                "{} has {n} lines: split it by meaning",
                path.display()
            );
        }
    }
}
