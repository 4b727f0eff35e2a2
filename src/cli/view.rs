//! `view`: a saved map in a browser.

use std::io::IsTerminal;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use crate::cli::mapping::{set_view, settings, stop_on_ctrl_c, usage};
use crate::cli::{ViewArgs, say};
use crate::node::run_dir;
use crate::node::stop::Stop;
use crate::view::saved;
use crate::view::viewer::{self, DEFAULT_ADDRESS, Shown};

const TICK: Duration = Duration::from_millis(50);

pub(crate) fn run(args: &ViewArgs) -> anyhow::Result<ExitCode> {
    run_dir::start_log(None, std::io::stderr().is_terminal())?;
    let mut settings = settings(&args.params)?;
    let params = settings.params().map_err(|e| usage(&e))?;
    if args.at.is_some() || params.publish.view.is_empty() {
        set_view(
            &mut settings,
            Some(args.at.as_deref().unwrap_or(DEFAULT_ADDRESS)),
        )?;
    }
    settings.log_warnings();
    let params = settings.params().map_err(|e| usage(&e))?;
    let map = saved::read(Path::new(&args.map))?;
    let stop = Stop::default();
    stop_on_ctrl_c(&stop)?;
    let n = map.snapshot.splats.len();
    let viewer = viewer::start(&params.publish, Shown::Map, &args.map, true)?;
    let Some(viewer) = viewer else {
        return Ok(ExitCode::SUCCESS);
    };
    map.show(viewer.hub());
    say(format!("{n} splats at {} until Ctrl-C", viewer.url()));
    while !stop.is_asked() {
        std::thread::sleep(TICK);
    }
    Ok(ExitCode::SUCCESS)
}
