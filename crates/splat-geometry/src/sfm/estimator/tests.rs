//! Synthetic points with exact projections and perfect descriptors: what is left to go wrong is geometry.

use glam::{DQuat, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::features::descriptor::{Descriptors, Features};
use crate::sfm::estimator::*;
use crate::sfm::feature_depths::FeatureDepths;
use crate::sfm::merge_submaps;
use crate::sfm::reconstruction::distorted;
use crate::sfm::updates::NO_PARALLAX;
use splat_types::camera::Distortion;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::Rigid;

const SIZE: (u32, u32) = (640, 480);

fn camera() -> Intrinsics {
    Intrinsics {
        width_px: SIZE.0,
        height_px: SIZE.1,
        fx: 500.0,
        fy: 500.0,
        cx: 320.0,
        cy: 240.0,
    }
}

struct World {
    points: Vec<DVec3>,
    descriptors: Vec<[u64; 4]>,
    rng: Pcg32,
    /// Of the lens that sees it.
    radial: f64,
    /// Distances along the axis of what was seen last.
    depths: Vec<f64>,
}

impl World {
    fn new(n: usize, mut point: impl FnMut(&mut Pcg32) -> DVec3) -> Self {
        let mut rng = Pcg32::seed_from_u64(7);
        let points = (0..n).map(|_| point(&mut rng)).collect();
        let descriptors = (0..n).map(|_| rng.random()).collect();
        Self {
            points,
            descriptors,
            rng,
            radial: 0.0,
            depths: Vec::new(),
        }
    }

    /// What a camera sees, with 0.3 px of noise and every tenth descriptor on the wrong point.
    fn seen_from(&mut self, world_from_cam: &Rigid) -> Features {
        let cam_from_world = world_from_cam.inverse();
        let mut out = Features::default();
        let mut descriptors = Vec::new();
        self.depths.clear();
        for i in 0..self.points.len() {
            let lens = distorted(&camera(), self.radial);
            let Some(pixel) = lens.project(cam_from_world.transform_point(self.points[i])) else {
                continue;
            };
            let inside = pixel.cmpge(DVec2::ZERO).all() && pixel.x < 640.0 && pixel.y < 480.0;
            if inside {
                let noise = DVec2::new(
                    self.rng.random_range(-0.5..0.5),
                    self.rng.random_range(-0.5..0.5),
                );
                let named = if i % 10 == 0 {
                    self.rng.random_range(0..self.points.len())
                } else {
                    i
                };
                out.pixels.push(pixel + noise);
                out.sigmas.push(2.0);
                let point_in_cam = cam_from_world.transform_point(self.points[i]);
                self.depths.push(point_in_cam.z);
                descriptors.push(self.descriptors[named]);
            }
        }
        out.descriptors = Descriptors::Orb(descriptors);
        out
    }
}

fn cloud() -> World {
    World::new(900, |rng| {
        DVec3::from_array([(); 3].map(|()| rng.random_range(-2.0..2.0))) + DVec3::Z * 5.0
    })
}

/// Cameras on an arc round the cloud, looking at its middle.
fn arc(n: usize, from_deg: f64, to_deg: f64) -> Vec<Rigid> {
    let at = |i: usize| {
        let angle = (from_deg + (to_deg - from_deg) * i as f64 / (n - 1) as f64).to_radians();
        let rotation = DQuat::from_rotation_y(-angle);
        Rigid::new(
            rotation,
            DVec3::Z * 5.0 - rotation * DVec3::Z * (5.0 + 0.3 * (i % 3) as f64),
        )
    };
    (0..n).map(at).collect()
}

fn run(world: &mut World, poses: &[Rigid], intrinsics: Option<Intrinsics>) -> (Sfm, SparseBatch) {
    run_measuring(world, poses, intrinsics, |_, _| None)
}

/// `measure` gives what a sensor measures of features at some distances, in a keyframe.
fn run_measuring(
    world: &mut World,
    poses: &[Rigid],
    intrinsics: Option<Intrinsics>,
    mut measure: impl FnMut(usize, &[f64]) -> Option<FeatureDepths>,
) -> (Sfm, SparseBatch) {
    let mut sfm = Sfm::new(&SfmParams::default(), &MvsParams::default(), 1).unwrap();
    let image = Arc::new(RgbImage {
        width_px: SIZE.0,
        height_px: SIZE.1,
        pixels: vec![0; 640 * 480 * 3],
    });
    for (id, pose) in poses.iter().enumerate() {
        let stamp = Stamp::from_secs(id as f64);
        let frame = Frame {
            seq: id as u64,
            stamp,
            image: Arc::clone(&image),
            intrinsics,
            truth: None,
            odometry: None,
            imu: None,
            sensor_depth: None,
            second: None,
            is_held_out: false,
        };
        let features = world.seen_from(pose);
        let found = Found {
            features,
            size: SIZE,
            measured: measure(id, &world.depths),
        };
        sfm.push(
            &Arc::new(Keyframe {
                id: id as u32,
                frame,
                age: Stopwatch::start(),
            }),
            found,
        );
        let limits = sfm.limits(&[]);
        link_recent(&mut sfm.scene, id, limits.max_error_px, 1);
        link_older(&mut sfm.scene, id, limits.max_error_px, 1);
        if id % 6 == 5 {
            let waiting = sfm.waiting();
            sfm.place_waiting(&waiting, &limits, MIN_NEW_SUBMAP);
        }
    }
    let out = sfm.finish_sparse();
    (sfm, out)
}

/// Largest rotation error and largest position error as a share of the mean distance, relative to the first pose.
fn worst(out: &SparseBatch, truth: &[Rigid]) -> (f64, f64) {
    let own: Vec<(usize, Rigid)> = out
        .views
        .iter()
        .map(|v| (v.keyframe_id as usize, v.submap_from_cam))
        .collect();
    let first = own[0];
    let relative = |a: &Rigid, b: &Rigid| a.inverse() * *b;
    let pairs: Vec<(Rigid, Rigid)> = own
        .iter()
        .map(|(i, p)| (relative(&truth[first.0], &truth[*i]), relative(&first.1, p)))
        .collect();
    let length = |f: fn(&(Rigid, Rigid)) -> Rigid| {
        pairs.iter().map(|p| f(p).translation.length()).sum::<f64>()
    };
    let (size, scale) = (length(|p| p.0), length(|p| p.0) / length(|p| p.1));
    let turned = pairs
        .iter()
        .map(|(t, o)| t.angle_to(o).to_degrees())
        .fold(0.0, f64::max);
    let off = pairs
        .iter()
        .map(|(t, o)| t.translation.distance(o.translation * scale))
        .fold(0.0, f64::max);
    (turned, off / size * pairs.len() as f64)
}

#[test]
fn a_cloud_seen_along_an_arc_is_rebuilt() {
    let poses = arc(18, 0.0, 90.0);
    let (sfm, out) = run(&mut cloud(), &poses, Some(camera()));
    assert_eq!((out.views.len(), out.note.as_ref()), (18, None));
    let (turned, off) = worst(&out, &poses);
    assert!(turned < 0.15 && off < 0.01, "{turned} deg, {off}");
    let depth = crate::stats::median(&mut sfm.scene.depths(sfm.scene.submaps[0].views[0])).unwrap();
    assert!(
        (depth - 1.0).abs() < 0.1,
        "median depth {depth} in the first view"
    );
}

/// The reconstruction of an arc, whose poses and landmarks were pushed about: all but those of the first view.
fn disturbed(poses: &[Rigid]) -> Sfm {
    let (mut sfm, _) = run(&mut cloud(), poses, Some(camera()));
    let first = sfm.scene.submaps[0].views[0];
    let mut rng = Pcg32::seed_from_u64(3);
    let mut push = |size: f64| DVec3::from_array([(); 3].map(|()| rng.random_range(-size..size)));
    for (ix, view) in sfm.scene.views.iter_mut().enumerate() {
        if let Some(registered) = view.registered.as_mut().filter(|_| ix != first) {
            let motion = Rigid::exp(push(0.004), push(0.002));
            registered.cam_from_world = motion * registered.cam_from_world;
        }
    }
    for landmark in &mut sfm.scene.landmarks {
        landmark.point += push(0.004);
    }
    sfm
}

fn errors(sfm: &mut Sfm, truth: &[Rigid]) -> (f64, f64) {
    sfm.reported = Reported::default();
    worst(&sfm.report(&[]), truth)
}

#[test]
fn all_are_adjusted_apart_while_the_scene_goes_on() {
    let poses = arc(18, 0.0, 90.0);
    let mut sfm = disturbed(&poses);
    let before = errors(&mut sfm, &poses);
    // The last two come while the adjustment of the others is at work, where these have led them.
    let late = sfm.scene.submaps[0].views.split_off(16);
    let parted: Vec<_> = late
        .iter()
        .map(|view| sfm.scene.views[*view].registered)
        .collect();
    late.iter()
        .for_each(|view| sfm.scene.views[*view].registered = None);
    let work = GlobalAdjustment::of(&mut sfm.scene, 0, 2.0, 30).unwrap();
    for (view, registered) in late.iter().zip(parted) {
        sfm.scene.views[*view].registered = registered;
        sfm.scene.submaps[0].views.push(*view);
    }
    let limits = sfm.newest_limits();
    let (n_before, adjusted) = (sfm.scene.n_rebuilt, work.run());
    assert!(adjusted.apply(&mut sfm.scene, &limits));
    assert!(sfm.scene.n_rebuilt > n_before);
    let after = errors(&mut sfm, &poses);
    assert!(
        before.0 > 0.2 && before.1 > 0.002,
        "disturbed by {before:?}"
    );
    assert!(
        after.0 < 0.7 * before.0 && after.1 < 0.85 * before.1,
        "{before:?} -> {after:?}"
    );
    assert!(!adjusted.apply(&mut sfm.scene, &limits), "it counts once");
}

#[test]
fn what_was_adjusted_apart_is_dropped_where_the_scene_was_rebuilt() {
    let poses = arc(12, 0.0, 60.0);
    let mut sfm = disturbed(&poses);
    let work = GlobalAdjustment::of(&mut sfm.scene, 0, 2.0, 8).unwrap();
    adjust_global(&mut sfm.scene, 0, 2.0, 8);
    let limits = sfm.newest_limits();
    let poses_there: Vec<_> = sfm
        .scene
        .views
        .iter()
        .map(|v| v.registered.map(|p| p.cam_from_world))
        .collect();
    assert!(!work.run().apply(&mut sfm.scene, &limits));
    let same = sfm
        .scene
        .views
        .iter()
        .map(|v| v.registered.map(|p| p.cam_from_world));
    assert!(same.eq(poses_there));
}

#[test]
fn an_unknown_focal_length_is_found_with_the_poses() {
    let poses = arc(18, 0.0, 90.0);
    let (_, out) = run(&mut cloud(), &poses, None);
    assert_eq!(out.views.len(), 18);
    let focal = out.views[17].intrinsics.fx;
    assert!((focal / 500.0 - 1.0).abs() < 0.01, "{focal} instead of 500");
    assert!(worst(&out, &poses).0 < 0.3);
}

#[test]
fn a_lens_that_bends_is_found_with_the_focal_length() {
    let poses = arc(18, 0.0, 90.0);
    let mut world = cloud();
    world.radial = -0.15;
    let (_, out) = run(&mut world, &poses, None);
    assert_eq!(out.views.len(), 18);
    let (turned, off) = worst(&out, &poses);
    assert!(turned < 0.3 && off < 0.02, "{turned} deg, {off}");
    for view in &out.views {
        let lens = view.lens.unwrap();
        let Distortion::PlumbBob([radial, ..]) = lens.distortion else {
            panic!("{lens:?}")
        };
        assert!((radial / -0.15 - 1.0).abs() < 0.05, "{radial}");
        assert!((lens.intrinsics.fx / 500.0 - 1.0).abs() < 0.01, "{lens:?}");
        // Landmarks project to their pixels in the straight image.
        let errors = view.landmarks.iter().map(|l| {
            let in_cam = view
                .submap_from_cam
                .inverse()
                .transform_point(l.point_in_submap);
            view.intrinsics.project(in_cam).unwrap().distance(l.pixel)
        });
        let mut errors: Vec<f64> = errors.collect();
        let median = crate::stats::median(&mut errors).unwrap();
        assert!(median < 0.6, "{median} px");
    }
}

#[test]
fn a_pinhole_is_not_given_a_lens_that_bends() {
    let (sfm, out) = run(&mut cloud(), &arc(18, 0.0, 90.0), None);
    assert!(out.views.iter().all(|v| v.lens.is_none()));
    assert_eq!(sfm.scene.radial, 0.0);
}

#[test]
fn a_camera_that_only_turns_places_nothing() {
    let poses: Vec<Rigid> = (0..12)
        .map(|i| Rigid::new(DQuat::from_rotation_y(0.04 * f64::from(i)), DVec3::ZERO))
        .collect();
    for intrinsics in [Some(camera()), None] {
        let (_, out) = run(&mut cloud(), &poses, intrinsics);
        assert!(
            out.views.is_empty(),
            "{} views with {intrinsics:?}",
            out.views.len()
        );
        assert!(out.note.is_some_and(|note| note.contains(NO_PARALLAX)));
    }
}

#[test]
fn a_plane_is_registered_right_or_not_at_all() {
    let wall = || {
        World::new(900, |rng| {
            DVec3::new(
                rng.random_range(-4.0..4.0),
                rng.random_range(-3.0..3.0),
                5.0,
            )
        })
    };
    let poses = arc(12, -20.0, 20.0);
    let (_, out) = run(&mut wall(), &poses, Some(camera()));
    if !out.views.is_empty() {
        let (turned, off) = worst(&out, &poses);
        assert!(turned < 0.5 && off < 0.05, "{turned} deg, {off}");
    }
    let (_, out) = run(&mut wall(), &poses, None);
    assert!(
        out.views.is_empty(),
        "one plane gives no focal length, yet {} views",
        out.views.len()
    );
}

#[test]
fn two_parts_become_one_when_a_bridge_comes() {
    // Two clouds side by side; the first cameras see one, the next the other, the last both.
    let mut world = World::new(1600, |rng| {
        let side = if rng.random_range(0..2) == 0 {
            -4.0
        } else {
            4.0
        };
        DVec3::from_array([(); 3].map(|()| rng.random_range(-2.0..2.0)))
            + DVec3::new(side, 0.0, 8.0)
    });
    let near = |x: f64, i: usize| {
        Rigid::new(
            DQuat::IDENTITY,
            DVec3::new(x + 0.4 * i as f64 - 1.0, 0.2 * (i % 2) as f64, 1.5),
        )
    };
    let mut poses: Vec<Rigid> = (0..6)
        .map(|i| near(-4.0, i))
        .chain((0..6).map(|i| near(4.0, i)))
        .collect();
    let (_, apart) = run(&mut world, &poses, Some(camera()));
    let parts: std::collections::BTreeSet<u32> = apart.views.iter().map(|v| v.submap).collect();
    assert_eq!((apart.views.len(), parts.len()), (12, 2));
    assert!(apart.note.is_some_and(|n| n.contains("2 parts")));
    poses.extend((0..6).map(|i| {
        Rigid::new(
            DQuat::IDENTITY,
            DVec3::new(0.5 * f64::from(i) - 1.2, 0.3, -6.0),
        )
    }));
    let (_, out) = run(&mut world, &poses, Some(camera()));
    let parts: std::collections::BTreeSet<u32> = out.views.iter().map(|v| v.submap).collect();
    assert_eq!((out.views.len(), parts.len()), (18, 1), "{:?}", out.note);
    let (turned, off) = worst(&out, &poses);
    assert!(turned < 0.3 && off < 0.02, "{turned} deg, {off}");
}

#[test]
fn parts_join_only_where_half_of_what_they_share_agrees() {
    let (sfm, _) = run(&mut cloud(), &arc(6, -15.0, 15.0), Some(camera()));
    let views = &sfm.scene.submaps[0].views;
    let landmarks = sfm.scene.landmarks_of(views);
    // Of ten, so many are the same in both parts; the others are anything.
    let joins = |n_same: usize| {
        let other = |ix: usize| landmarks[(7 * ix + 100) % landmarks.len()];
        let pairs: Vec<(u32, u32)> = (0..landmarks.len())
            .map(|ix| {
                (
                    landmarks[ix],
                    if ix % 10 < n_same {
                        landmarks[ix]
                    } else {
                        other(ix)
                    },
                )
            })
            .collect();
        merge_submaps::similarity(&sfm.scene, &pairs, &sfm.limits(&[]), 1).is_some()
    };
    assert_eq!([7, 6, 4, 3].map(joins), [true, true, false, false]);
}

#[test]
fn equal_input_gives_equal_poses() {
    let poses = arc(8, 0.0, 40.0);
    let reported = || {
        run(&mut cloud(), &poses, None)
            .1
            .views
            .iter()
            .map(|v| v.submap_from_cam)
            .collect::<Vec<_>>()
    };
    assert_eq!(reported(), reported());
}

#[test]
fn blank_tiny_and_broken_images_are_survived() {
    let mut sfm = Sfm::new(&SfmParams::default(), &MvsParams::default(), 1).unwrap();
    let rgb_image = |id: u32, width_px: u32, height_px: u32, n: usize| {
        let image = Arc::new(RgbImage {
            width_px,
            height_px,
            pixels: vec![90; n],
        });
        let frame = Frame {
            seq: 0,
            stamp: Stamp::from_secs(f64::from(id)),
            image,
            intrinsics: None,
            truth: None,
            odometry: None,
            imu: None,
            sensor_depth: None,
            second: None,
            is_held_out: false,
        };
        Arc::new(Keyframe {
            id,
            frame,
            age: Stopwatch::start(),
        })
    };
    let keyframes = vec![
        rgb_image(0, 200, 100, 60_000),
        rgb_image(1, 1, 1, 3),
        rgb_image(2, 0, 0, 0),
        rgb_image(3, 300, 200, 17),
    ];
    let out = sfm
        .infer(&Batch {
            id: 0,
            n_shared: 0,
            keyframes,
        })
        .unwrap();
    assert!(out.views.is_empty() && out.note.is_some_and(|n| n.contains(NO_PARALLAX)));
    assert!(sfm.finish().unwrap().views.is_empty());
}

mod measured;
