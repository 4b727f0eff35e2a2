//! XFeat through ONNX Runtime: what is made of the network's numbers, against the same thing computed here in f64.

use std::path::{Path, PathBuf};
use std::process::Command;

use glam::DVec2;

use crate::graphs::library;
use crate::lpips::{network, saved};
use crate::scenes::{ignored, scene};
use crate::sfm::{run, shown};
use splat_geometry::features::descriptor::{Descriptors, Features, working_image};
use splat_geometry::features::extractor::FeatureExtractor;
use splat_geometry::features::scale_space::Grey;
use splat_geometry::features::xfeat::{Raw, Xfeat, points};
use splat_geometry::matching::{PreparedDescriptors, matches};
use splat_mapper::params::settings::Settings;

const WIDTH: usize = 640;
const HEIGHT: usize = 480;
/// Cells across, down, and in all.
const CELLS: (usize, usize, usize) = (80, 60, 4800);
/// f32 against f64 in a softmax of 65 numbers.
const MAX_OFF_PX: f64 = 1e-3;
/// Half a step of the whole numbers that descriptors are kept in, and some for the f32 arithmetic before.
const MAX_OFF: f64 = 0.55 / 176.0;

/// The network beside the scenes, `None` where it or ONNX Runtime is not there; the test returns then.
fn model() -> Option<(PathBuf, PathBuf)> {
    let library = library()?;
    let model = scene("fox")?.join("../../models/xfeat_480x640.onnx");
    if !model.is_file() {
        ignored(&format!("no network: {}", model.display()));
        return None;
    }
    Some((library, model))
}

/// Two images of the fox, seen from nearly the same place.
fn images() -> Vec<Grey> {
    let all = shown(&scene("fox").unwrap(), 640, 2, true);
    let some = all.keyframes[..2].iter();
    some.map(|k| working_image(&k.frame.image, 640)).collect()
}

/// (pixel, score, unit descriptor), the surest first.
type Reference = Vec<(DVec2, f64, Vec<f64>)>;

fn heat(raw: &Raw) -> Vec<f64> {
    let mut heat = vec![0.0; WIDTH * HEIGHT];
    for (at, out) in heat.iter_mut().enumerate() {
        let (x, y) = (at % WIDTH, at / WIDTH);
        let score = |class: usize| {
            f64::from(raw.keypoints[class * CELLS.2 + y / 8 * CELLS.0 + x / 8]).exp()
        };
        *out = score(y % 8 * 8 + x % 8) / (0..65).map(score).sum::<f64>();
    }
    heat
}

/// One channel of the cells at a pixel's centre, linear between cells, level beyond the outer centres.
fn between(plane: &[f32], x: usize, y: usize) -> f64 {
    let u = ((x as f64 + 0.5) / 8.0 - 0.5).clamp(0.0, 79.0);
    let v = ((y as f64 + 0.5) / 8.0 - 0.5).clamp(0.0, 59.0);
    let mut sum = 0.0;
    for row in 0..CELLS.1 {
        let down = 1.0 - (v - row as f64).abs();
        if down <= 0.0 {
            continue;
        }
        for column in 0..CELLS.0 {
            let across = 1.0 - (u - column as f64).abs();
            sum += down * across.max(0.0) * f64::from(plane[row * CELLS.0 + column]);
        }
    }
    sum
}

fn reference(raw: &Raw, most: usize) -> Reference {
    let heat = heat(raw);
    let at = |x: isize, y: isize| {
        let inside = (0..WIDTH as isize).contains(&x) && (0..HEIGHT as isize).contains(&y);
        if inside {
            heat[y as usize * WIDTH + x as usize]
        } else {
            0.0
        }
    };
    let mut found = Vec::new();
    for y in 0..HEIGHT as isize {
        for x in 0..WIDTH as isize {
            let around =
                |r: isize| (-r..=r).flat_map(move |j| (-r..=r).map(move |i| (x + i, y + j)));
            if at(x, y) <= 0.05 || around(2).any(|(i, j)| at(i, j) > at(x, y)) {
                continue;
            }
            let sum: f64 = around(1).map(|(i, j)| at(i, j)).sum();
            let weighted = around(1).map(|(i, j)| at(i, j) * DVec2::new(i as f64, j as f64));
            let pixel = weighted.sum::<DVec2>() / sum + 0.5;
            found.push((
                pixel,
                at(x, y) * between(&raw.heatmap, x as usize, y as usize),
                (x, y),
            ));
        }
    }
    found.sort_by(|a, b| b.1.total_cmp(&a.1));
    found.truncate(most);
    let described = |(pixel, score, (x, y)): (DVec2, f64, (isize, isize))| {
        let planes = raw.feats.chunks_exact(CELLS.2);
        let values: Vec<f64> = planes.map(|p| between(p, x as usize, y as usize)).collect();
        let length = values.iter().map(|v| v * v).sum::<f64>().sqrt();
        (pixel, score, values.iter().map(|v| v / length).collect())
    };
    found.into_iter().map(described).collect()
}

fn words(features: &Features) -> &[[i16; 64]] {
    match &features.descriptors {
        Descriptors::Xfeat(all) => all,
        other => panic!("{other:?}"),
    }
}

/// Mutually nearest pairs by cosine.
fn reference_matches(a: &Reference, b: &Reference) -> Vec<(u32, u32)> {
    let cosine =
        |i: usize, j: usize| -> f64 { a[i].2.iter().zip(&b[j].2).map(|(x, y)| x * y).sum() };
    let best =
        |n: usize, of: &dyn Fn(usize) -> f64| (0..n).max_by(|x, y| of(*x).total_cmp(&of(*y)));
    let mut found = Vec::new();
    for i in 0..a.len() {
        let j = best(b.len(), &|j| cosine(i, j)).unwrap();
        if cosine(i, j) > 0.82 && best(a.len(), &|k| cosine(k, j)) == Some(i) {
            found.push((i as u32, j as u32));
        }
    }
    found
}

#[test]
fn points_and_matches_are_those_of_a_plain_computation() {
    let Some((library, model)) = model() else {
        return;
    };
    let network = Xfeat::open_by(&library, &model).unwrap();
    let raws: Vec<Raw> = images().iter().map(|p| network.raw(p).unwrap()).collect();
    for raw in &raws {
        let sizes = [raw.feats.len(), raw.keypoints.len(), raw.heatmap.len()];
        assert_eq!(sizes, [64 * CELLS.2, 65 * CELLS.2, CELLS.2]);
        let mut all = raw.feats.iter().chain(&raw.keypoints).chain(&raw.heatmap);
        assert!(all.all(|v| v.is_finite()));
    }
    const MOST: usize = 400;
    let own: Vec<Features> = raws.iter().map(|raw| points(raw, MOST)).collect();
    let plain: Vec<Reference> = raws.iter().map(|raw| reference(raw, MOST)).collect();
    for (own, plain) in own.iter().zip(&plain) {
        assert_eq!((own.len(), plain.len()), (MOST, MOST));
        for (i, (pixel, _, descriptor)) in plain.iter().enumerate() {
            let off = own.pixels[i].distance(*pixel);
            assert!(off < MAX_OFF_PX, "point {i} is {off} px off");
            for (word, value) in words(own)[i].iter().zip(descriptor) {
                let off = (f64::from(*word) / 176.0 - value).abs();
                assert!(off < MAX_OFF, "descriptor {i} is {off} off");
            }
        }
    }
    let of = |features: &Features| PreparedDescriptors::new(&features.descriptors);
    let found = matches(&of(&own[0]), &of(&own[1]));
    let expected = reference_matches(&plain[0], &plain[1]);
    let n_common = found.iter().filter(|pair| expected.contains(pair)).count();
    // Rounded descriptors decide near ties otherwise.
    let n_both = found.len().max(expected.len());
    assert!(
        n_both > 150 && 100 * n_common >= 97 * n_both,
        "{n_common} of {n_both}"
    );
}

/// Seven numbers of each output for the waves below, and the root of the mean square: by ONNX Runtime 1.31.1 on one
/// thread without any of its optimisations.
const REFERENCE: [([f32; 7], f64); 3] = [
    (
        [
            1.650_906, -1.562_116, -0.742_668, 4.413_51, 1.274_853, -2.347_769, 2.241_35,
        ],
        1.885_052_5,
    ),
    (
        [
            -0.804_234, -3.655_74, -5.619_848, -7.085_472, -6.148_045, -5.529_556, 0.561_854,
        ],
        4.536_057_9,
    ),
    (
        [
            0.034_294, 0.090_078, 0.119_777, 0.207_009, 0.111_643, 0.271_646, 0.082_106,
        ],
        0.161_009_7,
    ),
];

#[test]
fn the_network_says_what_it_said_to_others() {
    let Some((library, model)) = model() else {
        return;
    };
    let network = Xfeat::open_by(&library, &model).unwrap();
    let wave = |i: usize| {
        let (x, y) = ((i % WIDTH) as f64, (i / WIDTH) as f64);
        let short = (0.07 * x).sin() * (0.05 * y).cos();
        (0.5 + 0.25 * short + 0.2 * (0.013 * (x + 2.0 * y)).sin()) as f32
    };
    let image = Grey {
        width: WIDTH,
        height: HEIGHT,
        pixels: (0..WIDTH * HEIGHT).map(wave).collect(),
    };
    let raw = network.raw(&image).unwrap();
    for (found, (some, size)) in [raw.feats, raw.keypoints, raw.heatmap]
        .iter()
        .zip(REFERENCE)
    {
        let n = found.len();
        for (k, expected) in some.iter().enumerate() {
            let off = found[k * n / 7 + k] - expected;
            assert!(off.abs() < 1e-3, "{k}: {off} of {expected}");
        }
        let squares = found.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
        let off = (squares / n as f64).sqrt() / size - 1.0;
        assert!(off.abs() < 1e-5, "{off}");
    }
}

#[test]
fn images_of_any_size_keep_their_places_and_blank_ones_are_survived() {
    let Some((library, model)) = model() else {
        return;
    };
    let network = Xfeat::open_by(&library, &model).unwrap();
    let image = &images()[0];
    let found = network.features(image, 500);
    let inside = |p: &DVec2| {
        p.cmpge(DVec2::ZERO).all() && p.x < image.width as f64 && p.y < image.height as f64
    };
    assert!(found.len() == 500 && found.pixels.iter().all(inside));
    assert!(found.pixels.iter().any(|p| p.y > 0.9 * image.height as f64));
    assert!(found == network.features(image, 500), "equal images");
    let grey = |width: usize, height: usize, n: usize| Grey {
        width,
        height,
        pixels: vec![0.4; n],
    };
    for (w, h, n) in [(0, 0, 0), (1, 1, 1), (7, 300, 2100), (200, 100, 17)] {
        assert!(network.features(&grey(w, h, n), 500).is_empty(), "{w}x{h}");
    }
    let blank = network.features(&grey(200, 100, 20_000), 500);
    assert!(blank.pixels.iter().all(|p| p.is_finite()));
}

#[test]
fn a_scene_is_registered_by_the_network() {
    let Some((library, model)) = model() else {
        return;
    };
    // The library is looked up by its name in the environment, which only a process of its own can be given.
    if std::env::var_os("ORT_DYLIB_PATH").is_none() {
        let test = "xfeat::a_scene_is_registered_by_the_network";
        let mut again = Command::new(std::env::current_exe().unwrap());
        again.args(["--exact", test, "--nocapture"]);
        let output = again.env("ORT_DYLIB_PATH", library).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(
            output.status.success() && text.contains("1 passed"),
            "{text}{}",
            String::from_utf8_lossy(&output.stderr)
        );
        return;
    }
    let Some(folder) = scene("lund_door") else {
        return;
    };
    let model = format!("sfm.xfeat_model={}", model.display());
    let figures = run(
        &shown(&folder, 640, 1, true),
        &["sfm.features=xfeat", &model],
    );
    // Measured: 0.067 % and 0.14 deg.
    assert!(
        figures.registered == 12 && figures.ate_percent < 0.2 && figures.rotation_deg < 0.4,
        "{figures:?}"
    );
}

fn refusal(settings: &[&str]) -> String {
    let mut all = Settings::shipped();
    settings.iter().for_each(|s| all.merge_setting(s).unwrap());
    let error = FeatureExtractor::new(&all.params().unwrap().sfm.features()).unwrap_err();
    error.to_string()
}

#[test]
fn what_is_missing_is_named_with_the_way_out() {
    let none = refusal(&["sfm.features=xfeat"]);
    assert!(
        none.contains("sfm.xfeat_model") && none.contains("docs/FORMATS.md"),
        "{none}"
    );
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let fail = |path: &Path| Xfeat::open_by(&library, path).unwrap_err().to_string();
    let gone = fail(&folder.path().join("gone.onnx"));
    assert!(
        gone.contains("sfm.xfeat_model") && gone.contains("gone.onnx"),
        "{gone}"
    );
    let other = fail(&saved(folder.path(), &network(&["shown", "seen"])));
    assert!(
        other.contains("inputs") && other.contains("[1, 3, 480, 640]"),
        "{other}"
    );
}
