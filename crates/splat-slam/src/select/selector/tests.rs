//! Synthetic motion, blur and batches.

use crate::select::selector::*;
use splat_types::image::RgbImage;
use splat_types::time::Stamp;

fn params() -> SelectParams {
    SelectParams::default()
}

/// A smooth random texture, shifted.
fn frame(seq: u64, shift_px: f64, contrast: f64) -> Frame {
    let (width_px, height_px) = (320, 240);
    let mut pixels = Vec::new();
    for y in 0..height_px {
        for x in 0..width_px {
            let (u, v) = (f64::from(x) + shift_px, f64::from(y));
            let wave = (u * 0.31).sin() * (v * 0.23).cos()
                + (u * 0.11 + v * 0.17).sin()
                + (u * 0.047 - v * 0.05).cos();
            let level = (128.0 + 30.0 * contrast * wave) as u8;
            pixels.extend_from_slice(&[level; 3]);
        }
    }
    Frame {
        seq,
        stamp: Stamp::from_secs(seq as f64 * 0.2),
        image: Arc::new(RgbImage {
            width_px,
            height_px,
            pixels,
        }),
        intrinsics: None,
        truth: None,
        odometry: None,
        imu: None,
        sensor_depth: None,
        second: None,
        is_held_out: false,
    }
}

fn kept(frames: impl IntoIterator<Item = Frame>, params: SelectParams) -> Vec<u64> {
    let mut selector = Selector::new(params);
    frames
        .into_iter()
        .filter_map(|f| selector.push(f))
        .map(|k| k.frame.seq)
        .collect()
}

#[test]
fn a_camera_at_rest_gives_one_keyframe() {
    assert_eq!(kept((0..20).map(|i| frame(i, 0.0, 1.0)), params()), [0]);
}

#[test]
fn motion_of_min_flow_makes_a_keyframe() {
    // 8 px a frame, 25.6 px needed: every fourth frame.
    assert_eq!(
        kept((0..12).map(|i| frame(i, 8.0 * i as f64, 1.0)), params()),
        [0, 4, 8]
    );
}

#[test]
fn held_out_frames_come_besides_the_others() {
    let frames = || (0..16).map(|i| frame(i, 8.0 * i as f64, 1.0));
    let select = SelectParams {
        holdout_frames: 6,
        ..params()
    };
    assert_eq!(kept(frames(), params()), [0, 4, 8, 12]);
    assert_eq!(kept(frames(), select.clone()), [0, 3, 4, 8, 9, 12, 15]);
    let mut selector = Selector::new(select);
    let held_out: Vec<u64> = frames()
        .filter_map(|f| selector.push(f))
        .filter(|k| k.frame.is_held_out)
        .map(|k| k.frame.seq)
        .collect();
    assert_eq!(held_out, [3, 9, 15]);
}

#[test]
fn a_held_out_frame_leaves_its_turn_to_the_next() {
    let select = SelectParams {
        holdout_frames: 8,
        ..params()
    };
    let frames = (0..12).map(|i| frame(i, 8.0 * i as f64, 1.0));
    assert_eq!(kept(frames, select), [0, 4, 5, 9]);
}

#[test]
fn a_blank_wall_makes_no_keyframes() {
    assert_eq!(
        kept((0..10).map(|i| frame(i, 10.0 * i as f64, 0.0)), params()),
        [0]
    );
}

#[test]
fn the_rate_cap_holds_and_select_all_overrides_it() {
    let slow = SelectParams {
        max_rate_hz: 1.0,
        ..params()
    };
    assert_eq!(
        kept(
            (0..12).map(|i| frame(i, 15.0 * i as f64, 1.0)),
            slow.clone()
        ),
        [0, 5, 10]
    );
    assert_eq!(
        kept(
            (0..4).map(|i| frame(i, 0.0, 1.0)),
            SelectParams {
                every_frame: true,
                ..slow
            }
        )
        .len(),
        4
    );
}

#[test]
fn a_blurry_frame_waits_for_a_sharper_one() {
    let frames = (0..10).map(|i| frame(i, 8.0 * i as f64, if i == 4 { 0.2 } else { 1.0 }));
    let ids = kept(
        frames,
        SelectParams {
            max_blur_wait: 0.2,
            ..params()
        },
    );
    assert_eq!(ids[..2], [0, 5], "{ids:?}");
}

#[test]
fn batches_overlap_and_the_last_one_is_short() {
    let select = SelectParams {
        every_frame: true,
        batch_size: 4,
        batch_overlap: 1,
        ..params()
    };
    let (mut selector, mut batcher) = (Selector::new(select.clone()), Batcher::new(&select));
    let mut batches: Vec<Batch> = (0..8)
        .filter_map(|i| selector.push(frame(i, 0.0, 1.0)))
        .filter_map(|k| batcher.push(k))
        .collect();
    batches.extend(batcher.finish());
    let ids: Vec<Vec<u32>> = batches
        .iter()
        .map(|b| b.keyframes.iter().map(|k| k.id).collect())
        .collect();
    assert_eq!(ids, [vec![0, 1, 2, 3], vec![3, 4, 5, 6], vec![6, 7]]);
    assert_eq!(
        batches.iter().map(|b| b.n_shared).collect::<Vec<_>>(),
        [0, 1, 1]
    );
    assert!(batcher.finish().is_none());
}

#[test]
fn depth_shows_as_parallax_but_a_turn_does_not() {
    let grid = (0..100).map(|i| [10.0 * (i % 10) as f32, 10.0 * (i / 10) as f32]);
    let turned = |p: [f32; 2]| {
        [
            0.98 * p[0] - 0.17 * p[1] + 5.0,
            0.17 * p[0] + 0.98 * p[1] - 3.0,
        ]
    };
    let turn: Vec<_> = grid.clone().map(|p| (p, turned(p))).collect();
    assert!(parallax_flow(&turn) < 1e-3);
    // A third of the tracks lies nearer and moves 6 px further.
    let near = |i: usize, p: [f32; 2]| {
        if i.is_multiple_of(3) {
            [p[0] + 6.0, p[1]]
        } else {
            p
        }
    };
    let deep: Vec<_> = grid
        .enumerate()
        .map(|(i, p)| (p, near(i, turned(p))))
        .collect();
    assert!((5.0..7.0).contains(&parallax_flow(&deep)));
    assert_eq!(parallax_flow(&[]), 0.0);
}

#[test]
fn a_faster_camera_gives_the_same_keyframes_and_is_not_followed_more_often() {
    // The same two seconds at 15 and at 60 Hz, 60 px each second.
    let at_rate = |hz: u32| {
        let one = move |i: u32| {
            let secs = f64::from(i) / f64::from(hz);
            Frame {
                stamp: Stamp::from_secs(secs),
                ..frame(u64::from(i), 60.0 * secs, 1.0)
            }
        };
        (0..2 * hz).map(one)
    };
    let [slow, fast] = [15, 60].map(|hz| kept(at_rate(hz), params()));
    assert!(slow.len() >= 4, "{slow:?}");
    assert_eq!(slow.len(), fast.len(), "{slow:?} {fast:?}");
    let followed = |hz: u32| {
        let mut selector = Selector::new(params());
        let mut stamps = Vec::new();
        for frame in at_rate(hz) {
            selector.push(frame);
            stamps.extend(selector.last.as_ref().map(|last| last.followed_secs));
        }
        stamps.dedup();
        stamps.len()
    };
    assert_eq!(followed(15), 30, "each frame");
    assert_eq!(followed(60), 40, "every third");
}

#[test]
fn all_of_few_photos_are_keyframes_but_not_the_same_one_again() {
    // 4 px is less than a frame of a camera needs; the last three are one photo.
    let shifts = [0.0, 4.0, 90.0, 200.0, 200.0, 200.3];
    let kept_of = |n_photos| {
        let mut selector = Selector::new(params()).of_photos(n_photos);
        let frames = shifts.iter().zip(0..);
        frames
            .filter_map(|(shift, seq)| selector.push(frame(seq, *shift, 1.0)))
            .map(|k| k.frame.seq)
            .collect::<Vec<_>>()
    };
    assert_eq!(kept_of(Some(6)), [0, 1, 2, 3]);
    assert_eq!(kept_of(Some(100)), [0, 1, 2, 3]);
    let of_a_camera = kept_of(None);
    assert!(of_a_camera.len() < 4, "{of_a_camera:?}");
    assert_eq!(kept_of(Some(101)), of_a_camera);
}

#[test]
fn a_keyframe_has_what_an_imu_measured_since_the_keyframe_before() {
    use glam::DVec3;
    use splat_types::inertial::{ImuModel, ImuSample, ImuSpan};
    let sample = |millis: i64| ImuSample {
        stamp: Stamp::from_nanos(millis * 1_000_000),
        angular_velocity: DVec3::ZERO,
        acceleration: DVec3::ZERO,
    };
    let with_imu = |seq: u64| {
        let at = seq as i64 * 200;
        let millis = (at - 205)..=(at + 5);
        let mut frame = frame(seq, 8.0 * seq as f64, 1.0);
        frame.imu = Some(ImuSpan {
            samples: millis.step_by(10).map(sample).collect(),
            model: ImuModel::default(),
        });
        frame
    };
    let mut selector = Selector::new(params());
    let kept: Vec<Keyframe> = (0..9)
        .filter_map(|seq| selector.push(with_imu(seq)))
        .collect();
    let spans = kept.iter().map(|keyframe| {
        let samples = &keyframe.frame.imu.as_ref().unwrap().samples;
        let ends = [samples.first(), samples.last()];
        ends.map(|s| s.unwrap().stamp.nanos / 1_000_000)
    });
    let spans: Vec<[i64; 2]> = spans.collect();
    assert_eq!(spans, [[-205, 5], [-5, 805], [795, 1605]]);
}
