//! Scenes that `synth --layout` writes -> the frames, poses, lenses and points that our own readers find in them. `scripts/layouts_test` does the
//! same at the size of real scenes.

use std::path::Path;

use crate::sources::params;
use splat_io::frame_source::SourceCounts;
use splat_io::scene_formats::scene::Layout;
use splat_mapper::node::open_source;
use splat_synth::layouts::{FolderLayout, write_folder};
use splat_synth::settings::SynthSettings;
use splat_synth::take::Take;
use splat_types::camera::Distortion;
use splat_types::frame::Frame;

const N_FRAMES: u32 = 12;
/// Six digits of an angle of view, or decimals of a rotation that is orthonormalised.
const TOLERANCE: f64 = 1e-6;

fn settings(more: &str) -> SynthSettings {
    SynthSettings::parse(&format!(
        "room?frames={N_FRAMES}&width=160&height=120{more}"
    ))
    .unwrap()
}

fn frames_of(folder: &Path) -> (Vec<Frame>, SourceCounts) {
    let uri = format!("images:{}", folder.display());
    let mut source = open_source::open(&uri, &params(), 0).unwrap();
    let frames = std::iter::from_fn(|| source.next()).collect();
    (frames, source.counts())
}

/// `order`: the images in the natural order of their names.
fn check(layout: FolderLayout, settings: &SynthSettings, order: &[u32]) {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("scene");
    write_folder(settings, layout, &folder, |_| {}).unwrap();
    let take = Take::new(settings.clone()).unwrap();
    let (frames, counts) = frames_of(&folder);
    assert_eq!(
        (frames.len(), counts.undecodable),
        (order.len(), 0),
        "{layout:?}"
    );
    for (frame, ix) in frames.iter().zip(order) {
        let (found, wanted) = (frame.truth.unwrap(), take.pose(*ix));
        let angle = found.angle_to(&wanted);
        let offset = found.translation.distance(wanted.translation);
        assert!(
            angle < TOLERANCE && offset < TOLERANCE,
            "{layout:?}, image {ix}: {angle:e}, {offset:e}"
        );
        if settings.lens().distortion == Distortion::None {
            let (found, wanted) = (frame.intrinsics.unwrap(), settings.lens().intrinsics);
            assert_eq!((found.width_px, found.height_px), (160, 120));
            assert!(
                (found.fx - wanted.fx).abs() < 1e-3,
                "{found:?}, wanted {wanted:?}"
            );
        }
    }
    let again = write_folder(settings, layout, &folder, |_| {}).unwrap_err();
    assert!(again.to_string().contains("not empty"), "{again}");
}

#[test]
fn every_layout_gives_back_its_images_and_poses() {
    let all: Vec<u32> = (0..N_FRAMES).collect();
    check(FolderLayout::Colmap, &settings(""), &all);
    check(FolderLayout::Nerfstudio, &settings(""), &all);
    // Image 4 is held out: `test` comes before `train`.
    let others = all.iter().copied().filter(|ix| *ix != 4);
    let blender: Vec<u32> = [4].into_iter().chain(others).collect();
    check(FolderLayout::Blender, &settings(""), &blender);
    // Image 5 shows nothing that moves.
    let robust: Vec<u32> = all
        .iter()
        .copied()
        .filter(|ix| *ix != 5)
        .chain([5])
        .collect();
    check(FolderLayout::RobustNerf, &settings("&movers=3"), &robust);
}

#[test]
fn distorted_lenses_are_read_back() {
    for lens in ["radial", "fisheye"] {
        let settings = settings(&format!("&lens={lens}"));
        for layout in [FolderLayout::Colmap, FolderLayout::Nerfstudio] {
            let root = tempfile::tempdir().unwrap();
            let folder = root.path().join("scene");
            write_folder(&settings, layout, &folder, |_| {}).unwrap();
            let views = Layout::find(&folder).unwrap().views(640).unwrap();
            let (found, wanted) = (views[0].lens.unwrap(), settings.lens());
            for x in [20.0, 80.0, 140.0] {
                let pixel = glam::DVec2::new(x, 40.0);
                let rays = [found, wanted].map(|lens| lens.ray_in_cam(pixel).unwrap().normalize());
                let apart = rays[0].distance(rays[1]);
                assert!(apart < 1e-6, "{lens} in {layout:?}: {apart:e}");
            }
        }
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("scene");
        let refused = write_folder(&settings, FolderLayout::Blender, &folder, |_| {}).unwrap_err();
        assert!(refused.to_string().contains("pinhole"), "{refused}");
    }
}

#[test]
fn points_lie_on_surfaces_and_have_their_colours() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("scene");
    let settings = settings("");
    write_folder(&settings, FolderLayout::Colmap, &folder, |_| {}).unwrap();
    let points = Layout::find(&folder).unwrap().points().unwrap();
    assert!(points.len() > 400, "{}", points.len());
    let take = Take::new(settings.clone()).unwrap();
    let i = settings.lens().intrinsics;
    let depth = take.depth(0, &i);
    let cam_from_world = take.pose(0).inverse();
    let mut n_seen = 0;
    for point in &points {
        let in_cam = cam_from_world.transform_point(point.position_in_gt);
        let Some(pixel) = i.project(in_cam) else {
            continue;
        };
        let (x, y) = (pixel.x.floor(), pixel.y.floor());
        if x >= 1.0 && y >= 1.0 && x < 159.0 && y < 119.0 {
            let seen = f64::from(depth.depth[y as usize * 160 + x as usize]);
            n_seen += usize::from((seen - in_cam.z).abs() < 0.05 * in_cam.z);
        }
    }
    assert!(
        n_seen > 40,
        "{n_seen} of the points are where image 0 sees a surface"
    );
}
