//! A scene of another program as the reference of `eval`: the stamps are those that its replay gives the frames.

use crate::scene_formats::{colmap, pinhole};
use splat_io::scene_formats::scene::Layout;
use splat_mapper::eval::evaluation::evaluate;
use splat_mapper::eval::trajectory::{TimedPose, write_tum};

#[test]
fn eval_takes_a_scene_as_reference() {
    let root = tempfile::tempdir().unwrap();
    colmap(root.path(), &pinhole());
    let timed = Layout::find(root.path())
        .unwrap()
        .views(640)
        .unwrap()
        .into_iter()
        .map(|view| TimedPose {
            stamp: view.stamp,
            pose: view.gt_from_cam,
        });
    let timed: Vec<TimedPose> = timed.collect();
    write_tum(&timed, &root.path().join("keyframes.tum")).unwrap();
    for reference in [root.path().to_owned(), root.path().join("sparse/0")] {
        let figures = evaluate(root.path(), &reference).unwrap();
        assert_eq!((figures.registered, figures.reference), (3, 3));
        assert!(figures.ate_rmse.unwrap() < 1e-6);
    }
}
