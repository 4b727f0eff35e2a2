//! How far each keyframe's pose can be trusted, as a table.

use std::path::Path;

use crate::eval::error::{EvalError, write_atomically};
use splat_geometry::answer::PoseQuality;
use splat_types::time::Stamp;

const HEADER: &str =
    "keyframe,stamp_s,inliers,parallax_deg,reprojection_px,std_translation,std_rotation_deg\n";

/// One line a keyframe. Standard deviations are those of the least certain axis, in the map's unit and degrees, if
/// landmarks were exact; empty where the geometry states none.
pub fn write_health(rows: &[(u32, Stamp, PoseQuality)], path: &Path) -> Result<(), EvalError> {
    write_atomically("the keyframes' health", table(rows).as_bytes(), path)
}

fn table(rows: &[(u32, Stamp, PoseQuality)]) -> String {
    let mut text = HEADER.to_owned();
    for (id, stamp, health) in rows {
        let std = health.std().map_or(",".to_owned(), |(along, about)| {
            format!("{along:.3e},{about:.3e}")
        });
        text += &format!(
            "{id},{stamp},{},{:.3},{:.3},{std}\n",
            health.n_inliers, health.parallax_deg, health.reprojection_px
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_keyframe_is_a_line_and_what_is_unknown_stays_empty() {
        let mut covariance = [[0.0; 6]; 6];
        (covariance[1][1], covariance[5][5]) = (4e-6, 1e-6);
        let known = PoseQuality {
            n_inliers: 120,
            parallax_deg: 3.25,
            reprojection_px: 0.4,
            covariance: Some(covariance),
        };
        let stamp = Stamp::from_secs(1.5);
        let text = table(&[(3, stamp, known), (4, stamp, PoseQuality::default())]);
        let lines: Vec<&str> = text.lines().skip(1).collect();
        assert_eq!(
            lines,
            [
                "3,1.500000000,120,3.250,0.400,2.000e-3,5.730e-2",
                "4,1.500000000,0,0.000,0.000,,",
            ]
        );
        let doubled = known.rescaled(2.0).std().unwrap();
        assert!(
            (doubled.0 - 4e-3).abs() < 1e-12 && (doubled.1 - known.std().unwrap().1).abs() < 1e-12
        );
    }
}
