use super::*;

fn info(shift: f64, turn: DQuat) -> CameraInfo {
    let turn = DMat3::from_quat(turn).transpose().to_cols_array();
    CameraInfo {
        width: 640,
        height: 480,
        k: [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0],
        r: turn,
        p: [
            400.0,
            0.0,
            320.0,
            400.0 * shift,
            0.0,
            400.0,
            240.0,
            0.0,
            0.0,
            0.0,
            1.0,
            0.0,
        ],
        ..CameraInfo::default()
    }
}

#[test]
fn rectified_pairs_lie_side_by_side() {
    let (left, right) = (info(0.0, DQuat::IDENTITY), info(-0.12, DQuat::IDENTITY));
    let names = ["/stereo/left/image_rect", "/stereo/right/image_rect"];
    let mounted = second_from_first((names[0], &left), (names[1], &right)).unwrap();
    // What lies before the left camera lies to the left of the right one's axis.
    let point = mounted.transform_point(DVec3::Z);
    assert!(point.distance(DVec3::new(-0.12, 0.0, 1.0)) < 1e-12);
    assert!(second_from_first((names[0], &left), (names[1], &left)).is_none());
    assert!(
        second_from_first((names[0], &left), (names[1], &info(-80.0, DQuat::IDENTITY))).is_none()
    );
}

#[test]
fn raw_images_are_turned_out_of_the_rectified_pair() {
    let turns = [
        DQuat::from_rotation_y(0.05),
        DQuat::from_rotation_x(-0.03) * DQuat::from_rotation_z(0.02),
    ];
    // Both R turn the raw camera's rays into those of the rectified pair.
    let (left, right) = (info(0.0, turns[0]), info(-0.11, turns[1]));
    let mounted =
        second_from_first(("/cam0/image_raw", &left), ("/cam1/image_raw", &right)).unwrap();
    let point = DVec3::new(0.3, -0.2, 2.0);
    let in_rectified_right = turns[0] * point + DVec3::new(-0.11, 0.0, 0.0);
    let expected = turns[1].inverse() * in_rectified_right;
    assert!(mounted.transform_point(point).distance(expected) < 1e-9);
}

#[test]
fn partners_go_by_the_names_that_drivers_give() {
    let partner = |topic| partner_of(topic);
    assert_eq!(
        partner("/stereo/left/image_rect/compressed").unwrap(),
        "/stereo/right/image_rect/compressed"
    );
    assert_eq!(partner("/cam0/image_raw").unwrap(), "/cam1/image_raw");
    assert_eq!(
        partner("/camera/infra1/image_rect_raw").unwrap(),
        "/camera/infra2/image_rect_raw"
    );
    assert_eq!(partner("/camera/image_raw"), None);
}
