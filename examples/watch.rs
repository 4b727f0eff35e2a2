//! Follows a running mapper over zenoh: prints poses and revisions, keeps the newest map as PLY.
//!
//! A client in one page: ask for the newest snapshot (late joiner), follow, put the pieces together.
#![allow(clippy::print_stdout, reason = "an example speaks to the terminal")]

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, anyhow, bail};
use clap::Parser;
use zenoh::qos::CongestionControl;
use zenoh::query::ConsolidationMode;
use zenoh::sample::Sample;
use zenoh::{Config, Wait};

use splat_mapper::node::save_map::{MapFile, save_map};
use splat_msgs::client::follower::{Followed, Follower};
use splat_msgs::ros;
use splat_msgs::ros::standard::PoseWithCovarianceStamped;
use splat_msgs::type_hash::dds_type_name;
use splat_types::splats::layout;
use splat_types::time::{Stamp, Stopwatch};

/// Follows a running mapper over zenoh.
#[derive(Parser)]
struct Args {
    /// Where the mapper listens, for example tcp/127.0.0.1:7447; without it peers are found by multicast.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Option<String>,
    #[arg(long, default_value = "splat_mapper")]
    namespace: String,
    #[arg(long, default_value_t = 0)]
    domain: u32,
    /// Keeps the newest complete map here.
    #[arg(long, value_name = "FILE.ply")]
    out: Option<PathBuf>,
    /// Ends with the first complete snapshot.
    #[arg(long)]
    once: bool,
    /// Ends after so many seconds without a new snapshot.
    #[arg(long, value_name = "SECS", default_value_t = 3600.0)]
    timeout: f64,
}

/// Snapshots larger than this are not for this example.
const MAX_MAP_BYTES: usize = 4 << 30;

struct Watch {
    follower: Follower,
    /// The publisher that the pieces come from; a restarted one counts its revisions from the start again.
    gid: Vec<u8>,
}

impl Watch {
    fn take(&mut self, sample: &Sample) -> Followed {
        let payload = sample.payload().to_bytes();
        // domain / namespace / topic / type / hash
        let dds_type = sample.key_expr().as_str().rsplit('/').nth(1);
        let Some(dds_type) = dds_type else {
            return Followed::Nothing;
        };
        if dds_type == dds_type_name::<PoseWithCovarianceStamped>() {
            let Ok(pose) = ros::decode::<PoseWithCovarianceStamped>(&payload) else {
                return Followed::Nothing;
            };
            let (p, q) = (pose.pose.pose.position, pose.pose.pose.orientation);
            let stamp = Stamp::from(pose.header.stamp);
            println!(
                "pose {stamp} {:.4} {:.4} {:.4}  {:.5} {:.5} {:.5} {:.5}",
                p.x, p.y, p.z, q.x, q.y, q.z, q.w
            );
            return Followed::Nothing;
        }
        let attachment = sample
            .attachment()
            .map(|bytes| bytes.to_bytes().into_owned())
            .unwrap_or_default();
        let gid = attachment.get(17..).unwrap_or_default();
        if dds_type.contains("SplatManifest") && gid != self.gid {
            self.gid = gid.to_vec();
            self.follower = Follower::new(MAX_MAP_BYTES);
        }
        self.follower.add_payload(dds_type, &payload)
    }
}

fn main() -> Result<()> {
    let args = Args::parse();
    let mut config = Config::default();
    let mut set = |key: &str, json: String| {
        config
            .insert_json5(key, &json)
            .map_err(|e| anyhow!("{key}: {e}"))
    };
    set("listen/endpoints", "[]".to_owned())?;
    set(
        "scouting/multicast/enabled",
        args.connect.is_none().to_string(),
    )?;
    set(
        "connect/endpoints",
        serde_json::json!(args.connect.iter().collect::<Vec<_>>()).to_string(),
    )?;
    let session = zenoh::open(config)
        .wait()
        .map_err(|e| anyhow!("cannot open zenoh: {e}"))?;
    let key = format!("{}/{}/**", args.domain, args.namespace);
    let live = session
        .declare_subscriber(&key)
        .wait()
        .map_err(|e| anyhow!("{key}: {e}"))?;

    let mut watch = Watch {
        follower: Follower::new(MAX_MAP_BYTES),
        gid: Vec::new(),
    };
    let mut has_snapshot = false;
    let mut quiet = Stopwatch::start();
    while quiet.secs() < args.timeout {
        let mut samples = Vec::new();
        if !has_snapshot {
            // All chunks have one key: without this setting zenoh would keep only the last one.
            let query = session.get(&key).consolidation(ConsolidationMode::None);
            let query = query
                .congestion_control(CongestionControl::Block)
                .timeout(Duration::from_secs(10));
            let replies = query.wait().map_err(|e| anyhow!("{key}: {e}"))?;
            samples.extend(
                replies
                    .into_iter()
                    .filter_map(|reply| reply.into_result().ok()),
            );
        }
        let one = live
            .recv_timeout(Duration::from_millis(500))
            .map_err(|e| anyhow!("zenoh ended: {e}"))?;
        samples.extend(one);
        for sample in &samples {
            match watch.take(sample) {
                Followed::Nothing => continue,
                Followed::Missed => {
                    has_snapshot = false;
                    continue;
                }
                Followed::Advanced => {}
            }
            let Some(held) = watch.follower.held() else {
                continue;
            };
            let (map, sha) = (&held.splats, layout::map_sha256(&held.splats));
            println!(
                "revision {} epoch {}: {} splats, {} keyframes, sha256 {sha}",
                held.revision,
                held.epoch,
                map.len(),
                held.poses.len()
            );
            if let Some(path) = &args.out {
                save_map(MapFile::Ply(map), path)?;
            }
            if args.once {
                return Ok(());
            }
            has_snapshot = true;
            quiet = Stopwatch::start();
        }
    }
    if !has_snapshot {
        bail!(
            "no map on {key} within {} s; does a mapper run with --set publish.zenoh=true?",
            args.timeout
        );
    }
    Ok(())
}
