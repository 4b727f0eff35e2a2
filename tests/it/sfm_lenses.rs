//! Structure from motion through distorted lenses is as good as through a pinhole.

use std::sync::Arc;

use crate::sfm::{Figures, Shown, run};
use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;
use splat_types::frame::Keyframe;
use splat_types::time::Stopwatch;

/// Every third frame of a walk through the room.
fn figures(lens: &str, rectify: bool) -> Figures {
    let uri = format!("synthetic:room?frames=36&width=480&height=360&noise=1.5&{lens}");
    let mut params = Settings::shipped().params().unwrap();
    params.source.rectify = rectify;
    let mut frames = open_source::open(&uri, &params.source, 1).unwrap();
    let (mut keyframes, mut truth) = (Vec::new(), Vec::new());
    while let Some(frame) = frames.next() {
        if frame.seq % 3 == 0 {
            truth.push(frame.truth.unwrap());
            keyframes.push(Arc::new(Keyframe {
                id: keyframes.len() as u32,
                frame,
                age: Stopwatch::start(),
            }));
        }
    }
    let shown = Shown { keyframes, truth };
    let figures = run(&shown, &["sfm.max_side=480", "sfm.max_features=1000"]);
    eprintln!("{lens}: {figures:?}");
    assert_eq!((figures.registered, figures.submaps), (12, 1), "{lens}");
    figures
}

#[test]
fn fisheye_and_barrel_cost_at_most_half_of_the_accuracy() {
    let pinhole = figures("lens=pinhole", true).ate_percent;
    for lens in ["lens=radial", "lens=fisheye&fov=150"] {
        let ate_percent = figures(lens, true).ate_percent;
        assert!(
            ate_percent <= 2.0 * pinhole.max(0.03),
            "{lens}: {ate_percent} % beside {pinhole} %"
        );
    }
}

/// A barrel lens of which nothing is known: its images come as they are.
#[test]
fn a_lens_without_calibration_is_undistorted_by_what_the_images_say() {
    let figures = figures("lens=radial", false);
    assert!(figures.ate_percent < 0.5, "{figures:?}");
}
