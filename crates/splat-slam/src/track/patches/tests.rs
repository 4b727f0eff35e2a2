//! Patches of a textured wall, seen from where is exactly known.

use super::*;

const CAMERA: WorkingCamera = WorkingCamera {
    pinhole: Intrinsics {
        width_px: 240,
        height_px: 180,
        fx: 200.0,
        fy: 200.0,
        cx: 120.0,
        cy: 90.0,
    },
    lens: None,
};
/// Of the wall that the images show, which faces the keyframe.
const DEPTH: f64 = 2.0;

/// Smooth noise, `1 / period` cells to a unit.
fn noise(x: f64, y: f64, period: f64) -> f32 {
    let (x, y) = (x / period, y / period);
    let corner = |dx: f64, dy: f64| {
        let (i, j) = ((x.floor() + dx) as i64, (y.floor() + dy) as i64);
        let mixed = (i.wrapping_mul(0x9E37_79B9) ^ j.wrapping_mul(0x85EB_CA6B)) as u64;
        let mixed = (mixed ^ (mixed >> 15)).wrapping_mul(0x2C1B_3C6D_297A_2D39);
        ((mixed >> 40) & 0xFFFF) as f64 / 65535.0
    };
    let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
    let (u, v) = (smooth(x - x.floor()), smooth(y - y.floor()));
    let above = corner(0.0, 0.0) * (1.0 - u) + corner(1.0, 0.0) * u;
    let below = corner(0.0, 1.0) * (1.0 - u) + corner(1.0, 1.0) * u;
    (above * (1.0 - v) + below * v) as f32
}

fn paint(p: DVec3) -> f32 {
    0.1 + 0.2 * noise(p.x, p.y, 0.04) + 0.5 * noise(p.x, p.y, 0.17)
}

/// The wall, seen from a camera.
fn image(cam_from_key: &Rigid, brighter: f32) -> Pyramid {
    let key_from_cam = cam_from_key.inverse();
    let (width, height) = (240, 180);
    let value = |i: usize| {
        let pixel = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let ray = key_from_cam.rotation * CAMERA.pinhole.ray_in_cam(pixel);
        let far = (DEPTH - key_from_cam.translation.z) / ray.z;
        paint(key_from_cam.translation + ray * far) + brighter
    };
    let values = (0..width * height).map(value).collect();
    let image = GreyImage {
        width,
        height,
        values,
    };
    Pyramid::new(image, 2)
}

fn points(image: &Pyramid) -> Vec<MapPoint> {
    let pixels = (0..40).map(|i| {
        DVec2::new(
            40.3 + 22.0 * f64::from(i % 8),
            40.7 + 25.0 * f64::from(i / 8),
        )
    });
    let point = |(id, pixel): (usize, DVec2)| {
        let at = (pixel, CAMERA.pinhole.ray_in_cam(pixel) * DEPTH);
        MapPoint::new(id as u32, at, (image, &CAMERA))
    };
    pixels.enumerate().filter_map(point).collect()
}

/// Median error of the places, pixels, and how many were found of how many that the frame shows.
fn errors(motion: &Rigid, guess: &Rigid, brighter: f32) -> (f64, usize, usize) {
    let key = image(&Rigid::IDENTITY, 0.0);
    let frame = image(motion, brighter);
    let (mut off, mut n_shown) = (Vec::new(), 0);
    for point in points(&key) {
        let Some(truth) = CAMERA
            .pinhole
            .project(motion.transform_point(point.point_in_key))
        else {
            continue;
        };
        n_shown +=
            usize::from(truth.x > 20.0 && truth.y > 20.0 && truth.x < 220.0 && truth.y < 160.0);
        let cameras = [&CAMERA.pinhole; 2];
        let found = point
            .warp(guess, cameras)
            .and_then(|warp| point.align(&warp, (&frame, &CAMERA), N_LEVELS - 1));
        off.extend(found.map(|found| found.distance(truth)));
    }
    let n = off.len();
    (
        splat_geometry::stats::median(&mut off).unwrap_or(f64::INFINITY),
        n,
        n_shown,
    )
}

#[test]
fn patches_are_found_to_a_tenth_of_a_pixel_from_a_guess_that_is_pixels_off() {
    let motion = Rigid::exp(DVec3::new(0.12, -0.05, 0.15), DVec3::new(0.05, 0.12, 0.2));
    let off = Rigid::exp(DVec3::new(0.02, 0.02, 0.0), DVec3::new(0.01, 0.01, 0.01));
    for (guess, brighter) in [(motion, 0.0), (off * motion, 0.0), (off * motion, 0.15)] {
        let (error, n, n_shown) = errors(&motion, &guess, brighter);
        assert!(
            error < 0.1 && 4 * n > 3 * n_shown && n > 15,
            "{error} {n} of {n_shown}"
        );
    }
}

#[test]
fn patches_are_looked_for_where_no_guess_leads() {
    let motion = Rigid::exp(DVec3::new(0.2, 0.1, 0.0), DVec3::new(0.0, 0.05, 0.05));
    let (key, frame) = (image(&Rigid::IDENTITY, 0.0), image(&motion, 0.05));
    let (mut right, mut wrong) = (0, 0);
    for point in points(&key) {
        let truth = CAMERA
            .pinhole
            .project(motion.transform_point(point.point_in_key))
            .unwrap();
        if let Some(found) = point.look_for((&frame, &CAMERA), DVec2::ZERO, 10) {
            if found.distance(truth) < 1.0 {
                right += 1;
            } else {
                wrong += 1;
            }
        }
    }
    assert!(
        right >= 12 && right > 2 * wrong,
        "{right} right, {wrong} wrong"
    );
}

#[test]
fn what_is_flat_outside_or_behind_is_not_found() {
    let key = image(&Rigid::IDENTITY, 0.0);
    let flat = |values: f32| {
        let values = vec![values; 240 * 180];
        Pyramid::new(
            GreyImage {
                width: 240,
                height: 180,
                values,
            },
            2,
        )
    };
    let all = points(&key);
    let cameras = [&CAMERA.pinhole; 2];
    for point in &all {
        let warp = point.warp(&Rigid::IDENTITY, cameras).unwrap();
        assert_eq!(point.align(&warp, (&flat(0.4), &CAMERA), 2), None);
        let behind = Rigid::new(glam::DQuat::IDENTITY, DVec3::new(0.0, 0.0, -3.0));
        assert!(point.warp(&behind, cameras).is_none());
    }
    assert_eq!(all.len(), 40);
    for pixel in [
        DVec2::new(2.0, 90.0),
        DVec2::new(-5.0, 1.0),
        DVec2::new(f64::NAN, 4.0),
    ] {
        let at = (pixel, DVec3::new(0.0, 0.0, 1.0));
        assert!(MapPoint::new(0, at, (&key, &CAMERA)).is_none(), "{pixel}");
    }
    for point in points(&flat(0.4)) {
        let warp = point.warp(&Rigid::IDENTITY, cameras).unwrap();
        assert_eq!(point.align(&warp, (&key, &CAMERA), 2), None);
    }
}
