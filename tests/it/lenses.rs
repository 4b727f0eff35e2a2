//! Lens models against OpenCV, their inverses, and the pinhole images made of them.

use glam::{DVec2, DVec3};

use crate::sources::pixel;
use splat_image::undistort::Undistorter;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};
use splat_types::image::RgbImage;

fn lenses() -> [(&'static str, CameraModel); 3] {
    let intrinsics = Intrinsics {
        width_px: 640,
        height_px: 480,
        fx: 520.0,
        fy: 518.0,
        cx: 316.0,
        cy: 242.75,
    };
    [
        (
            "plumb_bob",
            Distortion::PlumbBob([-0.28, 0.09, 0.0012, -0.0007, -0.013]),
        ),
        (
            "rational",
            Distortion::Rational([0.45, -2.6, 0.0009, -0.0004, 1.5, 0.33, -2.4, 1.43]),
        ),
        (
            "equidistant",
            Distortion::Equidistant([-0.012, 0.031, -0.024, 0.006]),
        ),
    ]
    .map(|(name, distortion)| {
        (
            name,
            CameraModel {
                intrinsics,
                distortion,
            },
        )
    })
}

/// Reference: OpenCV 5.0, `projectPoints` and `fisheye::projectPoints`, which count pixel centres at integers.
#[test]
fn lenses_project_as_opencv_does() {
    let points = [(0.3, -0.2), (-0.55, 0.4), (0.05, 0.02), (0.5, 0.45)];
    let expected = [
        [
            (465.8667, 142.440471),
            (60.735751, 426.985987),
            (341.47728, 252.60317),
            (546.970222, 450.200899),
        ],
        [
            (473.299148, 137.49783),
            (21.875916, 455.119385),
            (341.508289, 252.614895),
            (582.036933, 481.50595),
        ],
        [
            (465.068216, 142.921364),
            (64.67414, 423.967197),
            (341.474015, 252.599646),
            (544.068821, 447.170739),
        ],
    ];
    for ((name, lens), expected) in lenses().into_iter().zip(expected) {
        for ((x, y), (u, v)) in points.into_iter().zip(expected) {
            let found = lens.project(DVec3::new(x * 2.0, y * 2.0, 2.0)).unwrap();
            let error = (found - DVec2::new(u + 0.5, v + 0.5)).length();
            assert!(error < 2e-6, "{name}: {found} is off by {error} px");
        }
        assert_eq!(lens.project(DVec3::new(0.0, 0.0, -1.0)), None);
    }
}

#[test]
fn every_pixel_projects_back_to_itself_through_its_ray() {
    let wide = Distortion::Equidistant([0.02, -0.01, 0.003, -0.0005]);
    let fisheye = CameraModel {
        intrinsics: Intrinsics {
            width_px: 640,
            height_px: 480,
            fx: 290.0,
            fy: 290.0,
            cx: 320.0,
            cy: 240.0,
        },
        distortion: wide,
    };
    for (name, lens) in lenses().into_iter().chain([("wide fisheye", fisheye)]) {
        for y in 0..=48 {
            for x in 0..=64 {
                let at = DVec2::new(f64::from(x) * 10.0, f64::from(y) * 10.0);
                let ray = lens
                    .ray_in_cam(at)
                    .unwrap_or_else(|| panic!("{name} has no ray at {at}"));
                let error = (lens.project(ray).unwrap() - at).length();
                assert!(error < 1e-6, "{name} at {at}: {error} px");
            }
        }
    }
}

#[test]
fn a_folded_polynomial_gives_no_ray_beyond_its_fold() {
    // r (1 - 0.8 r^2) turns over at r = 0.645, where it reaches 0.430.
    let folded = Distortion::PlumbBob([-0.8, 0.0, 0.0, 0.0, 0.0]);
    assert!(
        (folded.max_radius() - 0.645).abs() < 0.011,
        "{}",
        folded.max_radius()
    );
    assert!(folded.undistort(DVec2::new(0.42, 0.0)).is_some());
    assert_eq!(folded.undistort(DVec2::new(0.44, 0.0)), None);
    assert_eq!(folded.undistort(DVec2::new(f64::NAN, 0.0)), None);
}

/// Black and white squares, 20 to a unit of the plane z = 1, blurred so that their mean over a pixel is the value
/// at its centre.
fn pattern(ray: DVec3) -> f64 {
    127.5 + 100.0 * (ray.x * 20.0).sin() * (ray.y * 20.0).cos()
}

#[test]
fn a_rectified_pattern_is_what_the_pinhole_would_have_seen() {
    for (name, lens) in lenses() {
        let i = lens.intrinsics;
        let centre = |x: u32, y: u32| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let grid = || (0..i.height_px).flat_map(|y| (0..i.width_px).map(move |x| (x, y)));
        let value = |ray: DVec3| [pattern(ray).round() as u8; 3];
        let pixels = grid()
            .flat_map(|(x, y)| value(lens.ray_in_cam(centre(x, y)).unwrap()))
            .collect();
        let rectifier = Undistorter::new(&lens).unwrap();
        let seen = rectifier.rectify(RgbImage {
            width_px: i.width_px,
            height_px: i.height_px,
            pixels,
        });
        let pinhole = rectifier.pinhole;
        let (mut worst, mut sum) = (0.0_f64, 0.0);
        for (x, y) in grid() {
            let error =
                f64::from(pixel(&seen, x, y)[0]) - pattern(pinhole.ray_in_cam(centre(x, y)));
            worst = worst.max(error.abs());
            sum += error * error;
        }
        let rms = (sum / f64::from(i.width_px * i.height_px)).sqrt();
        // A shift of a tenth of a pixel would show as 0.4 rms here, half a pixel as 2.
        assert!(worst < 2.5 && rms < 0.45, "{name}: worst {worst} rms {rms}");
    }
}

#[test]
fn straight_edges_are_straight_in_the_pinhole_and_nothing_is_black() {
    for (name, lens) in lenses() {
        let rectifier = Undistorter::new(&lens).unwrap();
        let pinhole = rectifier.pinhole;
        for corner in [(0, 0), (639, 0), (0, 479), (639, 479), (320, 0), (0, 240)] {
            let at = rectifier.source_of(corner.0, corner.1);
            let ray = pinhole.ray_in_cam(DVec2::new(
                f64::from(corner.0) + 0.5,
                f64::from(corner.1) + 0.5,
            ));
            let error = (lens.project(ray).unwrap() - at).length();
            // The table holds f32; more would mean that the rim was clamped, that is, black or smeared.
            assert!(error < 1e-3, "{name} {corner:?}: clamped by {error} px");
        }
        // The view is the widest: some rim pixel touches the rim of the lens's image.
        let rim = (0..640).map(|x| (x, 0)).chain((0..480).map(|y| (0, y)));
        let rim = rim
            .chain((0..640).map(|x| (x, 479)))
            .chain((0..480).map(|y| (639, y)));
        let slack = |at: DVec2| {
            (at.x - 0.5)
                .min(at.y - 0.5)
                .min(639.5 - at.x)
                .min(479.5 - at.y)
        };
        let least = rim
            .map(|(x, y)| slack(rectifier.source_of(x, y)))
            .fold(f64::MAX, f64::min);
        assert!(
            least < 0.2,
            "{name}: {least} px of the lens's image are unused on every side"
        );
        // A straight edge in space stays one: its middle lies on the line between its ends.
        let (from, to) = (DVec3::new(-0.4, -0.3, 1.0), DVec3::new(0.5, 0.35, 1.4));
        let seen = |share: f64| {
            let through_lens = lens.project(from.lerp(to, share)).unwrap();
            pinhole
                .project(lens.ray_in_cam(through_lens).unwrap())
                .unwrap()
        };
        let (a, b) = (seen(0.0), seen(1.0));
        for step in 1..10 {
            let off = (b - a).perp_dot(seen(f64::from(step) * 0.1) - a).abs() / (b - a).length();
            assert!(off < 0.01, "{name}: distorted by {off} px");
        }
    }
}
