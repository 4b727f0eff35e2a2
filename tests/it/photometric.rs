//! Frames whose pose is a little wrong go back to where their images fit the splats.

use std::path::Path;

use glam::DVec3;

use crate::localise::run;
use splat_engine::cpu::engine::CpuEngine;
use splat_mapper::eval::trajectory::read_tum;
use splat_mapper::node::open_source::open;
use splat_mapper::params::settings::Settings;
use splat_slam::mapper::map_file::checkpoint;
use splat_slam::mapper::mapper::Mapper;
use splat_types::frame::Frame;
use splat_types::snapshot::Scale;
use splat_types::transform::Rigid;

const ROOM: &str = "synthetic:room?frames=24&width=160&height=120";

#[test]
fn a_frame_goes_back_to_where_its_image_fits() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    let output = run(&[
        "replay",
        ROOM,
        "--out",
        out,
        "--geometry",
        "ground_truth",
        "--steps",
        "400",
        "--set",
        "select.every_frame=true",
        "--backend",
        "cpu",
    ]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    let params = Settings::shipped().params().unwrap();
    let saved = checkpoint::read(&folder.path().join("map.splatmap")).unwrap();
    let engine = Box::new(CpuEngine::new());
    let map = Mapper::new(params.mapper(), 0, Scale::UP_TO_SCALE, engine);
    let mut map = map.resume_report(saved, &params.track).unwrap();

    let frames = frames();
    let poses = read_tum(Path::new(&folder.path().join("keyframes.tum"))).unwrap();
    let (mut before, mut after) = ([0.0; 2], [0.0; 2]);
    for (ix, pose) in poses.iter().enumerate().step_by(5) {
        let frame = frames.iter().find(|f| f.stamp == pose.stamp).unwrap();
        // A third of a degree and two centimetres, in another direction each time.
        let (sin, cos) = (ix as f64).sin_cos();
        let off = Rigid::exp(
            DVec3::new(0.02 * cos, 0.02 * sin, 0.0),
            DVec3::new(0.006 * sin, 0.0, 0.006 * cos),
        );
        let wrong = pose.pose * off;
        let fit = map
            .refine_frame(&frame.image, &frame.intrinsics.unwrap(), &wrong)
            .unwrap()
            .expect("a better pose");
        assert!(fit.losses[1] < fit.losses[0]);
        for (sum, at) in [(&mut before, wrong), (&mut after, fit.world_from_cam)] {
            sum[0] += (at.translation - pose.pose.translation).length();
            sum[1] += at.angle_to(&pose.pose);
        }
    }
    eprintln!("translation and turn off by {before:?}, then {after:?}");
    assert!(after[0] < 0.5 * before[0], "{before:?} {after:?}");
    assert!(after[1] < 0.5 * before[1], "{before:?} {after:?}");
    // An image of another place is no reason to move far.
    assert!(
        map.refine_frame(
            &frames[0].image,
            &frames[0].intrinsics.unwrap(),
            &Rigid::exp(DVec3::new(0.0, 0.0, -500.0), DVec3::ZERO),
        )
        .unwrap()
        .is_none(),
        "no splat is in view"
    );
}

fn frames() -> Vec<Frame> {
    let params = Settings::shipped().params().unwrap();
    let mut source = open(ROOM, &params.source, 0).unwrap();
    std::iter::from_fn(|| source.next()).collect()
}
