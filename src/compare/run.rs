//! Runs the rows of a comparison one after the other, each as a replay of its own; rows that are there already are kept.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, bail};

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
    let (mut scene, mut secs_before) = (comparison.scene.clone(), 0.0);
    if row == Row::ColmapGaussian3d {
        (scene, secs_before) = colmap(&comparison.scene, &comparison.out.join("colmap"), say)?;
    }
    let has_layout = Layout::find(&scene).is_some();
    if row.needs_points() && !has_layout {
        bail!(
            "the scene brings no sparse points: a COLMAP or nerfstudio scene does; colmap_3dgs makes them by COLMAP"
        );
    }
    let arguments = row.arguments(&comparison.shared);
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

/// Poses and points of the images by COLMAP, with the seconds that took: (scene, seconds). Kept from an earlier comparison.
fn colmap(scene: &Path, work: &Path, say: &mut dyn FnMut(&str)) -> anyhow::Result<(PathBuf, f64)> {
    let images = scene.join("images");
    if !images.is_dir() {
        bail!(
            "COLMAP needs a folder of images: {} is none",
            images.display()
        );
    }
    let done = work.join("seconds.txt");
    if let Some(secs) = fs::read_to_string(&done)
        .ok()
        .and_then(|t| t.trim().parse().ok())
    {
        return Ok((work.to_owned(), secs));
    }
    let watch = Stopwatch::start();
    fs::create_dir_all(work.join("sparse"))?;
    let link = work.join("images");
    link_images(&images, &link)?;
    let database = work.join("database.db");
    // What an interrupted try left is no start.
    fs::remove_file(&database).ok();
    let path = |path: &Path| path.display().to_string();
    let (database, images, sparse) = (path(&database), path(&link), path(&work.join("sparse")));
    let stages: [&[&str]; 3] = [
        &[
            "feature_extractor",
            "--database_path",
            &database,
            "--image_path",
            &images,
            "--ImageReader.single_camera",
            "1",
            "--SiftExtraction.use_gpu",
            "0",
        ],
        &[
            "exhaustive_matcher",
            "--database_path",
            &database,
            "--SiftMatching.use_gpu",
            "0",
        ],
        &[
            "mapper",
            "--database_path",
            &database,
            "--image_path",
            &images,
            "--output_path",
            &sparse,
        ],
    ];
    for stage in stages {
        say(&format!("colmap {}", stage[0]));
        let log = work.join(format!("{}.log", stage[0]));
        let file = fs::File::create(&log)?;
        let status = Command::new("colmap")
            .args(stage)
            .env("QT_QPA_PLATFORM", "offscreen")
            .stdin(Stdio::null())
            .stdout(file.try_clone()?)
            .stderr(file)
            .status()
            .context("colmap cannot be started; install it (apt install colmap) or leave the row colmap_3dgs out")?;
        if !status.success() {
            bail!("colmap {}: {}", stage[0], last_line(&log));
        }
    }
    if !work.join("sparse/0").is_dir() {
        bail!(
            "COLMAP found no model of these images: {}",
            work.join("mapper.log").display()
        );
    }
    let secs = watch.secs();
    write_atomically("the time of COLMAP", format!("{secs}\n").as_bytes(), &done)?;
    Ok((work.to_owned(), secs))
}

/// The files of a folder again in another one, without a copy where the disk can do that.
fn link_images(from: &Path, to: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let there = to.join(entry.file_name());
        if !entry.path().is_file() || there.exists() {
            continue;
        }
        if fs::hard_link(entry.path(), &there).is_err() {
            fs::copy(entry.path(), &there)?;
        }
    }
    Ok(())
}

fn last_line(log: &Path) -> String {
    let text = fs::read_to_string(log).unwrap_or_default();
    let line = text.lines().rev().find(|line| !line.trim().is_empty());
    line.map_or_else(
        || format!("it ended without a word: {}", log.display()),
        ToOwned::to_owned,
    )
}
