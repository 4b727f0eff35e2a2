use super::*;

/// A wall at 2 m, and from column `edge` on one at 4 m; row 0 without depth.
fn two_walls(edge: u32) -> DepthMap {
    let mut map = DepthMap::empty(40, 30);
    for at in 40..1200 {
        map.depth[at] = if (at as u32 % 40) < edge { 2.0 } else { 4.0 };
        map.confidence[at] = 1.0;
    }
    map
}

#[test]
fn features_have_the_depth_under_them_but_none_beside_a_jump() {
    let map = two_walls(20);
    // The image has twice as many pixels each way.
    let pixels = [
        DVec2::new(21.0, 31.0),
        DVec2::new(61.0, 31.0),
        DVec2::new(39.0, 31.0),
        DVec2::new(41.0, 31.0),
        DVec2::new(21.0, 1.0),
        DVec2::new(-3.0, 31.0),
    ];
    let depths = FeatureDepths::new(&pixels, (80, 60), &map, 2e-3).unwrap();
    let inverse = |ix| depths.of(ix).map(|depth| depth.inverse);
    assert_eq!(inverse(0), Some(0.5));
    assert_eq!(inverse(1), Some(0.25));
    for ix in 2..7 {
        assert_eq!(inverse(ix), None, "feature {ix}");
    }
    // At 2 m a standard deviation is 2e-3 * 4 m = 8 mm, which counts as the half pixel of a feature.
    let residual = depths.of(0).unwrap().residual_px(2.008);
    assert!((residual.abs() - FEATURE_PX).abs() < 0.01, "{residual}");
    assert!(FeatureDepths::new(&pixels, (80, 60), &DepthMap::empty(40, 30), 2e-3).is_none());
    assert!(FeatureDepths::new(&pixels, (80, 60), &DepthMap::none(), 2e-3).is_none());
}

#[test]
fn measured_depth_fills_what_was_not_matched_but_beside_jumps() {
    let measured = two_walls(20);
    let mut map = DepthMap::empty(20, 15);
    (map.depth[0], map.confidence[0]) = (3.0, 0.4);
    let row = 7 * 20;
    (map.depth[row + 1], map.confidence[row + 1]) = (3.0, 0.4);
    fill_measured(&mut map, &measured, 0.005);
    assert_eq!((map.depth[row + 1], map.confidence[row + 1]), (3.0, 0.4));
    assert_eq!((map.depth[row + 2], map.confidence[row + 2]), (2.0, 1.0));
    // 0.005 * 4 m is 2 % of it: twice what has full confidence.
    assert_eq!((map.depth[row + 15], map.confidence[row + 15]), (4.0, 0.5));
    let n_left = (0..20).filter(|x| map.confidence[row + x] == 0.0).count();
    assert!((1..=2).contains(&n_left), "{n_left} beside the jump");
}
