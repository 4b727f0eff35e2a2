//! `splat-mapper compare`: rows of methods as runs of their own, a table, and what is there already is kept.

use std::path::Path;
use std::process::{Command, Output};

use splat_mapper::compare::table::RowFigures;

const ROOM: &str = "synthetic:room?frames=10&width=160&height=120&speed=3";

fn compare(out: &Path, rows: &str, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    let few = ["--steps", "40", "--max-side", "160", "--backend", "cpu"];
    command.args(["compare", ROOM, "--rows", rows, "--out"]);
    command.arg(out).args(few).args(more).output().unwrap()
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
    assert!(
        reason(&rows[3]).contains("folder of images"),
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
