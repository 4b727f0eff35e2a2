//! Landmarks of a keyframe -> coarse depth to seed splats from until its dense depth comes.

use splat_geometry::answer::SeenLandmark;
use splat_types::depth::DepthMap;

/// Longer side: landmarks are some dozen pixels apart, and what lies between them is guessed anyway.
const SIDE_PX: u32 = 80;
/// Fewer say nothing of a surface.
const MIN_LANDMARKS: usize = 30;
/// Depths beyond this multiple of the median, or below one part of it, are of landmarks that no two rays have fixed.
const MAX_RATIO: f32 = 8.0;

/// Depth at the landmarks and none elsewhere, in their unit times `factor`. `size_px` is that of the keyframe's image.
/// `None`: there are too few.
pub(crate) fn landmark_depth(
    landmarks: &[SeenLandmark],
    size_px: [u32; 2],
    factor: f64,
) -> Option<DepthMap> {
    let longer = size_px[0].max(size_px[1]).max(1);
    let side = |px: u32| (px * SIDE_PX / longer).max(1);
    let (width_px, height_px) = (side(size_px[0]), side(size_px[1]));
    let is_before = |landmark: &&SeenLandmark| landmark.depth.is_finite() && landmark.depth > 0.0;
    let mut depths: Vec<f32> = landmarks
        .iter()
        .filter(is_before)
        .map(|l| l.depth)
        .collect();
    if depths.len() < MIN_LANDMARKS {
        return None;
    }
    let middle = depths.len() / 2;
    let median = *depths.select_nth_unstable_by(middle, f32::total_cmp).1;
    let n = (width_px * height_px) as usize;
    let mut map = DepthMap {
        width_px,
        height_px,
        depth: vec![0.0; n],
        confidence: vec![0.0; n],
    };
    for landmark in landmarks.iter().filter(is_before) {
        let ratio = landmark.depth / median;
        let [x, y] = landmark.pixel;
        let is_inside = x >= 0.0 && y >= 0.0 && x < size_px[0] as f32 && y < size_px[1] as f32;
        if !is_inside || !(MAX_RATIO.recip()..=MAX_RATIO).contains(&ratio) {
            continue;
        }
        let (column, row) = (
            (x * width_px as f32 / size_px[0] as f32) as u32,
            (y * height_px as f32 / size_px[1] as f32) as u32,
        );
        let at = (row.min(height_px - 1) * width_px + column.min(width_px - 1)) as usize;
        let depth = (f64::from(landmark.depth) * factor) as f32;
        // Of two in one cell the nearer one hides the other.
        if map.confidence[at] == 0.0 || depth < map.depth[at] {
            (map.depth[at], map.confidence[at]) = (depth, 1.0);
        }
    }
    Some(map)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn landmark(x: f32, y: f32, depth: f32) -> SeenLandmark {
        SeenLandmark {
            id: 0,
            pixel: [x, y],
            depth,
        }
    }

    #[test]
    fn depth_is_at_the_landmarks_the_nearer_first_and_nowhere_else() {
        let mut seen: Vec<SeenLandmark> = (0..40)
            .map(|i| landmark(16.0 * i as f32 + 4.0, 100.0, 2.0))
            .collect();
        seen.push(landmark(5.0, 101.0, 1.0));
        seen.push(landmark(5.0, 101.0, f32::NAN));
        seen.push(landmark(300.0, 400.0, 500.0));
        seen.push(landmark(-4.0, 1e9, 2.0));
        let map = landmark_depth(&seen, [640, 480], 3.0).unwrap();
        assert_eq!([map.width_px, map.height_px], [80, 60]);
        let known = map.confidence.iter().filter(|c| **c > 0.0).count();
        assert_eq!(
            known, 40,
            "one cell each; none too far, outside or without number"
        );
        let row = 100 * 60 / 480 * 80;
        assert_eq!(
            map.verified(row),
            Some((3.0, 1.0)),
            "the nearer of two, scaled"
        );
        assert_eq!(map.verified(row + 2), Some((6.0, 1.0)));
        assert_eq!(map.verified(row + 1), None);
    }

    #[test]
    fn a_few_landmarks_give_no_depth() {
        let seen = vec![landmark(1.0, 1.0, 2.0); MIN_LANDMARKS - 1];
        assert_eq!(landmark_depth(&seen, [640, 480], 1.0), None);
        assert_eq!(landmark_depth(&[], [0, 0], 1.0), None);
    }
}
