//! `record`: arguments -> a recording, its progress on the terminal.

use std::io::IsTerminal;
use std::process::ExitCode;

use indicatif::{ProgressBar, ProgressStyle};

use crate::cli::{RecordArgs, mapping, say};
use crate::node::open_source::open_input;
use crate::node::run_dir;
use crate::node::stop::Stop;
use splat_io::recording::{Progress, Wanted, record};

/// Seconds between two lines where there is no terminal.
const LINE_SECS: f64 = 5.0;

pub(crate) fn run(args: &RecordArgs) -> anyhow::Result<ExitCode> {
    let mut settings = mapping::settings(&args.params)?;
    let params = settings.params()?;
    let is_terminal = std::io::stderr().is_terminal();
    run_dir::start_log(None, is_terminal)?;
    settings.log_warnings();
    let stop = Stop::default();
    mapping::stop_on_ctrl_c(&stop)?;
    let wanted = Wanted {
        out: args.out.clone(),
        duration_secs: args.duration,
    };
    let input = open_input(
        &args.source,
        &params.source,
        params.seed,
        args.duration,
        stop.flag(),
    )?;
    let bar = bar(is_terminal);
    let mut next_line = LINE_SECS;
    let mut last = Progress::default();
    let done = record(input, &wanted, &params.record, stop.flag(), &mut |p| {
        let text = line(p, &last);
        if !bar.is_hidden() {
            bar.set_message(text);
            bar.tick();
        } else if p.secs >= next_line {
            next_line = p.secs + LINE_SECS;
            tracing::info!("{text}");
        } else {
            return;
        }
        last = *p;
    });
    bar.finish_and_clear();
    let total = done?;
    if total.n_images == 0 {
        anyhow::bail!(
            "no image came in {:.1} s; splat-mapper doctor lists the cameras: {}",
            total.secs,
            args.source
        );
    }
    let files = match total.n_files {
        1 => String::new(),
        n => format!(" and {} more files beside it", n - 1),
    };
    say(format!(
        "{}: {}{files}",
        line(&total, &Progress::default()),
        args.out.display()
    ));
    Ok(ExitCode::SUCCESS)
}

/// What there is, and the rate since `last`.
fn line(now: &Progress, last: &Progress) -> String {
    let secs = (now.secs - last.secs).max(1e-3);
    format!(
        "{} images in {:.1} s, {:.1} Hz, {:.1} MB, {} dropped, {} damaged",
        now.n_images,
        now.secs,
        (now.n_images - last.n_images) as f64 / secs,
        now.n_bytes as f64 * 1e-6,
        now.n_dropped,
        now.n_damaged
    )
}

fn bar(is_terminal: bool) -> ProgressBar {
    if !is_terminal {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{spinner} {msg}");
    ProgressBar::new_spinner().with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}
