//! Questions for distances -> answers, from the volume as it last was.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::shared_volume::SharedVolume;
use splat_volume::field;

/// Points of one question, 1.2 MB.
const MAX_POINTS: usize = 100_000;
/// Metres.
const DEFAULT_DISTANCE: f64 = 2.0;
const MAX_DISTANCE: f64 = 5.0;

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GetDistancesRequest {
    pub frame_id: String,
    /// x y z of each.
    pub points: Vec<f32>,
    pub max_distance: f32,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GetDistancesResponse {
    pub success: bool,
    pub message: String,
    pub frame_id: String,
    pub epoch: u32,
    pub revision: u32,
    pub distances: Vec<f32>,
    pub gradients: Vec<f32>,
    pub known: Vec<bool>,
}

pub(crate) fn no_volume() -> String {
    "there is no volume yet: status.warnings says why, if it is not to come".to_owned()
}

/// As it was asked for, or why not.
pub(crate) fn max_distance(asked: f32) -> Result<f64, String> {
    let max = f64::from(asked);
    if !(0.0..=MAX_DISTANCE).contains(&max) {
        return Err(format!(
            "max_distance is {max}, 0 to {MAX_DISTANCE} m are possible"
        ));
    }
    Ok(if max == 0.0 { DEFAULT_DISTANCE } else { max })
}

/// `Err`: why not.
pub(crate) fn answer(
    volume: Option<&SharedVolume>,
    asked: &GetDistancesRequest,
) -> Result<GetDistancesResponse, String> {
    let volume = volume.ok_or_else(no_volume)?;
    let (points, rest) = asked.points.as_chunks::<3>();
    let n = points.len();
    if !rest.is_empty() {
        return Err(format!(
            "{} numbers are no points of x y z",
            asked.points.len()
        ));
    }
    if n > MAX_POINTS {
        return Err(format!(
            "{n} points, at most {MAX_POINTS}: ask several times"
        ));
    }
    let max = max_distance(asked.max_distance)?;
    let frame = if asked.frame_id.is_empty() {
        &volume.frames.map
    } else {
        &asked.frame_id
    };
    let level_from_frame = volume.level_from_frame(frame, "")?;
    let points: Vec<DVec3> = points
        .iter()
        .map(|p| level_from_frame * DVec3::from_array(p.map(f64::from)))
        .collect();
    let found = field::distances(&volume.voxels, &points, max).map_err(|e| e.to_string())?;
    let back = level_from_frame.inverse();
    Ok(GetDistancesResponse {
        success: true,
        message: String::new(),
        frame_id: frame.clone(),
        epoch: volume.epoch,
        revision: volume.revision,
        distances: found.iter().map(|d| d.metres as f32).collect(),
        gradients: found
            .iter()
            .flat_map(|d| (back * d.gradient).as_vec3().to_array())
            .collect(),
        known: found.iter().map(|d| d.is_known).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared_volume::tests::empty;
    use glam::DQuat;

    fn volume() -> SharedVolume {
        empty(DQuat::from_rotation_x(0.2))
    }

    fn asked(points: Vec<f32>) -> GetDistancesRequest {
        GetDistancesRequest {
            points,
            ..GetDistancesRequest::default()
        }
    }

    #[test]
    fn what_nobody_has_seen_is_far_and_unknown() {
        let volume = volume();
        let answer = answer(Some(&volume), &asked(vec![0.0, 1.0, 2.0, 0.0, 1.0, 2.5])).unwrap();
        assert!(answer.success);
        assert_eq!((answer.epoch, answer.revision), (3, 17));
        assert_eq!(answer.distances, [2.0, 2.0]);
        assert_eq!(answer.known, [false, false]);
        assert_eq!(answer.gradients, [0.0; 6]);
        assert_eq!(answer.frame_id, "map");
    }

    #[test]
    fn bad_questions_are_refused_in_words() {
        let volume = volume();
        let refused = |question: &GetDistancesRequest| answer(Some(&volume), question).unwrap_err();
        assert!(refused(&asked(vec![1.0])).contains("no points of x y z"));
        assert!(refused(&asked(vec![0.0; 300_003])).contains("at most 100000"));
        assert!(refused(&asked(vec![f32::NAN; 3])).contains("not finite"));
        assert!(refused(&asked(vec![0.0, 0.0, 0.0, 1e6, 0.0, 0.0])).contains("near each other"));
        let far = GetDistancesRequest {
            max_distance: 50.0,
            ..asked(vec![])
        };
        assert!(refused(&far).contains("max_distance"));
        let odom = GetDistancesRequest {
            frame_id: "odom".to_owned(),
            ..asked(vec![])
        };
        assert!(refused(&odom).contains("map_level"));
        assert!(
            answer(None, &asked(vec![]))
                .unwrap_err()
                .contains("no volume yet")
        );
    }
}
