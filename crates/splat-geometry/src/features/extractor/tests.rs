//! An image and the same one turned, brightened or made smaller: what is found again, by every kind without a network.

use glam::DVec2;
use rand::{RngExt, SeedableRng};

use crate::features::extractor::*;
use crate::matching::{PreparedDescriptors, matches};

type Find = fn(&Grey, usize) -> Features;
const KINDS: [(&str, Find); 2] = [("sift", sift::features), ("orb", orb::features)];

/// Places agree when they are this near, in pixels of the first image: half a pixel each for finding them twice.
const NEAR_PX: f64 = 1.0;

fn test_image(width: usize, height: usize, value: impl Fn(f32, f32) -> f32) -> Grey {
    let pixels = (0..width * height)
        .map(|i| value((i % width) as f32 + 0.5, (i / width) as f32 + 0.5))
        .collect();
    Grey {
        width,
        height,
        pixels,
    }
}

/// Soft-edged discs, squares' corners and spots, so that blobs and corners are there: brightness at any place.
struct Scene {
    /// x, y, half side, turn, height of squares.
    squares: Vec<[f32; 5]>,
}

impl Scene {
    fn new() -> Self {
        let mut rng = rand_pcg::Pcg32::seed_from_u64(4);
        let mut square = || {
            [
                rng.random_range(-20.0..340.0),
                rng.random_range(-20.0..260.0),
                rng.random_range(2.0..14.0),
                rng.random_range(0.0..1.5),
                rng.random_range(-0.25..0.25),
            ]
        };
        let squares = (0..260).map(|_| square()).collect();
        Self { squares }
    }

    fn at(&self, x: f32, y: f32) -> f32 {
        let one = |&[cx, cy, half, turn, height]: &[f32; 5]| {
            let (sine, cosine) = turn.sin_cos();
            let (dx, dy) = (x - cx, y - cy);
            let inside = |d: f32| 1.0 / (1.0 + (1.6 * (d.abs() - half)).exp());
            height * inside(cosine * dx + sine * dy) * inside(cosine * dy - sine * dx)
        };
        (0.5 + self.squares.iter().map(one).sum::<f32>()).clamp(0.0, 1.0)
    }
}

const WIDTH: usize = 320;
const HEIGHT: usize = 240;

/// The scene through a camera that maps places of the first image by `second_from_first`, with some noise.
fn seen(scene: &Scene, first_from_second: impl Fn(DVec2) -> DVec2, light: (f32, f32)) -> Grey {
    let mut rng = rand_pcg::Pcg32::seed_from_u64(5);
    let mut image = test_image(WIDTH, HEIGHT, |x, y| {
        let at = first_from_second(DVec2::new(f64::from(x), f64::from(y)));
        light.0 * scene.at(at.x as f32, at.y as f32) + light.1
    });
    image
        .pixels
        .iter_mut()
        .for_each(|v| *v += rng.random_range(-0.005..0.005));
    image
}

/// Shares of points found again where they should be, and of matches that are right.
fn again(
    find: Find,
    first_from_second: impl Fn(DVec2) -> DVec2 + Copy,
    light: (f32, f32),
) -> (f64, f64) {
    let scene = Scene::new();
    let a = find(&seen(&scene, |p| p, (1.0, 0.0)), 400);
    let b = find(&seen(&scene, first_from_second, light), 400);
    let back: Vec<DVec2> = b.pixels.iter().map(|p| first_from_second(*p)).collect();
    let visible: Vec<&DVec2> = back
        .iter()
        .filter(|p| p.cmpge(DVec2::splat(30.0)).all() && p.x < 290.0 && p.y < 210.0)
        .collect();
    let is_near = |p: &&&DVec2| a.pixels.iter().any(|q| q.distance(***p) < NEAR_PX);
    let n_again = visible.iter().filter(is_near).count();
    let found = matches(
        &PreparedDescriptors::new(&a.descriptors),
        &PreparedDescriptors::new(&b.descriptors),
    );
    let is_right =
        |&&(i, j): &&(u32, u32)| a.pixels[i as usize].distance(back[j as usize]) < 2.0 * NEAR_PX;
    let n_right = found.iter().filter(is_right).count();
    assert!(
        visible.len() > 100 && found.len() > 60,
        "{} {}",
        visible.len(),
        found.len()
    );
    (
        n_again as f64 / visible.len() as f64,
        n_right as f64 / found.len() as f64,
    )
}

fn turned(by_deg: f64, scale: f64) -> impl Fn(DVec2) -> DVec2 + Copy {
    let centre = DVec2::new(0.5 * WIDTH as f64, 0.5 * HEIGHT as f64);
    move |p| DVec2::from_angle(by_deg.to_radians()).rotate(p - centre) / scale + centre
}

/// Lowest share of points found again; 0.9 of all matches must be right.
fn check(name: &str, map: impl Fn(DVec2) -> DVec2 + Copy, light: (f32, f32), lowest: f64) {
    for (kind, find) in KINDS {
        let (repeated, right) = again(find, map, light);
        assert!(
            repeated >= lowest && right >= 0.9,
            "{kind}, {name}: {repeated} found again, {right} right"
        );
    }
}

#[test]
fn a_turned_image_matches_itself() {
    check("30 deg", turned(30.0, 1.0), (1.0, 0.0), 0.5);
    check("90 deg", turned(90.0, 1.0), (1.0, 0.0), 0.5);
}

#[test]
fn a_smaller_image_matches_itself() {
    check("0.75", turned(0.0, 0.75), (1.0, 0.0), 0.4);
    check("1.3", turned(10.0, 1.3), (1.0, 0.0), 0.4);
}

#[test]
fn a_brighter_image_matches_itself() {
    check("dark", |p| p, (0.5, 0.1), 0.6);
    check("bright", |p| p, (0.8, 0.2), 0.6);
}

#[test]
fn a_spot_is_found_where_it_is_at_every_size() {
    for (sigma, x, y) in [(1.5, 40.3, 33.8), (3.0, 41.7, 30.2), (6.0, 40.0, 32.5)] {
        let spot = test_image(90, 70, |u, v| {
            let away: f32 = ((u - x).powi(2) + (v - y).powi(2)) / (2.0 * sigma * sigma);
            0.5 + 0.4 * (-away).exp()
        });
        let found = sift::features(&spot, 10);
        let truth = DVec2::new(f64::from(x), f64::from(y));
        let off = found
            .pixels
            .first()
            .map_or(f64::INFINITY, |p| p.distance(truth));
        assert!(
            off < 0.1,
            "sigma {sigma}: {off} px off, {:?}",
            found.pixels.first()
        );
    }
}

#[test]
fn corners_are_found_to_parts_of_a_pixel() {
    let mut rng = rand_pcg::Pcg32::seed_from_u64(6);
    let mut offs = Vec::new();
    for _ in 0..20 {
        // Four quarters of a chessboard meet.
        let (x, y) = (
            rng.random_range(59.0..61.0_f32),
            rng.random_range(49.0..51.0_f32),
        );
        let board = test_image(120, 100, |u, v| {
            let edge = |d: f32| 2.0 / (1.0 + (-2.0 * d).exp()) - 1.0;
            0.5 + 0.3 * edge(u - x) * edge(v - y)
        });
        let found = orb::features(&board, 50);
        let truth = DVec2::new(f64::from(x), f64::from(y));
        offs.push(
            found
                .pixels
                .first()
                .map_or(f64::INFINITY, |p| p.distance(truth)),
        );
    }
    let worst = offs.iter().copied().fold(0.0, f64::max);
    assert!(worst < 0.15, "{offs:?}");
}

#[test]
fn blank_tiny_and_broken_images_have_no_features() {
    let broken = Grey {
        width: 300,
        height: 200,
        pixels: vec![0.3; 17],
    };
    for (kind, find) in KINDS {
        for (w, h) in [
            (0, 0),
            (1, 1),
            (0, 50),
            (7, 300),
            (24, 24),
            (38, 38),
            (200, 100),
        ] {
            let found = find(&test_image(w, h, |_, _| 0.4), 100);
            assert!(
                found.is_empty(),
                "{kind}: {} of a blank {w}x{h}",
                found.len()
            );
        }
        assert!(find(&broken, 100).is_empty(), "{kind}");
        let mut rng = rand_pcg::Pcg32::seed_from_u64(7);
        let mut noise = test_image(64, 48, |_, _| 0.0);
        noise.pixels.fill_with(|| rng.random());
        assert!(find(&noise, 100).len() <= 100, "{kind}");
        assert!(find(&noise, 0).is_empty(), "{kind}");
    }
}

#[test]
fn equal_images_have_equal_features() {
    let scene = Scene::new();
    for (kind, find) in KINDS {
        let once = || find(&seen(&scene, |p| p, (1.0, 0.0)), 300);
        assert!(once() == once(), "{kind}");
    }
}
