//! What became of each row -> a table in markdown, and JSON.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::eval::evaluation::Evaluation;
use crate::eval::report_json::Report;

/// One row; figures that there are not are null. Many fields: the keys of compare.json, and columns of the table.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RowFigures {
    /// As `--rows` names it, and for people.
    pub row: String,
    pub title: String,
    /// Why there are no figures.
    pub error: Option<String>,
    /// Seconds: of the whole row, COLMAP included, without the time of measuring.
    pub time_s: Option<f64>,
    pub peak_rss_mib: Option<f64>,
    pub peak_gpu_mib: Option<f64>,
    pub keyframes: u64,
    /// Images that are held out, which val figures are of; the same in each row that registers them.
    #[serde(default)]
    pub views_holdout: u64,
    pub splats: u64,
    pub steps: u64,
    pub psnr_train: Option<f64>,
    pub ssim_train: Option<f64>,
    pub lpips_train: Option<f64>,
    pub psnr_holdout: Option<f64>,
    pub ssim_holdout: Option<f64>,
    pub lpips_holdout: Option<f64>,
    /// Held-out PSNR after the time that the first row took in all, between measured moments; of a row that is over by then, its last.
    pub psnr_holdout_at_equal_time: Option<f64>,
    /// Against the scene's poses, after Sim(3) alignment: share of the extent in percent, and degrees.
    pub ate_percent: Option<f64>,
    pub rotation_deg: Option<f64>,
    /// (seconds, held-out PSNR), in order of time.
    pub curve: Vec<(f64, f64)>,
}

impl RowFigures {
    /// `secs_before`: what was done for the row before its replay began.
    pub fn of(
        (row, title): (&str, &str),
        report: &Report,
        evaluation: Option<&Evaluation>,
        (secs_before, measuring_secs): (f64, f64),
    ) -> Self {
        let quality = &report.quality;
        let time_s = secs_before + report.timing_s.wall - measuring_secs;
        let mut curve: Vec<(f64, f64)> = report
            .quality_at
            .iter()
            .filter_map(|at| Some((secs_before + at.wall_s, at.quality.psnr_holdout?)))
            .collect();
        curve.extend(quality.psnr_holdout.map(|psnr| (time_s, psnr)));
        Self {
            row: row.to_owned(),
            title: title.to_owned(),
            error: report.error.clone(),
            time_s: Some(time_s),
            peak_rss_mib: report.peak_rss_mib,
            peak_gpu_mib: report.peak_gpu_mib,
            keyframes: report.keyframes.registered,
            views_holdout: quality.views_holdout,
            splats: report.splats,
            steps: report.steps,
            psnr_train: quality.psnr_train,
            ssim_train: quality.ssim_train,
            lpips_train: quality.lpips_train,
            psnr_holdout: quality.psnr_holdout,
            ssim_holdout: quality.ssim_holdout,
            lpips_holdout: quality.lpips_holdout,
            psnr_holdout_at_equal_time: None,
            ate_percent: evaluation.and_then(|e| e.ate_percent_of_extent),
            rotation_deg: evaluation.and_then(|e| e.rotation_mean_deg),
            curve,
        }
    }

    pub fn failed((row, title): (&str, &str), reason: String) -> Self {
        Self {
            row: row.to_owned(),
            title: title.to_owned(),
            error: Some(reason),
            ..Self::default()
        }
    }
}

/// Fills in what each row had reached when the first row ended.
pub fn at_equal_time(rows: &mut [RowFigures]) {
    let Some(secs) = rows.first().and_then(|row| row.time_s) else {
        return;
    };
    for row in rows {
        row.psnr_holdout_at_equal_time = value_at(&row.curve, secs);
    }
}

/// Of points in order of x, on straight lines between them; none before the first.
fn value_at(curve: &[(f64, f64)], x: f64) -> Option<f64> {
    let next = curve.iter().position(|point| point.0 > x);
    match next {
        None => curve.last().map(|point| point.1),
        Some(0) => None,
        Some(next) => {
            let (from, to) = (curve[next - 1], curve[next]);
            let share = (x - from.0) / (to.0 - from.0);
            Some(from.1 + share * (to.1 - from.1))
        }
    }
}

/// A table that Markdown readers show, with what each column is below.
pub fn markdown(rows: &[RowFigures]) -> String {
    let mut text = String::from(
        "| row | val PSNR | val SSIM | val LPIPS | at equal time | train PSNR | train SSIM | train LPIPS | ATE % | rotation deg | time s | memory MiB | keyframes | val images | splats |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for row in rows {
        if let Some(error) = &row.error {
            writeln!(
                text,
                "| {} | {} |{}",
                row.title,
                one_line(error),
                " |".repeat(13)
            )
            .ok();
            continue;
        }
        let figure = |value: Option<f64>, digits: usize| {
            value.map_or_else(|| "-".to_owned(), |v| format!("{v:.digits$}"))
        };
        let memory = row.peak_gpu_mib.or(row.peak_rss_mib);
        let cells = [
            row.title.clone(),
            figure(row.psnr_holdout, 2),
            figure(row.ssim_holdout, 3),
            figure(row.lpips_holdout, 3),
            figure(row.psnr_holdout_at_equal_time, 2),
            figure(row.psnr_train, 2),
            figure(row.ssim_train, 3),
            figure(row.lpips_train, 3),
            figure(row.ate_percent, 3),
            figure(row.rotation_deg, 3),
            figure(row.time_s, 0),
            figure(memory, 0),
            row.keyframes.to_string(),
            row.views_holdout.to_string(),
            row.splats.to_string(),
        ];
        writeln!(text, "| {} |", cells.join(" | ")).ok();
    }
    text.push_str(
        "\nPSNR in dB; val: held-out views, every n-th image of the scene and so the same in all rows that registered them (val images), each pose refined alone first; at equal time: val PSNR when the first row ended; ATE: of the extent, \
         after Sim(3) alignment to the scene's poses; memory: of the GPU where there is one, else of the process.\n",
    );
    text
}

/// Cells have no bars and no line breaks.
fn one_line(text: &str) -> String {
    text.replace('|', "/")
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(name: &str, curve: &[(f64, f64)]) -> RowFigures {
        RowFigures {
            row: name.to_owned(),
            title: name.to_owned(),
            time_s: curve.last().map(|p| p.0),
            psnr_holdout: curve.last().map(|p| p.1),
            curve: curve.to_vec(),
            ..RowFigures::default()
        }
    }

    #[test]
    fn rows_are_compared_at_the_time_of_the_first() {
        let mut rows = [
            row("first", &[(10.0, 20.0), (30.0, 28.0)]),
            row("slow", &[(20.0, 22.0), (40.0, 30.0)]),
            row("quick", &[(5.0, 25.0)]),
            row("late", &[(50.0, 31.0)]),
            RowFigures::failed(("none", "none"), "no | points\nhere".to_owned()),
        ];
        at_equal_time(&mut rows);
        let found: Vec<_> = rows.iter().map(|r| r.psnr_holdout_at_equal_time).collect();
        assert_eq!(found, [Some(28.0), Some(26.0), Some(25.0), None, None]);
        let text = markdown(&rows);
        let lines: Vec<&str> = text.lines().take(7).collect();
        let n_bars = |line: &str| line.matches('|').count();
        assert!(lines.iter().all(|line| n_bars(line) == 16), "{text}");
        assert!(text.contains("| none | no / points here |"), "{text}");
        assert!(text.contains("| slow | 30.00 | - | - | 26.00 |"), "{text}");
    }
}
