//! Runs the rows of a comparison one after the other, each as a replay of its own; rows that are there already are kept.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, bail};

use crate::compare::colmap::{colmap, last_line};
use crate::compare::rows::{Row, Shared};
use crate::compare::table::{RowFigures, at_equal_time, markdown};
use crate::eval::error::write_atomically;
use crate::eval::evaluation::evaluate;
use crate::eval::report_json::Report;
use splat_io::scene_formats::scene::Layout;
use splat_types::time::Stopwatch;

/// What is to be compared.
#[derive(Debug)]
pub struct Comparison {
    /// Recording or folder of images.
    pub scene: PathBuf,
    /// A folder for each row, and the table.
    pub out: PathBuf,
    pub rows: Vec<Row>,
    pub shared: Shared,
    /// Poses to measure by; where there are none, the scene's own.
    pub reference: Option<PathBuf>,
}

/// Runs all rows, writes `compare.md` and `compare.json`, and returns the figures. `say` gets a line when a row begins or ends. A row that
/// fails has its reason in the table, and the others go on.
pub fn run(comparison: &Comparison, say: &mut dyn FnMut(&str)) -> anyhow::Result<Vec<RowFigures>> {
    fs::create_dir_all(&comparison.out)
        .with_context(|| format!("cannot write to {}", comparison.out.display()))?;
    let mut rows = Vec::new();
    for (ix, row) in comparison.rows.iter().enumerate() {
        let of = comparison.rows.len();
        say(&format!("row {} of {of}: {}", ix + 1, row.title()));
        let watch = Stopwatch::start();
        let figures = one(comparison, *row, say).unwrap_or_else(|error| {
            RowFigures::failed((row.name(), row.title()), format!("{error:#}"))
        });
        let result = match (&figures.error, figures.psnr_holdout) {
            (Some(error), _) => format!("failed: {error}"),
            (None, Some(psnr)) => format!("{psnr:.2} dB on held-out views"),
            (None, None) => "done".to_owned(),
        };
        say(&format!("{}: {result} ({:.0} s)", row.name(), watch.secs()));
        rows.push(figures);
        at_equal_time(&mut rows);
        write(&comparison.out, &rows)?;
    }
    Ok(rows)
}

fn write(out: &Path, rows: &[RowFigures]) -> anyhow::Result<()> {
    let json = serde_json::to_string_pretty(rows)?;
    write_atomically("the table", json.as_bytes(), &out.join("compare.json"))?;
    write_atomically(
        "the table",
        markdown(rows).as_bytes(),
        &out.join("compare.md"),
    )?;
    Ok(())
}

fn one(comparison: &Comparison, row: Row, say: &mut dyn FnMut(&str)) -> anyhow::Result<RowFigures> {
    let folder = comparison.out.join(row.name());
    let shared = &comparison.shared;
    let (mut scene, mut secs_before) = (comparison.scene.clone(), 0.0);
    let mut arguments = row.arguments(shared);
    if row == Row::ColmapGaussian3d {
        let work = comparison.out.join("colmap");
        let of_images = (shared.images, shared.seed, shared.holdout);
        let made = colmap(&scene, &work, of_images, say)?;
        (scene, secs_before) = (made.folder, made.secs);
        let held_out = made.held_out.join(",");
        arguments.extend([
            "--set".to_owned(),
            format!("source.holdout_prefixes={held_out}"),
        ]);
    }
    let has_layout = Layout::find(&scene).is_some();
    if row.needs_points() && !has_layout {
        bail!(
            "the scene brings no sparse points: a COLMAP or nerfstudio scene does; colmap_3dgs makes them by COLMAP"
        );
    }
    let record = folder.join("compare_arguments.json");
    let wanted = serde_json::to_string(&(&scene, &arguments))?;
    let is_there = fs::read_to_string(&record).is_ok_and(|found| found == wanted)
        && Report::read(&folder.join("report.json")).is_ok_and(|report| report.error.is_none());
    if is_there {
        say(&format!(
            "{} is there already: {}",
            row.name(),
            folder.display()
        ));
    } else {
        replay(&scene, &folder, &arguments)?;
        write_atomically("the arguments", wanted.as_bytes(), &record)?;
    }
    let report = Report::read(&folder.join("report.json"))?;
    let reference = comparison.reference.clone();
    let reference = reference.or_else(|| poses_of(&comparison.scene));
    // Names of the images are stamps of COLMAP's scene, and not those that the scene's poses have.
    let reference = reference.filter(|_| row != Row::ColmapGaussian3d);
    let evaluation = reference.and_then(|reference| evaluate(&folder, &reference).ok());
    let last = report.quality_at.last().map_or(0.0, |at| at.measured_s);
    let names = (row.name(), row.title());
    Ok(RowFigures::of(
        names,
        &report,
        evaluation.as_ref(),
        (secs_before, last),
    ))
}

/// The scene's own poses, where `eval --reference` can read them.
fn poses_of(scene: &Path) -> Option<PathBuf> {
    let beside = scene.parent().map(|folder| folder.join("poses_tum.txt"));
    if scene.join("poses_tum.txt").is_file() || Layout::find(scene).is_some() {
        return Some(scene.to_owned());
    }
    beside.filter(|path| path.is_file())
}

fn replay(scene: &Path, folder: &Path, arguments: &[String]) -> anyhow::Result<()> {
    fs::create_dir_all(folder)?;
    let program = std::env::current_exe().context("cannot find this program's own file")?;
    let log = fs::File::create(folder.join("compare.log"))?;
    let status = Command::new(program)
        .arg("replay")
        .arg(scene)
        .arg("--out")
        .arg(folder)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(log)
        .status()?;
    if !status.success() {
        bail!("{}", last_line(&folder.join("compare.log")));
    }
    Ok(())
}
