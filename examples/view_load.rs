//! Serves a synthetic map to viewers and changes it at random, for tests of the page: prints the address, then, after the last revision,
//! what a viewer must hold.
#![allow(clippy::print_stdout, reason = "an example speaks to the terminal")]

use std::sync::Arc;
use std::time::Duration;

use anyhow::Result;
use clap::Parser;
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64;

use splat_ros::transport::{Event, Transport as _};
use splat_types::camera::Intrinsics;
use splat_types::correction::{MapCorrection, Reason};
use splat_types::snapshot::{KeyframePose, Scale, Snapshot};
use splat_types::splats::splats::Splats;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::{Rigid, Similarity};
use splat_view::settings::{Tls, ViewSettings};
use splat_view::transport::ViewTransport;

#[derive(Parser)]
struct Args {
    #[arg(long, default_value = "127.0.0.1:0")]
    view: String,
    #[arg(long, default_value_t = 20_000)]
    splats: usize,
    #[arg(long, default_value_t = 1000)]
    revisions: u32,
    /// Between two revisions.
    #[arg(long, default_value_t = 20)]
    millis: u64,
    /// Of each revision: so many splats move, a tenth of them goes, as many come.
    #[arg(long, default_value_t = 500)]
    changes: usize,
    /// Revision at which a loop is closed.
    #[arg(long, default_value_t = 0)]
    loop_at: u32,
    /// Goes on after the last revision for so long.
    #[arg(long, default_value_t = 600.0)]
    stay_secs: f64,
}

const KEYFRAMES: u32 = 60;

struct World {
    random: Pcg64,
    splats: Splats,
    ids: Vec<u32>,
    next_id: u32,
    poses: Vec<KeyframePose>,
    epoch: u32,
}

impl World {
    fn new(n: usize) -> Self {
        let pose = |id: u32| {
            let angle = f64::from(id) / f64::from(KEYFRAMES) * std::f64::consts::TAU;
            let turn = glam::DQuat::from_rotation_y(angle);
            KeyframePose {
                keyframe_id: id,
                stamp: Stamp::from_nanos(i64::from(id) * 200_000_000),
                world_from_cam: Rigid::new(turn, turn * glam::DVec3::new(0.0, 0.0, -2.0)),
                intrinsics: Intrinsics {
                    fx: 400.0,
                    fy: 400.0,
                    cx: 320.0,
                    cy: 240.0,
                    width_px: 640,
                    height_px: 480,
                },
            }
        };
        let mut world = Self {
            random: Pcg64::seed_from_u64(7),
            splats: Splats {
                sh_degree: 1,
                ..Splats::default()
            },
            ids: Vec::new(),
            next_id: 0,
            poses: (0..KEYFRAMES).map(pose).collect(),
            epoch: 0,
        };
        for k in 0..n {
            world.push((k * KEYFRAMES as usize / n) as u32);
        }
        world
    }

    /// On a sphere round the cameras.
    fn push(&mut self, anchor: u32) {
        let random = &mut self.random;
        let mut unit = || random.random_range(-1.0_f32..1.0);
        let at = glam::Vec3::new(unit(), unit(), unit()).normalize_or_zero() * (4.0 + unit());
        let colour = [unit(), unit(), unit()];
        self.splats.means.push(at.to_array());
        self.splats
            .log_scales
            .push([-3.5 + unit(), -3.5 + unit(), -4.5]);
        self.splats.quats.push([1.0, unit(), unit(), unit()]);
        self.splats.opacity_logits.push(2.0 * unit() + 1.0);
        self.splats.sh.extend(colour);
        self.splats.sh.extend((0..9).map(|_| 0.1 * unit()));
        self.splats.anchors.push(anchor);
        self.ids.push(self.next_id);
        self.next_id += 1;
    }

    fn change(&mut self, n: usize) {
        let mut kept = vec![true; self.ids.len()];
        for k in 0..n {
            let ix = self.random.random_range(0..self.ids.len());
            self.splats.means[ix][1] += 0.01;
            kept[ix] = k % 10 != 0;
        }
        let ixs: Vec<usize> = (0..kept.len()).filter(|ix| kept[*ix]).collect();
        self.splats = self.splats.picked(&ixs);
        self.ids = ixs.iter().map(|ix| self.ids[*ix]).collect();
        for _ in 0..n / 10 {
            let anchor = self.random.random_range(0..KEYFRAMES);
            self.push(anchor);
        }
    }

    /// The later half of the map turns a little.
    fn close_loop(&mut self) {
        self.epoch += 1;
        let turn = glam::DQuat::from_rotation_y(0.1);
        for pose in &mut self.poses[KEYFRAMES as usize / 2..] {
            pose.world_from_cam = Rigid::new(turn, glam::DVec3::ZERO) * pose.world_from_cam;
        }
        for (mean, anchor) in self.splats.means.iter_mut().zip(&self.splats.anchors) {
            if *anchor >= KEYFRAMES / 2 {
                *mean = (turn.as_quat() * glam::Vec3::from_array(*mean)).to_array();
            }
        }
    }

    fn snapshot(&self, revision: u32) -> Arc<Snapshot> {
        Arc::new(Snapshot {
            map_id: [7; 16],
            epoch: self.epoch,
            revision,
            stamp: self.poses.last().map(|pose| pose.stamp).unwrap_or_default(),
            scale: Scale::GIVEN,
            poses: self.poses.clone(),
            splats: Arc::new(self.splats.clone()),
            splat_ids: Arc::new(self.ids.clone()),
        })
    }
}

fn main() -> Result<()> {
    let args = Args::parse();
    let viewer = ViewTransport::start(&ViewSettings {
        address: args.view.parse()?,
        may_take_another_port: false,
        token: None,
        tls: Tls::Off,
        max_clients: 16,
        sh_degree: 3,
        source: "live",
        title: "random changes".to_owned(),
        map_frame: "map".to_owned(),
    })?;
    println!("{}", viewer.url());
    let mut world = World::new(args.splats);
    for revision in 1..=args.revisions {
        if revision == args.loop_at {
            world.close_loop();
            viewer.observe(&Event::Correction(&MapCorrection {
                epoch: world.epoch,
                revision,
                new_world_from_old_world: Similarity::IDENTITY,
                translation: 0.2,
                rotation_rad: 0.1,
                reason: Reason::Loop,
            }));
        }
        if revision > 1 {
            world.change(args.changes);
        }
        viewer.observe(&Event::Map {
            snapshot: &world.snapshot(revision),
            map_from_world: Similarity::IDENTITY,
        });
        std::thread::sleep(Duration::from_millis(args.millis));
    }
    let ids = u64::from(
        world
            .ids
            .iter()
            .fold(0_u32, |sum, id| sum.wrapping_add(*id)),
    );
    println!(
        "{}",
        serde_json::json!({"revision": args.revisions, "epoch": world.epoch, "n": world.ids.len(), "sum_of_ids": ids})
    );
    let watch = Stopwatch::start();
    while watch.secs() < args.stay_secs {
        std::thread::sleep(Duration::from_millis(100));
    }
    Ok(())
}
