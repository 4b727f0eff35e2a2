//! Frames aligned with what a geometry model has triangulated in keyframes, which have no dense depth, over a synthetic room.

use std::sync::{Arc, OnceLock};

use splat_geometry::answer::SeenLandmark;
use splat_geometry::features::descriptor::working_image;
use splat_geometry::features::orb;
use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;
use splat_slam::track::landmarks::{KeyframeView, TriangulatedLandmarks};
use splat_slam::track::params::TrackParams;
use splat_slam::track::tracker::Tracker;
use splat_types::depth::DepthMap;
use splat_types::frame::{Frame, Keyframe};
use splat_types::image::RgbImage;
use splat_types::time::Stopwatch;
use splat_types::tracking::{TrackState, TrackedFrame};
use splat_types::transform::Similarity;

/// 10 Hz, at most 2 deg from frame to frame.
const ROOM: &str = "synthetic:room?frames=60&width=320&height=240&speed=0.5";
const KEYFRAME_EVERY: usize = 4;
/// Shares of the depth of the scene, and degrees: a pixel of 320 is 0.2 deg.
const MAX_SHIFT: f64 = 0.004;
const MAX_TURN_DEG: f64 = 0.2;

fn params() -> TrackParams {
    Settings::shipped().params().unwrap().track
}

fn room() -> &'static [Frame] {
    static FRAMES: OnceLock<Vec<Frame>> = OnceLock::new();
    FRAMES.get_or_init(|| {
        let params = Settings::shipped().params().unwrap();
        let mut source = open_source::open(ROOM, &params.source, 0).unwrap();
        std::iter::from_fn(|| source.next()).collect()
    })
}

/// A keyframe without depth, with the exact places of some points, in a map that is `map_from_room`; lengths of the model are `unit`
/// of the map's.
fn view(id: usize, frame: &Frame, map_from_room: &Similarity, unit: f64) -> KeyframeView {
    let depth = frame.sensor_depth.as_ref().unwrap();
    let corners = orb::features(&working_image(&frame.image, 320), 300).pixels;
    let seen = corners.iter().enumerate().filter_map(|(ix, pixel)| {
        let to_depth = f64::from(depth.width_px) / f64::from(frame.image.width_px);
        let at = (*pixel * to_depth).as_uvec2();
        let (z, _) = depth.verified((at.y * depth.width_px + at.x) as usize)?;
        Some(SeenLandmark {
            id: (id * 1000 + ix) as u32,
            pixel: pixel.as_vec2().to_array(),
            depth: (f64::from(z) * map_from_room.scale / unit) as f32,
        })
    });
    KeyframeView {
        keyframe: Arc::new(Keyframe {
            id: id as u32,
            frame: frame.clone(),
            age: Stopwatch::start(),
        }),
        world_from_cam: map_from_room.transform_pose(&frame.truth.unwrap()),
        intrinsics: frame.intrinsics.unwrap(),
        lens: None,
        depth: Arc::new(DepthMap::none()),
        landmarks: TriangulatedLandmarks {
            seen: seen.collect(),
            unit,
        },
        covariance: None,
    }
}

fn views(frames: &[Frame], map_from_room: &Similarity) -> Vec<KeyframeView> {
    let keyframes = frames.iter().step_by(KEYFRAME_EVERY).enumerate();
    keyframes
        .map(|(id, frame)| view(id, frame, map_from_room, 1.0))
        .collect()
}

/// (shift as a share of the depth, degrees).
fn error(tracked: &TrackedFrame, frame: &Frame, map_from_room: &Similarity) -> (f64, f64) {
    let pose = tracked.pose.unwrap().world_from_cam;
    let truth = map_from_room.transform_pose(&frame.truth.unwrap());
    let depth = f64::from(frame.sensor_depth.as_ref().unwrap().median().unwrap());
    let shift = (pose.translation - truth.translation).length() / map_from_room.scale;
    (shift / depth, pose.angle_to(&truth).to_degrees())
}

fn assert_right(tracked: &TrackedFrame, frame: &Frame, map_from_room: &Similarity) {
    assert!(tracked.is_measured(), "{}: {:?}", frame.seq, tracked.reason);
    let (shift, turn) = error(tracked, frame, map_from_room);
    let is_right = shift < MAX_SHIFT && turn < MAX_TURN_DEG;
    assert!(is_right, "{}: off by {shift} and {turn} deg", frame.seq);
}

#[test]
fn frames_ahead_of_all_depth_are_where_the_triangulated_points_say() {
    let frames = room();
    let all = views(frames, &Similarity::IDENTITY);
    let mut tracker = Tracker::new(&params());
    for (i, frame) in frames.iter().enumerate() {
        // Keyframes get their pose when the camera has gone two keyframes further.
        if i % KEYFRAME_EVERY == 0 {
            let known = (i / KEYFRAME_EVERY).saturating_sub(1).min(all.len());
            tracker.update(&all[..known]);
        }
        let tracked = tracker.track(frame);
        // Three keyframes say how long odometry's unit is.
        if i >= 5 * KEYFRAME_EVERY {
            assert_right(&tracked, frame, &Similarity::IDENTITY);
        }
    }
}

#[test]
fn a_camera_that_jumps_a_second_ahead_is_found_beside_the_newest_keyframe() {
    let frames = room();
    let all = views(frames, &Similarity::IDENTITY);
    let mut tracker = Tracker::new(&params());
    for (i, frame) in frames[..32].iter().enumerate() {
        if i % KEYFRAME_EVERY == 0 {
            tracker.update(&all[..i / KEYFRAME_EVERY]);
        }
        tracker.track(frame);
    }
    // Some 15 deg on, where odometry has lost all that it followed.
    tracker.update(&all[..10]);
    let tracked = tracker.track(&frames[42]);
    assert_right(&tracked, &frames[42], &Similarity::IDENTITY);
}

#[test]
fn poses_follow_a_map_that_is_moved_and_rescaled() {
    let frames = room();
    let moved = Similarity {
        scale: 2.5,
        rotation: glam::DQuat::from_rotation_y(0.8),
        translation: glam::DVec3::new(3.0, -1.0, 2.0),
    };
    let all = views(frames, &Similarity::IDENTITY);
    let mut tracker = Tracker::new(&params());
    for (i, frame) in frames[..40].iter().enumerate() {
        if i == 32 {
            let keyframes = frames.iter().step_by(KEYFRAME_EVERY).enumerate().take(8);
            let rescaled = keyframes.map(|(id, frame)| {
                let unit = moved.scale;
                KeyframeView {
                    // The same points as before, in a longer unit.
                    landmarks: TriangulatedLandmarks {
                        seen: Arc::clone(&all[id].landmarks.seen),
                        unit,
                    },
                    ..view(id, frame, &moved, unit)
                }
            });
            tracker.update(&rescaled.collect::<Vec<_>>());
        } else if i % KEYFRAME_EVERY == 0 && i < 32 {
            tracker.update(&all[..i / KEYFRAME_EVERY]);
        }
        let tracked = tracker.track(frame);
        if i > 32 {
            assert_right(&tracked, frame, &moved);
        }
    }
}

#[test]
fn the_dark_and_another_world_align_with_nothing() {
    let frames = room();
    let all = views(frames, &Similarity::IDENTITY);
    let params = Settings::shipped().params().unwrap();
    let facade = "synthetic:facade?frames=6&width=320&height=240&speed=0.5";
    let mut facade = open_source::open(facade, &params.source, 0).unwrap();
    let other = facade.next().unwrap();
    let mut tracker = Tracker::new(&params.track);
    tracker.update(&all[..8]);
    for frame in &frames[..30] {
        tracker.track(frame);
    }
    assert_eq!(tracker.state(), TrackState::Tracking);
    let black = RgbImage {
        pixels: vec![0; other.image.pixels.len()],
        ..(*other.image).clone()
    };
    for (k, image) in [other.image, Arc::new(black)].into_iter().enumerate() {
        let frame = Frame {
            image,
            ..frames[30 + k].clone()
        };
        let tracked = tracker.track(&frame);
        assert!(!tracked.is_measured(), "{k}: {tracked:?}");
    }
}
