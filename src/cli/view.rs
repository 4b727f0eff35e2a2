//! `view`: a saved map, a mapper elsewhere or a recording of its messages in a browser.

use std::io::IsTerminal;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};

use crate::cli::mapping::{set_view, settings, stop_on_ctrl_c, usage};
use crate::cli::{ViewArgs, say};
use crate::node::run_dir;
use crate::node::stop::Stop;
use crate::params::params::Params;
use crate::params::settings::Settings;
use crate::view::followed::FollowedMap;
use crate::view::saved;
use crate::view::viewer::{self, DEFAULT_ADDRESS, Shown};
use splat_io::messages;
#[cfg(feature = "zenoh")]
use splat_msgs::map_messages::SplatManifest;
use splat_msgs::ros::{self, Message as _};
use splat_msgs::type_hash::dds_name;
#[cfg(feature = "zenoh")]
use splat_msgs::type_hash::dds_type_name;
#[cfg(feature = "zenoh")]
use splat_ros::zenoh::subscriber::MapSubscriber;
#[cfg(feature = "zenoh")]
use splat_types::time::Stopwatch;
use splat_view::transport::ViewTransport;

const TICK: Duration = Duration::from_millis(50);
/// A whole map is asked for no more often.
#[cfg(feature = "zenoh")]
const SECS_BETWEEN_QUERIES: f64 = 2.0;

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
    let stop = Stop::default();
    stop_on_ctrl_c(&stop)?;
    match args.map.strip_prefix("zenoh:") {
        Some(endpoint) => follow(endpoint, &mut settings, &stop)?,
        None if args.map.ends_with(".mcap") => play(&args.map, &params, &stop)?,
        None => show(&args.map, &params, &stop)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// A saved map.
fn show(path: &str, params: &Params, stop: &Stop) -> anyhow::Result<()> {
    let map = saved::read(Path::new(path))?;
    let n = map.snapshot.splats.len();
    let viewer = started(params, Shown::Map, path)?;
    map.show(viewer.hub());
    say(format!("{n} splats at {} until Ctrl-C", viewer.url()));
    wait_until_asked(stop);
    Ok(())
}

fn wait_until_asked(stop: &Stop) {
    while !stop.is_asked() {
        std::thread::sleep(TICK);
    }
}

/// What a mapper has published, of a file that `publish.record` wrote.
fn play(path: &str, params: &Params, stop: &Stop) -> anyhow::Result<()> {
    let viewer = started(params, Shown::Recording, path)?;
    let mut map = FollowedMap::new(Arc::clone(viewer.hub()), &params.publish);
    let n = messages::read(Path::new(path), |message| {
        // Names of types are `package/msg/Name`; others are none of ours.
        if message.type_name == ros::standard::Path::TYPE_NAME
            && message.topic == params.publish.plan_topic
        {
            map.take_plan(message.payload);
        } else if message.type_name.split('/').count() == 3 {
            map.take(&dds_name(message.type_name), message.payload);
        }
        !stop.is_asked()
    });
    let n = match n {
        // A file that is still written, or was cut off: what is whole is shown.
        Err(reason) if map.has_map() => {
            tracing::warn!("{reason}; what stands before it is shown: {path}");
            "some".to_owned()
        }
        n => n.map_err(|reason| anyhow!("{reason}: {path}"))?.to_string(),
    };
    if !map.has_map() {
        bail!("{n} messages and no map in it: a file that publish.record wrote has one: {path}");
    }
    say(format!("{n} messages at {} until Ctrl-C", viewer.url()));
    wait_until_asked(stop);
    Ok(())
}

/// A mapper elsewhere.
#[cfg(feature = "zenoh")]
fn follow(endpoint: &str, settings: &mut Settings, stop: &Stop) -> anyhow::Result<()> {
    for (key, value) in [
        ("publish.zenoh_listen", ""),
        ("publish.zenoh_connect", endpoint),
    ] {
        settings.set(key, value.into()).map_err(|e| usage(&e))?;
    }
    let scouts = endpoint.is_empty();
    settings
        .set("publish.scouting", scouts.into())
        .map_err(|e| usage(&e))?;
    let params = settings.params().map_err(|e| usage(&e))?;
    let subscriber = MapSubscriber::open(&params.publish)?;
    let viewer = started(&params, Shown::Live, &params.publish.namespace)?;
    let mut map = FollowedMap::new(Arc::clone(viewer.hub()), &params.publish);
    say(format!(
        "following {} at {} until Ctrl-C",
        params.publish.namespace,
        viewer.url()
    ));
    let mut gid = Vec::new();
    let mut is_whole_wanted = true;
    let mut since_asked = Stopwatch::start();
    while !stop.is_asked() {
        let mut received = Vec::new();
        if is_whole_wanted && (since_asked.secs() > SECS_BETWEEN_QUERIES || !map.has_map()) {
            since_asked = Stopwatch::start();
            received = subscriber.newest();
            is_whole_wanted = false;
        }
        received.extend(subscriber.next(TICK));
        for message in received {
            let is_manifest = message.dds_type == dds_type_name::<SplatManifest>();
            if is_manifest && message.gid != gid {
                gid = message.gid;
                map.restart();
            }
            if message.is_plan {
                map.take_plan(&message.payload);
            } else {
                is_whole_wanted |= map.take(&message.dds_type, &message.payload);
            }
        }
        is_whole_wanted |= !map.has_map() && since_asked.secs() > SECS_BETWEEN_QUERIES;
    }
    Ok(())
}

#[cfg(not(feature = "zenoh"))]
fn follow(_endpoint: &str, _settings: &mut Settings, _stop: &Stop) -> anyhow::Result<()> {
    bail!("this build has no zenoh; build with --features zenoh");
}

fn started(params: &Params, shown: Shown, title: &str) -> anyhow::Result<ViewTransport> {
    let viewer = viewer::start(&params.publish, shown, title, true)?;
    viewer.context("publish.view is empty")
}
