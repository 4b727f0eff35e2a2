//! Views and points -> the text files of COLMAP, nerfstudio and Blender that describe them. Where their images lie is the caller's.
//!
//! Sources: COLMAP's documentation of its output format; nerfstudio's of its data conventions; the synthetic scenes of NeRF.

use std::fmt::Write as _;

use glam::{DMat3, DVec2, DVec3};
use serde_json::{Map, Value, json};

use splat_types::camera::{CameraModel, Distortion};
use splat_types::sparse_point::SparsePoint;
use splat_types::transform::Rigid;

/// One image of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct WrittenView {
    /// Of the file, below the folder of images (COLMAP) or below the scene (the others).
    pub name: String,
    /// OpenCV axes.
    pub world_from_cam: Rigid,
    pub lens: CameraModel,
    /// Known to nerfstudio and Blender alone.
    pub is_held_out: bool,
}

/// Name of a file below the scene's folder, and what is in it.
pub type WrittenFile = (&'static str, String);

/// `cameras.txt`, `images.txt` and `points3D.txt` of `sparse/0`. Views of one lens share a camera. Each point has the one observation of its image (its
/// number, from 0 on), where it lies within that image, and none else.
pub fn colmap(views: &[WrittenView], points: &[(SparsePoint, usize)]) -> Vec<WrittenFile> {
    let mut lenses: Vec<CameraModel> = Vec::new();
    let mut images = String::from(
        "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID of each observation\n",
    );
    let (observations, tracks) = colmap_observations(views, points);
    for (id, view) in (1..).zip(views) {
        let known = lenses.iter().position(|lens| *lens == view.lens);
        let camera = known.unwrap_or_else(|| {
            lenses.push(view.lens);
            lenses.len() - 1
        }) + 1;
        let pose = view.world_from_cam.inverse();
        let (q, t) = (pose.rotation, pose.translation);
        let numbers = [q.w, q.x, q.y, q.z, t.x, t.y, t.z].map(|v| v.to_string());
        let (numbers, name) = (numbers.join(" "), &view.name);
        line(&mut images, format_args!("{id} {numbers} {camera} {name}"));
        line(&mut images, format_args!("{}", observations[id - 1]));
    }
    let mut cameras = String::from("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n");
    for (id, lens) in (1..).zip(&lenses) {
        let i = lens.intrinsics;
        let (model, distortion) = colmap_model(&lens.distortion);
        let numbers = [i.fx, i.fy, i.cx, i.cy].into_iter().chain(distortion);
        let numbers: Vec<String> = numbers.map(|v| v.to_string()).collect();
        let (width, height) = (i.width_px, i.height_px);
        line(
            &mut cameras,
            format_args!("{id} {model} {width} {height} {}", numbers.join(" ")),
        );
    }
    let mut cloud =
        String::from("# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    for ((id, (point, _)), track) in (1..).zip(points).zip(tracks) {
        let (p, [r, g, b], error) = (point.position_in_gt, point.rgb, point.error_px);
        line(
            &mut cloud,
            format_args!("{id} {} {} {} {r} {g} {b} {error} {track}", p.x, p.y, p.z),
        );
    }
    vec![
        ("sparse/0/cameras.txt", cameras),
        ("sparse/0/images.txt", images),
        ("sparse/0/points3D.txt", cloud),
    ]
}

/// The observations of each view as `images.txt` lists them, and the track of each point.
fn colmap_observations(
    views: &[WrittenView],
    points: &[(SparsePoint, usize)],
) -> (Vec<String>, Vec<String>) {
    let mut lines = vec![Vec::new(); views.len()];
    let mut tracks = Vec::with_capacity(points.len());
    for (id, (point, image)) in (1_usize..).zip(points) {
        let pixel = views.get(*image).and_then(|view| {
            let in_cam = view
                .world_from_cam
                .inverse()
                .transform_point(point.position_in_gt);
            let i = view.lens.intrinsics;
            let pixel = view.lens.project(in_cam)?;
            let size = DVec2::new(f64::from(i.width_px), f64::from(i.height_px));
            (pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all()).then_some(pixel)
        });
        let Some(pixel) = pixel else {
            tracks.push(String::new());
            continue;
        };
        tracks.push(format!("{} {}", image + 1, lines[*image].len()));
        lines[*image].push(format!("{:.3} {:.3} {id}", pixel.x, pixel.y));
    }
    (
        lines.iter().map(|of_view| of_view.join(" ")).collect(),
        tracks,
    )
}

/// `transforms.json`, and `sparse_pc.ply` where there are points. A lens that all views share stands at the top.
pub fn nerfstudio(views: &[WrittenView], points: &[(SparsePoint, usize)]) -> Vec<WrittenFile> {
    let shared = views.first().map(|view| view.lens);
    let is_shared = views.iter().all(|view| Some(view.lens) == shared);
    let mut file = match shared.filter(|_| is_shared) {
        Some(lens) => nerfstudio_camera(&lens),
        None => Map::new(),
    };
    let frame = |view: &WrittenView| {
        let mut keys = frame_of(view);
        if !is_shared {
            keys.extend(nerfstudio_camera(&view.lens));
        }
        Value::Object(keys)
    };
    let tests: Vec<&str> = views
        .iter()
        .filter(|v| v.is_held_out)
        .map(|v| v.name.as_str())
        .collect();
    file.insert("frames".to_owned(), views.iter().map(frame).collect());
    if !tests.is_empty() {
        file.insert("test_filenames".to_owned(), json!(tests));
    }
    if points.is_empty() {
        return vec![("transforms.json", Value::Object(file).to_string())];
    }
    file.insert("ply_file_path".to_owned(), json!("sparse_pc.ply"));
    let n = points.len();
    let mut cloud = format!("ply\nformat ascii 1.0\nelement vertex {n}\n");
    for name in ["x", "y", "z"] {
        line(&mut cloud, format_args!("property float {name}"));
    }
    for name in ["red", "green", "blue"] {
        line(&mut cloud, format_args!("property uchar {name}"));
    }
    cloud.push_str("end_header\n");
    for (point, _) in points {
        let (p, [r, g, b]) = (point.position_in_gt, point.rgb);
        line(
            &mut cloud,
            format_args!("{} {} {} {r} {g} {b}", p.x as f32, p.y as f32, p.z as f32),
        );
    }
    vec![
        ("transforms.json", Value::Object(file).to_string()),
        ("sparse_pc.ply", cloud),
    ]
}

/// `transforms_train.json` and `transforms_test.json`. `None`: the views have a distorted lens or several, which the layout cannot say.
pub fn blender(views: &[WrittenView]) -> Option<Vec<WrittenFile>> {
    let lens = views.first()?.lens;
    if lens.distortion != Distortion::None || views.iter().any(|view| view.lens != lens) {
        return None;
    }
    let half_width = 0.5 * f64::from(lens.intrinsics.width_px);
    let angle = 2.0 * (half_width / lens.intrinsics.fx).atan();
    let of = |held_out: bool| {
        let those = views.iter().filter(|view| view.is_held_out == held_out);
        let frames: Value = those.map(|view| Value::Object(frame_of(view))).collect();
        json!({ "camera_angle_x": angle, "frames": frames }).to_string()
    };
    Some(vec![
        ("transforms_train.json", of(false)),
        ("transforms_test.json", of(true)),
    ])
}

fn line(text: &mut String, arguments: std::fmt::Arguments<'_>) {
    writeln!(text, "{arguments}").expect("a String takes everything");
}

fn frame_of(view: &WrittenView) -> Map<String, Value> {
    let mut keys = Map::new();
    keys.insert("file_path".to_owned(), json!(view.name));
    let matrix = opengl_matrix(&view.world_from_cam);
    keys.insert("transform_matrix".to_owned(), json!(matrix));
    keys
}

/// Camera to world of a camera that looks along -z, with y up.
fn opengl_matrix(world_from_cam: &Rigid) -> [[f64; 4]; 4] {
    let opengl = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let turned = world_from_cam.rotation_matrix() * opengl;
    let t = world_from_cam.translation;
    let row = |k: usize| {
        let r = turned.row(k);
        [r.x, r.y, r.z, t[k]]
    };
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

fn nerfstudio_camera(lens: &CameraModel) -> Map<String, Value> {
    let i = lens.intrinsics;
    let (model, keys): (&str, Vec<(&str, f64)>) = match lens.distortion {
        Distortion::None => ("PINHOLE", Vec::new()),
        // What it cannot say of a rational lens is small beside these.
        Distortion::PlumbBob([k1, k2, p1, p2, k3])
        | Distortion::Rational([k1, k2, p1, p2, k3, ..]) => {
            let keys = [("k1", k1), ("k2", k2), ("k3", k3), ("p1", p1), ("p2", p2)];
            ("OPENCV", keys.to_vec())
        }
        Distortion::Equidistant([k1, k2, k3, k4]) => {
            let keys = [("k1", k1), ("k2", k2), ("k3", k3), ("k4", k4)];
            ("OPENCV_FISHEYE", keys.to_vec())
        }
    };
    let mut camera = Map::new();
    camera.insert("camera_model".to_owned(), json!(model));
    camera.insert("w".to_owned(), json!(i.width_px));
    camera.insert("h".to_owned(), json!(i.height_px));
    let pinhole = [("fl_x", i.fx), ("fl_y", i.fy), ("cx", i.cx), ("cy", i.cy)];
    for (key, value) in pinhole.into_iter().chain(keys) {
        camera.insert(key.to_owned(), json!(value));
    }
    camera
}

fn colmap_model(distortion: &Distortion) -> (&'static str, Vec<f64>) {
    match *distortion {
        Distortion::None => ("PINHOLE", Vec::new()),
        Distortion::PlumbBob([k1, k2, p1, p2, k3]) => {
            ("FULL_OPENCV", vec![k1, k2, p1, p2, k3, 0.0, 0.0, 0.0])
        }
        Distortion::Rational(k) => ("FULL_OPENCV", k.to_vec()),
        Distortion::Equidistant(k) => ("OPENCV_FISHEYE", k.to_vec()),
    }
}
