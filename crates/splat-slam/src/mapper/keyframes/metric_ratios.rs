//! One keyframe's depth beside lengths in metres -> logarithms of metres per map unit.

use glam::DVec3;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::metric_scale_params::ScaleParams;
use splat_geometry::ransac::{self, Tries};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;

/// Pixels of a keyframe that depth is compared at, and the least.
const MAX_PIXELS: usize = 4000;
const MIN_PIXELS: usize = 100;
/// The floor: points of the lower half of the image on a plane seen from above within this angle of upright, as the
/// camera is held; off by less than this share of its distance; at least this share of the points.
const MAX_TILT: f64 = 0.7;
const FLOOR_ERROR: f64 = 0.02;
const MIN_FLOOR: f64 = 0.3;
const FLOOR_TRIALS: usize = 60;
/// Median logarithm of metres over map units of one keyframe.
fn depth_ratio(metres: &DepthMap, units: &DepthMap) -> Option<f64> {
    let n = units.depth.len();
    let (w, h) = (units.width_px as usize, units.height_px as usize);
    let (in_w, in_h) = (metres.width_px as usize, metres.height_px as usize);
    let mut logs: Vec<f64> = (0..n)
        .step_by((n / MAX_PIXELS).max(1))
        .filter_map(|at| {
            let (x, y) = (at % w, at / w);
            let (unit, _) = units.verified(at)?;
            let (metre, _) = metres.verified(y * in_h / h * in_w + x * in_w / w)?;
            Some(f64::from(metre / unit).ln())
        })
        .collect();
    if logs.len() < MIN_PIXELS {
        return None;
    }
    let middle = logs.len() / 2;
    Some(*logs.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Distance of the camera from the plane that it stands above, in map units.
fn height_above_floor(depth: &DepthMap, lens: &Intrinsics, seed: u64) -> Option<f64> {
    let lens = lens.resized(depth.width_px, depth.height_px);
    let w = depth.width_px as usize;
    let lower = depth.depth.len() / 2..depth.depth.len();
    let points: Vec<DVec3> = lower
        .step_by((depth.depth.len() / MAX_PIXELS).max(1))
        .filter_map(|at| {
            let pixel = glam::DVec2::new((at % w) as f64 + 0.5, (at / w) as f64 + 0.5);
            Some(lens.ray_in_cam(pixel) * f64::from(depth.verified(at)?.0))
        })
        .collect();
    if points.len() < MIN_PIXELS {
        return None;
    }
    let plane = |sample: [usize; 3]| {
        let [a, b, c] = sample.map(|i| points[i]);
        let normal = (b - a).cross(c - a).try_normalize()?;
        // OpenCV: y points down, so the floor's distance along it is positive.
        let normal = if normal.y < 0.0 { -normal } else { normal };
        let height = normal.dot(a);
        (normal.y >= MAX_TILT.cos() && height > 0.0).then_some((normal, height))
    };
    let heights = |(normal, height): &(DVec3, f64)| -> Vec<f64> {
        let along = points.iter().map(|p| normal.dot(*p));
        along
            .filter(|at| (at - height).abs() < FLOOR_ERROR * height)
            .collect()
    };
    let loss = |found: &(DVec3, f64), _| Some((points.len() - heights(found).len()) as f64);
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let tries = Tries::fixed(FLOOR_TRIALS);
    let (found, _) = ransac::search(&mut rng, points.len(), &tries, plane, loss)?;
    let on = heights(&found);
    let (n, height) = (on.len(), on.iter().sum::<f64>() / on.len().max(1) as f64);
    (n as f64 >= MIN_FLOOR * points.len() as f64).then_some(height)
}

/// Logarithms of metres per map unit by this keyframe's own depth: as a depth camera has it, and over the floor.
pub(crate) fn measure(registered: &mut RegisteredKeyframe, params: &ScaleParams) {
    let units = &registered.depth;
    if registered.depth_fit.log_metres.is_some() || units.width_px == 0 {
        return;
    }
    let by_depth = registered.keyframe.frame.sensor_depth.as_ref();
    let by_depth = by_depth.and_then(|metres| depth_ratio(metres, units));
    let by_height = (params.camera_height > 0.0)
        .then(|| {
            height_above_floor(
                units,
                &registered.intrinsics,
                u64::from(registered.keyframe.id),
            )
        })
        .flatten()
        .map(|units| (params.camera_height / units).ln());
    let unscaled = registered.depth_fit.factor.ln();
    registered.depth_fit.log_metres =
        Some([by_depth, by_height].map(|log| log.map(|l| l + unscaled)));
}

pub(crate) fn ratio(registered: &RegisteredKeyframe, which: usize) -> Option<f64> {
    Some(registered.depth_fit.log_metres?[which]? - registered.depth_fit.factor.ln())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(width_px: u32, height_px: u32, depth: impl Fn(u32, u32) -> f32) -> DepthMap {
        let n = width_px * height_px;
        let depth: Vec<f32> = (0..n).map(|k| depth(k % width_px, k / width_px)).collect();
        DepthMap {
            width_px,
            height_px,
            confidence: vec![1.0; depth.len()],
            depth,
        }
    }

    #[test]
    fn a_depth_image_of_another_size_gives_metres() {
        let units = flat(40, 30, |x, y| 1.0 + 0.1 * x as f32 + 0.05 * y as f32);
        let metres = flat(80, 60, |x, y| {
            3.0 * (1.0 + 0.1 * (x / 2) as f32 + 0.05 * (y / 2) as f32)
        });
        let log = depth_ratio(&metres, &units).unwrap();
        assert!((log - 3.0_f64.ln()).abs() < 1e-6);
        assert_eq!(depth_ratio(&DepthMap::none(), &units), None);
        assert_eq!(depth_ratio(&metres, &DepthMap::none()), None);
    }

    #[test]
    fn the_floor_is_found_below_a_camera_that_looks_ahead_and_down() {
        let lens = Intrinsics {
            width_px: 80,
            height_px: 60,
            fx: 70.0,
            fy: 70.0,
            cx: 40.0,
            cy: 30.0,
        };
        let tilt: f64 = 0.3;
        let down = DVec3::new(0.0, tilt.cos(), tilt.sin());
        // A floor 1.4 units below, and a box on it at every third column.
        let depth = flat(80, 60, |x, y| {
            let ray = lens.ray_in_cam(glam::DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            let share = down.dot(ray);
            let far = if share > 0.05 { 1.4 / share } else { 9.0 };
            (if x % 3 == 0 { 0.7 * far } else { far }) as f32
        });
        let height = height_above_floor(&depth, &lens, 1).unwrap();
        assert!((height - 1.4).abs() < 0.01, "{height}");
        let wall = flat(80, 60, |_, _| 3.0);
        assert_eq!(
            height_above_floor(&wall, &lens, 1),
            None,
            "a wall is no floor"
        );
        assert_eq!(height_above_floor(&DepthMap::none(), &lens, 1), None);
    }
}
