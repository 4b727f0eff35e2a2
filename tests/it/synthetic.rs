//! Synthetic scenes: images, poses and depth agree, and are rich enough to map.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use splat_synth::settings::{SceneKind, SynthSettings};
use splat_synth::take::Take;
use splat_types::camera::{CameraModel, Distortion};
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;

const SCENES: [SceneKind; 3] = [SceneKind::Room, SceneKind::Facade, SceneKind::Corridor];

fn take(options: &str) -> Take {
    Take::new(SynthSettings::parse(options).unwrap()).unwrap()
}

pub fn colour(image: &RgbImage, pixel: DVec2) -> Option<DVec3> {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let place = pixel - 0.5;
    if place.min_element() < 0.0 || place.x >= width as f64 - 1.0 || place.y >= height as f64 - 1.0
    {
        return None;
    }
    let (x, y) = (place.x as usize, place.y as usize);
    let at = |x: usize, y: usize| {
        let pixel = &image.pixels[3 * (y * width + x)..][..3];
        DVec3::new(
            f64::from(pixel[0]),
            f64::from(pixel[1]),
            f64::from(pixel[2]),
        )
    };
    let above = at(x, y).lerp(at(x + 1, y), place.x.fract());
    let below = at(x, y + 1).lerp(at(x + 1, y + 1), place.x.fract());
    Some(above.lerp(below, place.y.fract()))
}

fn nearest(map: &DepthMap, pixel: DVec2) -> f64 {
    f64::from(map.depth[pixel.y as usize * map.width_px as usize + pixel.x as usize])
}

pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn spread(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}

/// Carries every fourth pixel of one frame into another by depth and poses.
/// Gives the share of points seen in both, and the median difference of their colours in levels.
fn carry_over(take: &Take, from: u32, to: u32, pose_of_to: u32) -> (f64, f64) {
    let camera = take.settings().lens().intrinsics;
    let (image, other) = (take.image(from), take.image(to));
    let (depth, other_depth) = (take.depth(from, &camera), take.depth(to, &camera));
    let to_from_from = take.pose(pose_of_to).inverse() * take.pose(from);
    let (mut inside, mut differences) = (0, Vec::new());
    for y in (1..camera.height_px - 1).step_by(2) {
        for x in (1..camera.width_px - 1).step_by(2) {
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let distance = nearest(&depth, pixel);
            let point = to_from_from.transform_point(camera.ray_in_cam(pixel) * distance);
            let Some(there) = camera.project(point).filter(|_| distance > 0.0) else {
                continue;
            };
            let Some(colour_there) = colour(&other, there) else {
                continue;
            };
            inside += 1;
            // One pixel of a slanted wall spans a few centimetres of depth.
            if (nearest(&other_depth, there) - point.z).abs() < 0.02 * point.z {
                let here = colour(&image, pixel).unwrap();
                differences.push((here - colour_there).abs().max_element());
            }
        }
    }
    (
        differences.len() as f64 / f64::from(inside),
        median(differences),
    )
}

#[test]
fn depth_and_poses_carry_one_frame_onto_another() {
    for scene in ["room", "facade", "corridor"] {
        let take = take(&format!("{scene}?width=320&height=240"));
        let (seen, difference) = carry_over(&take, 20, 25, 25);
        let (_, wrong) = carry_over(&take, 20, 25, 26);
        eprintln!(
            "{scene}: seen {seen:.3}, colours differ by {difference:.1}, with the next pose by {wrong:.1}"
        );
        assert!(seen > 0.7, "{scene}: {seen}");
        assert!(
            difference < 8.0 && difference < 0.6 * wrong,
            "{scene}: {difference} levels, wrong pose {wrong}"
        );
    }
}

/// Where the ROS models put a point of the plane z = 1, written out once more from their definitions.
fn shown(lens: &CameraModel, at: DVec2) -> DVec2 {
    let distorted = match lens.distortion {
        Distortion::PlumbBob([k1, k2, p1, p2, k3]) => {
            let (x, y, r2) = (at.x, at.y, at.length_squared());
            let radial = 1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3);
            DVec2::new(
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            )
        }
        Distortion::Equidistant([k1, k2, k3, k4]) => {
            let angle = at.length().atan();
            let distorted_image = angle
                + k1 * angle.powi(3)
                + k2 * angle.powi(5)
                + k3 * angle.powi(7)
                + k4 * angle.powi(9);
            at * distorted_image / at.length()
        }
        _ => at,
    };
    let i = lens.intrinsics;
    DVec2::new(i.fx * distorted.x + i.cx, i.fy * distorted.y + i.cy)
}

#[test]
fn every_lens_shows_the_same_world() {
    let straight = take("room?width=320&height=240");
    let image = straight.image(7);
    let camera = straight.settings().lens().intrinsics;
    for options in [
        "room?width=480&height=360&lens=radial",
        "room?width=640&height=480&lens=fisheye",
    ] {
        let distorted = take(options);
        let lens = distorted.settings().lens();
        let distorted_image = distorted.image(7);
        let compare = |shift: f64| {
            let mut differences = Vec::new();
            for y in (2..238).step_by(3) {
                for x in (2..318).step_by(3) {
                    let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    let place = shown(&lens, camera.ray_in_cam(pixel).truncate()) + shift;
                    if let Some(there) = colour(&distorted_image, place) {
                        differences
                            .push((colour(&image, pixel).unwrap() - there).abs().max_element());
                    }
                }
            }
            assert!(
                differences.len() > 5000,
                "{options}: only {} pixels in both",
                differences.len()
            );
            median(differences)
        };
        let (difference, beside) = (compare(0.0), compare(2.0));
        eprintln!("{options}: {difference:.1} levels, two pixels beside {beside:.1}");
        assert!(
            difference < 10.0 && difference < 0.75 * beside,
            "{options}: {difference}, beside {beside}"
        );
    }
}

#[test]
fn a_seed_repeats_everything_and_another_one_changes_noise_and_hand() {
    let options = "corridor?width=96&height=64&noise=4&blur=0.3&exposure=0.3";
    let [first, again, other] = [7, 7, 8].map(|seed| take(&format!("{options}&seed={seed}")));
    assert_eq!(first.image(3), again.image(3));
    assert_eq!(first.pose(3), again.pose(3));
    assert_ne!(first.image(3), other.image(3));
    let apart = first
        .pose(3)
        .translation
        .distance(other.pose(3).translation);
    assert!(apart > 1e-4 && apart < 0.2, "{apart}");
}

/// FAST-9 (Rosten and Drummond 2006): pixels with nine neighbours in a row on a circle that are all brighter, or all
/// darker, and no such pixel of a larger margin beside them.
fn fast_corners(grey: &[i16], width: usize) -> Vec<(usize, usize)> {
    /// The usual threshold of ORB.
    const THRESHOLD: i16 = 20;
    const CIRCLE: [(isize, isize); 16] = [
        (0, -3),
        (1, -3),
        (2, -2),
        (3, -1),
        (3, 0),
        (3, 1),
        (2, 2),
        (1, 3),
        (0, 3),
        (-1, 3),
        (-2, 2),
        (-3, 1),
        (-3, 0),
        (-3, -1),
        (-2, -2),
        (-1, -3),
    ];
    let height = grey.len() / width;
    let offsets = CIRCLE.map(|(x, y)| y * width as isize + x);
    // The largest threshold at which the pixel is still a corner.
    let margin = |p: usize| {
        let steps = offsets.map(|offset| grey[p.strict_add_signed(offset)] - grey[p]);
        let arc = |sign: i16, first: usize| (0..9).map(|k| sign * steps[(first + k) % 16]).min();
        let arcs = (0..16).flat_map(|first| [arc(1, first), arc(-1, first)]);
        arcs.flatten().max().unwrap()
    };
    let mut margins = vec![0; grey.len()];
    for y in 3..height - 3 {
        let inside = y * width + 3..(y + 1) * width - 3;
        for (p, slot) in inside.clone().zip(&mut margins[inside]) {
            *slot = margin(p);
        }
    }
    let is_corner = |p: &usize| {
        let beside = [1, width - 1, width, width + 1];
        let is_largest = |d: usize| margins[*p] > margins[p - d] && margins[*p] >= margins[p + d];
        margins[*p] > THRESHOLD && beside.into_iter().all(is_largest)
    };
    (0..grey.len())
        .filter(is_corner)
        .map(|p| (p % width, p / width))
        .collect()
}

#[test]
fn a_feature_detector_finds_many_corners_all_over_every_frame() {
    for scene in SCENES {
        let take = Take::new(SynthSettings::of(scene)).unwrap();
        for ix in [0, 40, 80] {
            let image = take.image(ix);
            let grey = image.pixels.chunks(3).map(|p| {
                ((77 * i32::from(p[0]) + 150 * i32::from(p[1]) + 29 * i32::from(p[2])) >> 8) as i16
            });
            let corners = fast_corners(&grey.collect::<Vec<_>>(), 640);
            let mut cells = BTreeMap::new();
            for (x, y) in &corners {
                *cells.entry((y / 60, x / 80)).or_insert(0) += 1;
            }
            let full = cells.values().filter(|n| **n >= 5).count();
            eprintln!(
                "{scene:?} {ix}: {} corners, {full} of 64 cells",
                corners.len()
            );
            assert!(
                corners.len() >= 1000 && full >= 40,
                "{scene:?} {ix}: {} corners, {full} cells",
                corners.len()
            );
        }
    }
}

#[test]
fn the_camera_moves_smoothly_and_comes_back() {
    for scene in SCENES {
        let take = Take::new(SynthSettings::of(scene)).unwrap();
        let steps = (0..120).map(|ix| {
            let motion = take.pose(ix).inverse() * take.pose(ix + 1);
            (
                motion.translation.length(),
                take.pose(ix).angle_to(&take.pose(ix + 1)).to_degrees(),
            )
        });
        let (far, wide) = steps.fold((0.0_f64, 0.0_f64), |(a, b), (c, d)| (a.max(c), b.max(d)));
        eprintln!("{scene:?}: at most {far:.2} m and {wide:.1} degrees between frames");
        assert!(
            far < 0.35 && wide < 16.0,
            "{scene:?}: a step of {far} m, a turn of {wide} degrees"
        );
        let travelled = (0..120)
            .map(|ix| take.pose(ix).translation.distance(take.pose(0).translation))
            .fold(0.0, f64::max);
        assert!(travelled > 2.0, "{scene:?}: {travelled}");
        assert!(
            take.pose(0)
                .translation
                .distance(take.pose(120).translation)
                < 0.2,
            "{scene:?}"
        );
        let up = take.pose(0).rotation * DVec3::NEG_Y;
        assert!(up.z > 0.9, "{scene:?}: the top of the image points to {up}");
    }
}

#[test]
fn noise_has_the_spread_that_was_asked_for() {
    let size = "room?width=160&height=120";
    let (clean, noisy) = (
        take(size).image(2),
        take(&format!("{size}&noise=5")).image(2),
    );
    // Only mid tones: black and white clip one side of the noise.
    let pairs = clean
        .pixels
        .iter()
        .zip(&noisy.pixels)
        .filter(|(c, _)| (40..215).contains(*c));
    let found = spread(pairs.map(|(c, n)| f64::from(*n) - f64::from(*c)));
    assert!((found - 5.0).abs() < 0.2, "{found}");
}

#[test]
fn exposure_drifts_by_the_stops_that_were_asked_for() {
    let size = "room?width=64&height=48";
    let (fixed, drifting) = (take(size), take(&format!("{size}&exposure=0.5&speed=0")));
    let mean = |image: &RgbImage| {
        image.pixels.iter().map(|v| f64::from(*v)).sum::<f64>() / image.pixels.len() as f64
    };
    let fixed = mean(&fixed.image(0));
    let over_time: Vec<f64> = (0..83)
        .step_by(4)
        .map(|ix| mean(&drifting.image(ix)))
        .collect();
    let (low, high) = over_time
        .iter()
        .fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    assert!(
        low < 0.92 * fixed && high > 1.06 * fixed,
        "{low} to {high} about {fixed}"
    );
}

#[test]
fn blur_softens_what_moves_and_nothing_else() {
    let detail = |options: &str| {
        let image = take(&format!("room?width=160&height=120{options}")).image(31);
        image
            .pixels
            .chunks(3 * 160)
            .flat_map(|row| row.windows(4))
            .map(|w| f64::from(w[0].abs_diff(w[3])))
            .sum::<f64>()
    };
    let (sharp, blurred) = (detail("&speed=2"), detail("&speed=2&blur=1"));
    assert!(blurred < 0.75 * sharp, "{blurred} of {sharp}");
    let (still, open) = (detail("&speed=0"), detail("&speed=0&blur=1"));
    assert!(open > 0.9 * still, "{open} of {still}");
}

/// Share of the pixels that are another colour by more than noise.
fn changed(a: &RgbImage, b: &RgbImage) -> f64 {
    let pixels = a.pixels.chunks_exact(3).zip(b.pixels.chunks_exact(3));
    let is_other = |(p, q): &(&[u8], &[u8])| p.iter().zip(*q).any(|(a, b)| a.abs_diff(*b) > 12);
    pixels.filter(is_other).count() as f64 / (a.pixels.len() / 3) as f64
}

#[test]
fn movers_are_somewhere_else_in_each_image_and_every_tenth_has_none() {
    let film = |movers: u32| {
        let mut settings = SynthSettings::of(SceneKind::Room);
        (settings.width_px, settings.height_px, settings.movers) = (80, 60, movers);
        Take::new(settings).unwrap()
    };
    let (clean, cluttered) = (film(0), film(3));
    for ix in [5, 15] {
        assert_eq!(clean.image(ix), cluttered.image(ix), "{ix}");
    }
    let shares: Vec<f64> = [0, 1, 2, 6, 7]
        .iter()
        .map(|ix| changed(&clean.image(*ix), &cluttered.image(*ix)))
        .collect();
    assert!(shares.iter().all(|s| (0.01..0.3).contains(s)), "{shares:?}");
    let intrinsics = clean.settings().lens().intrinsics;
    assert_eq!(clean.depth(1, &intrinsics), cluttered.depth(1, &intrinsics));
}
