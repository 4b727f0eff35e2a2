//! `splat-mapper compare`: rows of methods as runs of their own, a table, and what is there already is kept.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

use splat_mapper::compare::table::RowFigures;

const ROOM: &str = "synthetic:room?frames=10&width=160&height=120&speed=3";

fn compare(out: &Path, rows: &str, more: &[&str]) -> Output {
    let programs = tempfile::tempdir().unwrap();
    colmap(programs.path(), "echo no SIFT today >&2; exit 1");
    compare_beside(programs.path(), out, rows, more)
}

/// With the programs of a folder in front of those of the machine.
fn compare_beside(programs: &Path, out: &Path, rows: &str, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    let path = std::env::var_os("PATH").unwrap_or_default();
    let all = std::iter::once(programs.to_owned()).chain(std::env::split_paths(&path));
    command.env("PATH", std::env::join_paths(all).unwrap());
    let few = ["--steps", "40", "--max-side", "160", "--backend", "cpu"];
    command.args(["compare", ROOM, "--rows", rows, "--out"]);
    command.arg(out).args(few).args(more).output().unwrap()
}

/// A program of that name in the folder, which runs the lines of shell.
fn colmap(folder: &Path, lines: &str) {
    let file = folder.join("colmap");
    std::fs::write(&file, format!("#!/bin/sh\n{lines}\n")).unwrap();
    std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o755)).unwrap();
}

fn rows_of(out: &Path) -> Vec<RowFigures> {
    serde_json::from_slice(&std::fs::read(out.join("compare.json")).unwrap()).unwrap()
}

#[test]
fn rows_are_run_once_and_one_that_fails_says_why() {
    let folder = tempfile::tempdir().unwrap();
    let output = compare(folder.path(), "3dgs_mcmc,3rgs,3dgs,colmap_3dgs", &[]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "two rows failed: {said}");
    let rows = rows_of(folder.path());
    let names: Vec<&str> = rows.iter().map(|row| row.row.as_str()).collect();
    assert_eq!(names, ["3dgs_mcmc", "3rgs", "3dgs", "colmap_3dgs"]);
    for row in &rows[..2] {
        assert_eq!((row.error.as_ref(), row.steps), (None, 40), "{said}");
        assert!(row.psnr_holdout.unwrap() > 10.0 && row.splats > 0);
        // A quarter, half, three quarters and the end.
        assert_eq!(row.curve.len(), 4);
        assert!(row.curve.is_sorted_by(|a, b| a.0 <= b.0), "{:?}", row.curve);
    }
    assert!(rows[0].psnr_holdout_at_equal_time.is_some());
    let reason = |row: &RowFigures| row.error.clone().unwrap();
    assert!(
        reason(&rows[2]).contains("sparse points"),
        "{}",
        reason(&rows[2])
    );
    // The frames of any source go to COLMAP, which is a script that fails here.
    assert!(
        reason(&rows[3]).contains("colmap feature_extractor: no SIFT today"),
        "{}",
        reason(&rows[3])
    );
    let table = std::fs::read_to_string(folder.path().join("compare.md")).unwrap();
    assert_eq!(
        table,
        String::from_utf8_lossy(&output.stdout)
            .trim_end()
            .to_owned()
            + "\n"
    );

    let again = compare(folder.path(), "3dgs_mcmc,3rgs", &["--json"]);
    let said = String::from_utf8_lossy(&again.stderr).into_owned();
    assert_eq!(again.status.code(), Some(0), "{said}");
    assert_eq!(said.matches("is there already").count(), 2, "{said}");
    let printed: Vec<RowFigures> = serde_json::from_slice(&again.stdout).unwrap();
    assert_eq!(printed[0].psnr_holdout, rows[0].psnr_holdout);

    // Another setting is another run.
    let other = compare(folder.path(), "3dgs_mcmc", &["--seed", "2"]);
    let said = String::from_utf8_lossy(&other.stderr).into_owned();
    assert!(!said.contains("is there already"), "{said}");
}

/// Stands in for COLMAP: a model of all images but the first, with their cameras side by side in front of a few points.
const MODEL: &str = r#"
stage=$1
echo "$*" >> "$(dirname "$0")/calls"
while [ $# -gt 0 ]; do
  case $1 in
    --image_path) images=$2;;
    --output_path) sparse=$2;;
  esac
  shift
done
[ "$stage" = mapper ] || exit 0
mkdir -p "$sparse/0"
echo "1 PINHOLE 160 120 140 140 80 60" > "$sparse/0/cameras.txt"
for k in 1 2 3 4 5 6 7 8 9; do
  echo "$k 1 0 0 0 -0.0$k 0 0 1 00000$k.png"
  echo
  echo "$k 0.$k 0.2 2 200 100 50 0.5" >> "$sparse/0/points3D.txt"
done > "$sparse/0/images.txt"
"#;

#[test]
fn the_row_from_colmap_holds_out_the_same_images_though_one_is_not_registered() {
    let (folder, programs) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    colmap(programs.path(), MODEL);
    let few = ["--holdout", "4", "--json"];
    let run = || compare_beside(programs.path(), folder.path(), "ours,colmap_3dgs", &few);
    let output = run();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{said}");
    let rows = rows_of(folder.path());
    // Of 10 frames those with the numbers 2 and 6; both are in COLMAP's model.
    let held_out: Vec<u64> = rows.iter().map(|row| row.views_holdout).collect();
    assert_eq!(held_out, [2, 2], "{said}");
    assert_eq!(rows[1].keyframes, 9, "{said}");
    let settings = folder.path().join("colmap_3dgs/compare_arguments.json");
    let settings = std::fs::read_to_string(settings).unwrap();
    assert!(
        settings.contains("source.holdout_prefixes=000002.png,000006.png"),
        "{settings}"
    );
    let images = std::fs::read_dir(folder.path().join("colmap/images")).unwrap();
    assert_eq!(images.count(), 10);

    // What COLMAP made is kept, too.
    assert_eq!(run().status.code(), Some(0));
    let calls = std::fs::read_to_string(programs.path().join("calls")).unwrap();
    let stages: Vec<&str> = calls.lines().filter_map(|l| l.split(' ').next()).collect();
    assert_eq!(
        stages,
        ["feature_extractor", "exhaustive_matcher", "mapper"]
    );
}

#[test]
fn a_row_that_there_is_not_is_refused_with_those_that_there_are() {
    let folder = tempfile::tempdir().unwrap();
    let output = compare(folder.path(), "ours,4dgs", &[]);
    assert_eq!(output.status.code(), Some(2));
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        said.contains("4dgs") && said.contains("colmap_3dgs"),
        "{said}"
    );
}
