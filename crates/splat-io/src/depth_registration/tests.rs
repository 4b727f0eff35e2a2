use glam::DQuat;

use super::*;
use splat_msgs::ros::{Header, Pose, Quaternion, TfMessage, TransformStamped, Vector3};

fn info(f: f64, width: u32) -> CameraInfo {
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(width) * 0.375);
    CameraInfo {
        width,
        height: width * 3 / 4,
        k: [f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0],
        ..CameraInfo::default()
    }
}

/// A fixed link, as /tf_static has it.
fn link(parent: &str, child: &str, parent_from_child: &Rigid) -> TransformStamped {
    let (t, q) = (parent_from_child.translation, parent_from_child.rotation);
    TransformStamped {
        header: Header {
            frame_id: parent.to_owned(),
            ..Header::default()
        },
        child_frame_id: child.to_owned(),
        transform: Pose {
            position: Vector3 {
                x: t.x,
                y: t.y,
                z: t.z,
            },
            orientation: Quaternion {
                x: q.x,
                y: q.y,
                z: q.z,
                w: q.w,
            },
        },
    }
}

/// Both cameras on one body, as drivers have them.
fn transforms(colour_from_depth: &Rigid) -> Transforms {
    let body_from_colour = Rigid::new(DQuat::from_rotation_z(0.7), DVec3::new(0.1, 0.2, 0.3));
    let message = TfMessage {
        transforms: vec![
            link("body", "colour", &body_from_colour),
            link("body", "depth", &(body_from_colour * *colour_from_depth)),
        ],
    };
    let mut transforms = Transforms::default();
    transforms.insert(&message, true);
    transforms
}

fn lies(colour: &CameraInfo, depth: &CameraInfo, transforms: &Transforms) -> Registration {
    let of = |frame_id, info| Calibrated {
        frame_id,
        info: Some(info),
    };
    registration(&of("colour", colour), &of("depth", depth), transforms)
}

#[test]
fn depth_of_another_camera_lands_where_the_colour_camera_sees_it() {
    let (colour, depth) = (info(520.0, 640), info(290.0, 320));
    let colour_from_depth = Rigid::new(
        DQuat::from_rotation_y(0.02) * DQuat::from_rotation_x(-0.01),
        DVec3::new(-0.025, 0.004, -0.01),
    );
    // A wall that is slanted in the colour camera's view.
    let plane = |normal: DVec3, offset: f64| move |ray: DVec3| offset / normal.dot(ray);
    let wall = plane(DVec3::new(0.2, 0.1, 1.0), 3.0);
    let lens = lens_of_camera_info(&depth, false).unwrap();
    let mut map = DepthMap::empty(320, 240);
    for at in 0..320 * 240_usize {
        let pixel = DVec2::new((at % 320) as f64 + 0.5, (at / 320) as f64 + 0.5);
        let ray = lens.ray_in_cam(pixel).unwrap();
        // The wall's plane in the depth camera: n (R d z + t) = 3.
        let n = DVec3::new(0.2, 0.1, 1.0);
        let z =
            (3.0 - n.dot(colour_from_depth.translation)) / n.dot(colour_from_depth.rotation * ray);
        map.depth[at] = z as f32;
        map.confidence[at] = 1.0;
    }
    let Registration::By(mut by) = lies(&colour, &depth, &transforms(&colour_from_depth)) else {
        panic!("two cameras");
    };
    let found = by.register(&map);
    assert_eq!((found.width_px, found.height_px), (320, 240));
    let colour_lens = lens_of_camera_info(&colour, false)
        .unwrap()
        .resized(320, 240);
    let (mut n, mut worst) = (0, 0.0_f64);
    for y in 30..210_usize {
        for x in 40..280_usize {
            let Some((z, _)) = found.verified(y * 320 + x) else {
                continue;
            };
            let ray = colour_lens
                .ray_in_cam(DVec2::new(x as f64 + 0.5, y as f64 + 0.5))
                .unwrap();
            n += 1;
            worst = worst.max((f64::from(z) / wall(ray / ray.z) - 1.0).abs());
        }
    }
    assert!(n > 42_000, "{n} of 43,200");
    // A depth stands for the pixels about it: on the slanted wall a pixel is 1 mm.
    assert!(worst < 2e-3, "{worst}");
}

#[test]
fn what_is_near_hides_what_is_far() {
    let (colour, depth) = (info(320.0, 320), info(300.0, 320));
    let aside = Rigid::new(DQuat::IDENTITY, DVec3::new(-0.1, 0.0, 0.0));
    let mut map = DepthMap::empty(320, 240);
    for at in 0..320 * 240_usize {
        map.depth[at] = if at % 320 < 160 { 1.0 } else { 4.0 };
        map.confidence[at] = 1.0;
    }
    let Registration::By(mut by) = lies(&colour, &depth, &transforms(&aside)) else {
        panic!("two cameras");
    };
    let found = by.register(&map);
    // 1 m away the baseline of 0.1 m is 32 px, 4 m away 8 px: between lies what the depth camera did not see.
    let row = &found.depth[120 * 320..121 * 320];
    assert!(row[100] == 1.0 && row[120] == 1.0, "{:?}", &row[95..175]);
    assert!(row[140] == 0.0, "nothing was measured there");
    assert!((row[160] - 4.0).abs() < 1e-6);
}

#[test]
fn aligned_depth_is_left_as_it_is_and_what_nothing_places_is_refused() {
    let (colour, depth) = (info(520.0, 640), info(290.0, 320));
    let none = Transforms::default();
    assert!(matches!(
        lies(&colour, &info(260.0, 320), &none),
        Registration::Aligned
    ));
    let Registration::Unknown(reason) = lies(&colour, &depth, &none) else {
        panic!("nothing places it");
    };
    assert!(reason.contains("/tf_static"), "{reason}");
    let bare = Calibrated {
        frame_id: "depth",
        info: None,
    };
    let of_colour = Calibrated {
        frame_id: "colour",
        info: Some(&colour),
    };
    assert!(matches!(
        registration(&of_colour, &bare, &none),
        Registration::Aligned
    ));
}
