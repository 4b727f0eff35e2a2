//! `run` and `replay`: arguments -> a job, its progress on the terminal, its run directory.

use std::io::IsTerminal;
use std::mem::{Discriminant, discriminant};
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};

use crate::cli::{LocaliseArgs, ParamArgs, ReplayArgs, RunArgs, Usage, say};
use crate::eval::lpips;
use crate::node::engines::Engines;
use crate::node::job::{self, Activity, Job, Outcome, Progress, linger};
use crate::node::stop::Stop;
use crate::node::{localise, open_source, pipeline, ros2, run_dir};
use crate::params::error::ParamsError;
use crate::params::settings::Settings;
use crate::view::saved;
use crate::view::viewer::{self, Shown};
use splat_types::time::Stopwatch;

/// Between lines of the log about one activity.
const SECS_BETWEEN_LINES: f64 = 1.4;

pub(crate) fn run(args: &RunArgs) -> anyhow::Result<ExitCode> {
    let mut settings = settings(&args.params)?;
    if settings.params().map_err(|e| usage(&e))?.source.rate == 0.0 {
        settings
            .set("source.rate", 1.0.into())
            .map_err(|e| usage(&e))?;
    }
    resume(&mut settings, args.resume.as_deref())?;
    set_view(&mut settings, args.view.as_deref())?;
    map(&settings, &args.source, args.out.as_deref())
}

/// `--resume` is `map.resume`.
fn resume(settings: &mut Settings, map: Option<&Path>) -> anyhow::Result<()> {
    if let Some(map) = map {
        let path = map
            .to_str()
            .ok_or_else(|| Usage(format!("--resume {} is not UTF-8", map.display())))?;
        settings
            .set("map.resume", path.into())
            .map_err(|e| usage(&e))?;
    }
    Ok(())
}

/// `--view` is `publish.view`.
pub(crate) fn set_view(settings: &mut Settings, address: Option<&str>) -> anyhow::Result<()> {
    if let Some(address) = address {
        settings
            .set("publish.view", address.into())
            .map_err(|e| usage(&e))?;
    }
    Ok(())
}

pub(crate) fn replay(args: &ReplayArgs) -> anyhow::Result<ExitCode> {
    let mut settings = settings(&args.params)?;
    let rate = match args.rate.as_deref() {
        None => None,
        Some("max") => Some(0.0),
        Some(text) => Some(
            text.parse::<f64>()
                .ok()
                .filter(|rate| *rate > 0.0)
                .ok_or_else(|| {
                    Usage(format!("--rate {text} is neither a number above 0 nor max"))
                })?,
        ),
    };
    let flags: [(&str, Option<serde_json::Value>); 8] = [
        ("source.rate", rate.map(Into::into)),
        ("backend", args.backend.clone().map(Into::into)),
        ("geometry", args.geometry.clone().map(Into::into)),
        ("train.steps", args.steps.map(Into::into)),
        ("source.max_side", args.max_side.map(Into::into)),
        ("train.max_side", args.max_side.map(Into::into)),
        ("seed", args.seed.map(Into::into)),
        ("map.holdout", args.holdout.map(Into::into)),
    ];
    for (key, value) in flags {
        if let Some(value) = value {
            settings.set(key, value).map_err(|e| usage(&e))?;
        }
    }
    resume(&mut settings, args.resume.as_deref())?;
    set_view(&mut settings, args.view.as_deref())?;
    map(&settings, &args.input, args.out.as_deref())
}

pub(crate) fn localise(args: &LocaliseArgs) -> anyhow::Result<ExitCode> {
    let mut settings = settings(&args.params)?;
    set_view(&mut settings, args.view.as_deref())?;
    let params = settings.params().map_err(|e| usage(&e))?;
    if let Some(out) = &args.out {
        run_dir::prepare(out)?;
    }
    run_dir::start_log(args.out.as_deref(), std::io::stderr().is_terminal())?;
    settings.log_warnings();
    let mut source = open_source::open_for(&args.input, &params)?;
    let stop = Stop::default();
    stop_on_ctrl_c(&stop)?;
    source.end_when(stop.flag());
    let out = args.out.as_deref();
    let viewer = viewer::start(&params.publish, Shown::Live, &args.input, true)?;
    if let Some(viewer) = &viewer {
        saved::read(&args.map)?.show(viewer.hub());
    }
    let hub = viewer.as_ref().map(|viewer| &**viewer.hub());
    let found = localise::localise(&args.map, source.as_mut(), &params, out, (&stop, hub))?;
    let reported = &found.tracking;
    if args.json {
        say(serde_json::to_string_pretty(&found)?);
    } else {
        say(format!(
            "{} of {} frames found among {} keyframes, {} times lost, {} times found again",
            reported.tracked,
            reported.frames,
            found.map_keyframes,
            reported.lost,
            reported.relocalised
        ));
    }
    if reported.tracked == 0 {
        let reason = found
            .reason
            .unwrap_or_else(|| "there are no frames".to_owned());
        anyhow::bail!(
            "the camera was not found in the map: {reason}; it must see what the map was made of, in similar light: {}",
            args.input
        );
    }
    Ok(ExitCode::SUCCESS)
}

pub(crate) fn settings(args: &ParamArgs) -> anyhow::Result<Settings> {
    let mut settings = Settings::shipped();
    if let Some(preset) = &args.preset {
        settings.merge_preset(preset).map_err(|e| usage(&e))?;
    }
    if let Some(file) = &args.params {
        settings.merge_file(file)?;
    }
    for setting in &args.set {
        settings.merge_setting(setting).map_err(|e| usage(&e))?;
    }
    Ok(settings)
}

pub(crate) fn usage(error: &ParamsError) -> Usage {
    Usage(error.to_string())
}

fn map(settings: &Settings, input: &str, out: Option<&Path>) -> anyhow::Result<ExitCode> {
    let is_terminal = std::io::stderr().is_terminal();
    if let Some(out) = out {
        run_dir::prepare(out)?;
    }
    run_dir::start_log(out, is_terminal)?;
    let mut settings = settings.clone();
    settings.log_warnings();
    let ros2 = ros2::join(&mut settings, input)?;
    let settings = &settings;
    let params = settings.params().map_err(|e| usage(&e))?;
    // A network that cannot be used is better known before the work than after it.
    let lpips = lpips::lpips(&params.eval.lpips_model)?;
    let source = open_source::open_for(input, &params)?;
    let stop = Stop::default();
    stop_on_ctrl_c(&stop)?;
    let transport = ros2.as_ref().map(ros2::Node::transport).transpose()?;
    let mut transports: Vec<_> = transport.into_iter().collect();
    let viewer = viewer::start(&params.publish, Shown::Live, input, true)?;
    let is_viewed = viewer.is_some();
    if let Some(viewer) = viewer {
        transports.push(Box::new(viewer));
    }
    let output = job::output(&params, transports)?;
    if let (Some(node), Some(output)) = (&ros2, &output) {
        node.serve(&output.handles.publisher, &stop, params.ros2.autostart)?;
    }
    let is_live = source.is_live() || params.source.rate > 0.0;
    let job = Job {
        source,
        params: params.clone(),
        is_live,
        stop: stop.clone(),
        out: out.map(Path::to_owned),
        output,
        engines: Engines::default(),
    };
    let mut display = ProgressDisplay::new(is_terminal);
    let mut on_progress = |progress| display.show(progress);
    let finished = pipeline::run(job, &mut on_progress).and_then(|mut outcome| {
        let place = (out, input);
        let summary = run_dir::finish(&mut outcome, settings, lpips, place, &mut on_progress)?;
        Ok((outcome, summary))
    });
    display.clear();
    let (mut outcome, summary) = finished?;
    say(summary);
    let mut secs = params.publish.shutdown_delay;
    if is_viewed && is_terminal && !stop.is_asked() {
        say("The viewer stays until Ctrl-C.");
        secs = f64::INFINITY;
    }
    linger(&mut outcome, secs, &stop);
    verdict(&outcome, input)
}

/// Done when there is a map and no stage failed.
fn verdict(outcome: &Outcome, input: &str) -> anyhow::Result<ExitCode> {
    if let Some(error) = &outcome.error {
        anyhow::bail!("{error}: {input}");
    }
    if outcome.was_stopped && outcome.snapshot.splats.is_empty() {
        tracing::warn!("stopped before there was a map");
        return Ok(ExitCode::SUCCESS);
    }
    if !outcome.snapshot.poses.is_empty() && outcome.snapshot.splats.is_empty() {
        anyhow::bail!(
            "no splat could be registered, since no depth was verified between {} keyframes: move the camera sideways, or look at something with texture: {input}",
            outcome.snapshot.poses.len()
        );
    }
    if let Some(resume_report) = outcome.map.continuation().filter(|c| !c.is_joined) {
        anyhow::bail!(
            "the recording has no place in the map: {} of {} keyframes were found among the {} of the map, 3 or more must agree; the saved map is as it was, and the recording must see what it was made of, in similar light: {input}",
            resume_report.found,
            resume_report.asked,
            resume_report.keyframes
        );
    }
    if outcome.snapshot.poses.is_empty() {
        let counts = &outcome.input.counts;
        let fault = counts
            .fault
            .as_ref()
            .map(|f| format!("; {f}"))
            .unwrap_or_default();
        let why = if outcome.input.n_selected == 0 {
            format!(
                "none of {} frames could be used ({} undecodable)",
                counts.received, counts.undecodable
            )
        } else {
            outcome
                .geometry_note
                .clone()
                .unwrap_or_else(|| "no parallax was seen between keyframes".to_owned())
        };
        anyhow::bail!(
            "no map: {why}; {} of {} frames were keyframes{fault}; a map needs a camera that moves sideways past textured things: {input}",
            outcome.input.n_selected,
            counts.received,
        );
    }
    Ok(ExitCode::SUCCESS)
}

pub(crate) fn stop_on_ctrl_c(stop: &Stop) -> anyhow::Result<()> {
    let stop = stop.clone();
    ctrlc::set_handler(move || {
        if stop.is_asked() {
            if stop.ask_again() {
                return;
            }
            #[expect(
                clippy::exit,
                reason = "another Ctrl-C ends at once, whatever the stages do"
            )]
            std::process::exit(130);
        }
        stop.ask();
    })
    .context("cannot listen for Ctrl-C")
}

/// A bar on a terminal; else lines of the log.
struct ProgressDisplay {
    bar: Option<ProgressBar>,
    /// What the last line was about, and its age.
    last: Option<(Discriminant<Activity>, Stopwatch)>,
}

impl ProgressDisplay {
    fn new(is_terminal: bool) -> Self {
        let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {msg}  {elapsed}");
        let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
        Self {
            bar: is_terminal.then(|| ProgressBar::new(0).with_style(style)),
            last: None,
        }
    }

    fn show(&mut self, progress: Progress) {
        if let Some(bar) = &self.bar {
            let (done, of, text) = on_bar(&progress);
            bar.set_length(of.max(done));
            bar.set_position(done);
            bar.set_message(text);
            return;
        }
        let kind = discriminant(&progress.activity);
        let is_new = |(last, age): &(Discriminant<Activity>, Stopwatch)| {
            *last != kind || age.secs() >= SECS_BETWEEN_LINES
        };
        if self.last.as_ref().is_none_or(is_new) {
            self.last = Some((kind, Stopwatch::start()));
            tracing::info!("{}", line(&progress));
        }
    }

    fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn counts(progress: &Progress) -> String {
    format!(
        "{} of {} keyframes, {} splats",
        progress.n_registered, progress.n_keyframes, progress.n_splats
    )
}

/// How much of how much is done, and of what.
fn on_bar(progress: &Progress) -> (u64, u64, String) {
    let steps = progress.n_steps;
    match progress.activity {
        Activity::Mapping => {
            let of = progress.steps_planned.unwrap_or(steps);
            (steps, of, format!("steps  {}", counts(progress)))
        }
        Activity::Finishing { secs, of_secs } => {
            let text = format!("s of finishing  {steps} steps, {}", counts(progress));
            (secs as u64, of_secs as u64, text)
        }
        Activity::HeldOutPoses { done, of } => {
            (done as u64, of as u64, "poses of held-out views".to_owned())
        }
        Activity::Saving => (steps, steps, "steps  the map is written".to_owned()),
        Activity::Quality { done, of } => (
            done as u64,
            of as u64,
            "views compared with the map".to_owned(),
        ),
    }
}

fn line(progress: &Progress) -> String {
    let steps = progress.n_steps;
    match (progress.activity, progress.steps_planned) {
        (Activity::Mapping, Some(of)) => format!("step {steps} of {of}: {}", counts(progress)),
        (Activity::Mapping, None) => format!("step {steps}: {}", counts(progress)),
        (Activity::Finishing { secs, of_secs }, _) => {
            format!(
                "finishing, {secs:.0} of {of_secs:.0} s: step {steps}, {}",
                counts(progress)
            )
        }
        (Activity::HeldOutPoses { done, of }, _) => {
            format!("finding poses of held-out views: {done} of {of}")
        }
        (Activity::Saving, _) => format!("step {steps} was the last one; writing the map"),
        (Activity::Quality { done, of }, _) => {
            format!("comparing the map with images: {done} of {of}")
        }
    }
}
