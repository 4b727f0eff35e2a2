//! Sparse points of other programs' scenes: COLMAP's points3D, the PLY of a transforms.json; whole, damaged and hostile.

use std::fmt::Write as _;
use std::path::Path;

use glam::{DQuat, DVec3};

use crate::declared_lengths::in_little_memory;
use crate::scene_formats::{colmap, matrix, pinhole, poses, test_image, transforms};
use splat_io::scene_formats::scene::Layout;
use splat_types::sparse_point::SparsePoint;
use splat_types::transform::Rigid;

/// Every n-th length of a cut file is tried.
const STRIDE: usize = 7;

fn points() -> Vec<SparsePoint> {
    let point = |ix: u8| SparsePoint {
        position_in_gt: DVec3::new(f64::from(ix), -0.25, 1e6 + 0.125 * f64::from(ix)),
        rgb: [ix, 255, 7],
        error_px: 0.5 * f32::from(ix),
        n_images: u32::from(ix) + 2,
    };
    (0..4).map(point).collect()
}

/// As COLMAP writes it, with `n_images` observations a point.
pub fn points_bin(points: &[SparsePoint]) -> Vec<u8> {
    let mut bytes = (points.len() as u64).to_le_bytes().to_vec();
    for (id, point) in (1_u64..).zip(points) {
        bytes.extend(id.to_le_bytes());
        let position = point.position_in_gt.to_array();
        bytes.extend(position.iter().flat_map(|x| x.to_le_bytes()));
        bytes.extend(point.rgb);
        bytes.extend(f64::from(point.error_px).to_le_bytes());
        bytes.extend(u64::from(point.n_images).to_le_bytes());
        bytes.extend((0..8 * point.n_images).map(|n| n as u8));
    }
    bytes
}

fn points_txt(points: &[SparsePoint]) -> String {
    let mut text = "# 3D point list\n#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n".to_owned();
    for (id, point) in (1_u64..).zip(points) {
        let ([x, y, z], [r, g, b]) = (point.position_in_gt.to_array(), point.rgb);
        write!(text, "{id} {x} {y} {z} {r} {g} {b} {}", point.error_px).unwrap();
        for n in 0..point.n_images {
            write!(text, " {n} {}", 7 * n).unwrap();
        }
        text.push('\n');
    }
    text
}

fn read(root: &Path) -> Result<Vec<SparsePoint>, String> {
    let layout = Layout::find(root).unwrap();
    layout.points().map_err(|e| e.to_string())
}

fn error_of(root: &Path, name: &str, bytes: &[u8]) -> String {
    std::fs::write(root.join(name), bytes).unwrap();
    let error = read(root).unwrap_err();
    let file = name.rsplit('/').next().unwrap();
    assert!(
        error.contains(file) && error.lines().count() == 1 && error.len() < 600,
        "{error}"
    );
    error
}

#[test]
fn points_of_a_colmap_model_are_read_as_they_are_written() {
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), &pinhole());
    assert_eq!(read(root.path()), Ok(Vec::new()), "a model without points");
    let model = root.path().join("sparse/0");
    std::fs::write(model.join("points3D.txt"), points_txt(&points())).unwrap();
    assert_eq!(read(root.path()).unwrap(), points());
    // The binary one goes before, as for cameras and images.
    std::fs::write(model.join("points3D.bin"), points_bin(&points()[..2])).unwrap();
    assert_eq!(read(root.path()).unwrap(), points()[..2]);
}

#[test]
fn cut_and_nonsensical_points_are_errors_that_name_the_file() {
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), &pinhole());
    let whole = points_bin(&points());
    for length in (0..whole.len()).step_by(STRIDE) {
        error_of(root.path(), "sparse/0/points3D.bin", &whole[..length]);
    }
    let mut lost = points();
    lost[2].position_in_gt.y = f64::NAN;
    let error = error_of(root.path(), "sparse/0/points3D.bin", &points_bin(&lost));
    assert!(error.contains("point 3 lies at"), "{error}");
    std::fs::remove_file(root.path().join("sparse/0/points3D.bin")).unwrap();
    for (line, reason) in [
        ("1 2 3 4 5", "is no point"),
        ("1 2 3 4 5 6 256 0.5", "is no point"),
        ("x 2 3 4 5 6 7 0.5", "is no point"),
        ("1 2 inf 4 5 6 7 0.5", "point 1 lies at"),
        ("\u{0}", "is no point"),
    ] {
        let error = error_of(root.path(), "sparse/0/points3D.txt", line.as_bytes());
        assert!(error.contains(reason), "{error}");
    }
}

#[test]
fn declared_points_take_no_memory() {
    in_little_memory("scene_points::declared_points_take_no_memory", || {
        let root = tempfile::tempdir().unwrap();
        colmap(root.path(), &pinhole());
        let path = "sparse/0/points3D.bin";
        let mut bytes = points_bin(&points());
        bytes[..8].copy_from_slice(&10_000_000_u64.to_le_bytes());
        error_of(root.path(), path, &bytes);
        bytes[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(error_of(root.path(), path, &bytes).contains("at most 10000000"));
        // Observations of the first point.
        let mut bytes = points_bin(&points());
        bytes[51..59].copy_from_slice(&(u64::MAX / 8).to_le_bytes());
        error_of(root.path(), path, &bytes);
        std::fs::write(
            root.path().join("transforms.json"),
            transforms(r#""ply_file_path": "p.ply""#, str::to_owned),
        )
        .unwrap();
        let ply = "ply\nformat ascii 1.0\nelement vertex 9000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
        error_of(root.path(), "p.ply", ply.as_bytes());
        error_of(root.path(), "p.ply", "ply\n".repeat(1 << 20).as_bytes());
        error_of(root.path(), "p.ply", &vec![b'a'; 1 << 20]);
    });
}

/// Vertices with a number that nobody needs between the others.
fn ply_header(format: &str, n: usize) -> String {
    format!(
        "ply\nformat {format} 1.0\ncomment of a test\nelement vertex {n}\nproperty float x\nproperty double y\nproperty float z\nproperty float nx\nproperty uchar red\nproperty uint8 green\nproperty uchar blue\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
}

fn in_reach() -> Vec<SparsePoint> {
    let mut points = points();
    for point in &mut points {
        point.position_in_gt.z -= 1e6;
        (point.error_px, point.n_images) = (-1.0, 0);
    }
    points
}

fn ply_bin(points: &[SparsePoint]) -> Vec<u8> {
    let mut bytes = ply_header("binary_little_endian", points.len()).into_bytes();
    for point in points {
        let [x, y, z] = point.position_in_gt.to_array();
        bytes.extend((x as f32).to_le_bytes());
        bytes.extend(y.to_le_bytes());
        bytes.extend((z as f32).to_le_bytes());
        bytes.extend(f32::NAN.to_le_bytes());
        bytes.extend(point.rgb);
    }
    bytes
}

fn ply_txt(points: &[SparsePoint]) -> String {
    let mut text = ply_header("ascii", points.len());
    for point in points {
        let ([x, y, z], [r, g, b]) = (point.position_in_gt.to_array(), point.rgb);
        writeln!(text, "{x} {y} {z} 0 {r} {g} {b}").unwrap();
    }
    text
}

#[test]
fn points_of_a_ply_come_back_into_the_frame_of_the_poses() {
    let root = tempfile::tempdir().unwrap();
    let turn = DQuat::from_scaled_axis(DVec3::new(0.4, -0.3, 1.0));
    let applied = Rigid::new(turn, DVec3::new(1.0, 2.0, -3.0));
    // `matrix` writes OpenGL's axes, and this turn has none: undo its half turn about x.
    let half_turn = Rigid::new(DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), DVec3::ZERO);
    let rows = matrix(&(applied * half_turn));
    let keys = format!(r#""ply_file_path": "p.ply", "applied_transform": {rows}"#);
    let text = transforms(&keys, |name| format!("images/{name}"));
    std::fs::write(root.path().join("transforms.json"), text).unwrap();
    for (name, _) in poses() {
        test_image(
            &root.path().join("images"),
            name,
            crate::scene_formats::SIZE,
        );
    }
    let expected = in_reach();
    for bytes in [ply_bin(&expected), ply_txt(&expected).into_bytes()] {
        std::fs::write(root.path().join("p.ply"), &bytes).unwrap();
        let found = read(root.path()).unwrap();
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(&expected) {
            let moved = applied.inverse().transform_point(expected.position_in_gt);
            assert!(found.position_in_gt.distance(moved) < 1e-6, "{found:?}");
            assert_eq!(found.rgb, expected.rgb);
            assert_eq!((found.error_px, found.n_images), (-1.0, 0));
        }
    }
}

#[test]
fn damaged_plys_are_errors_and_a_list_leads_nowhere_else() {
    let root = tempfile::tempdir().unwrap();
    let file = root.path().join("transforms.json");
    let name = |name: &str| {
        let keys = format!(r#""ply_file_path": "{name}""#);
        std::fs::write(&file, transforms(&keys, str::to_owned)).unwrap();
    };
    name("p.ply");
    assert!(
        read(root.path())
            .unwrap_err()
            .contains("not a regular file")
    );
    let header = ply_header("binary_little_endian", 4).len();
    let whole = ply_bin(&in_reach());
    for length in (0..header)
        .step_by(STRIDE)
        .chain((header..whole.len()).step_by(STRIDE))
    {
        error_of(root.path(), "p.ply", &whole[..length]);
    }
    for (text, reason) in [
        (ply_header("binary_big_endian", 0), "expected ascii"),
        (
            ply_header("ascii", 0).replace("float x", "float u"),
            "no x, y and z",
        ),
        (
            ply_header("ascii", 0).replace("float nx", "list uchar int n"),
            "property",
        ),
        (
            ply_header("ascii", 0).replace("vertex 0", "vertex -1"),
            "vertices",
        ),
        (
            ply_header("ascii", 1) + "1 2 three 0 1 2 3\n",
            "is no vertex",
        ),
        (
            ply_header("ascii", 1) + "1 nan 3 0 1 2 3\n",
            "point 0 lies at",
        ),
    ] {
        let error = error_of(root.path(), "p.ply", text.as_bytes());
        assert!(error.contains(reason), "{error}");
    }
    name("../p.ply");
    assert!(
        read(root.path())
            .unwrap_err()
            .contains("leads out of its folder")
    );
}
