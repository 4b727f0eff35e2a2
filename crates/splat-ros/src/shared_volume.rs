//! The volume as it last was, for those who ask: services, and topics of what lies near the robot.

use glam::{DQuat, DVec3};

use splat_types::snapshot::Snapshot;
use splat_types::transform::Similarity;
use splat_volume::ellipsoids::{FusedKeyframe, Region, Scene};
use splat_volume::voxels::Voxels;

/// A volume that planners may ask; its blocks and the depth of its keyframes are shared with the one that goes on.
#[derive(Debug, Clone)]
pub struct SharedVolume {
    pub voxels: Voxels,
    pub keyframes: Vec<FusedKeyframe>,
    /// Depth beyond it was not fused, metres.
    pub max_range: f64,
    pub level_from_map: DQuat,
    /// Takes splats to where the volume is.
    pub level_from_world: Similarity,
    pub frames: VolumeFrames,
    /// Of the newest snapshot whose keyframes are in it.
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
}

/// Names of frames.
#[derive(Debug, Clone)]
pub struct VolumeFrames {
    pub map: String,
    /// Of the voxels.
    pub level: String,
}

impl SharedVolume {
    /// Turns points of a frame into the level one; an empty name stands for `otherwise`.
    pub(crate) fn level_from_frame(&self, name: &str, otherwise: &str) -> Result<DQuat, String> {
        let name = if name.is_empty() { otherwise } else { name };
        if name == self.frames.level {
            Ok(DQuat::IDENTITY)
        } else if name == self.frames.map {
            Ok(self.level_from_map)
        } else {
            Err(format!(
                "the frame {name:?} is neither {:?} nor {:?}",
                self.frames.map, self.frames.level
            ))
        }
    }

    /// A box whose sides are along the axes of the level frame.
    pub(crate) fn region(
        &self,
        frame: &str,
        low: [f32; 3],
        high: [f32; 3],
    ) -> Result<Region, String> {
        if self.level_from_frame(frame, &self.frames.level)? != DQuat::IDENTITY {
            return Err(format!(
                "a box in the frame {frame:?} leans against the volume: give it in {:?}",
                self.frames.level
            ));
        }
        let [low, high] = [low, high].map(|corner| DVec3::from_array(corner.map(f64::from)));
        let is_box = low.is_finite() && high.is_finite() && low.cmple(high).all();
        is_box.then_some(Region { low, high }).ok_or_else(|| {
            format!("{low} to {high} is no box: corners are finite, low is below high")
        })
    }

    pub(crate) fn scene(&self) -> Scene<'_> {
        Scene {
            voxels: &self.voxels,
            keyframes: &self.keyframes,
            max_range: self.max_range,
        }
    }

    /// Whether the splats of a snapshot lie where the volume's keyframes do.
    pub(crate) fn is_of(&self, snapshot: &Snapshot) -> bool {
        (snapshot.map_id, snapshot.epoch) == (self.map_id, self.epoch)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Nothing was seen; the level frame is another one than the map's.
    pub(crate) fn empty(level_from_map: DQuat) -> SharedVolume {
        let level = if level_from_map == DQuat::IDENTITY {
            "map"
        } else {
            "map_level"
        };
        SharedVolume {
            voxels: Voxels::new(0.05, 0.2),
            keyframes: Vec::new(),
            max_range: 5.0,
            level_from_map,
            level_from_world: Similarity::IDENTITY,
            frames: VolumeFrames {
                map: "map".to_owned(),
                level: level.to_owned(),
            },
            map_id: [7; 16],
            epoch: 3,
            revision: 17,
        }
    }

    #[test]
    fn boxes_are_checked() {
        let turned = empty(DQuat::from_rotation_x(0.2));
        let unit = ([0.0; 3], [1.0; 3]);
        assert!(turned.region("", unit.0, unit.1).is_ok());
        assert!(turned.region("map_level", unit.0, unit.1).is_ok());
        let leaning = turned.region("map", unit.0, unit.1).unwrap_err();
        assert!(leaning.contains("give it in \"map_level\""), "{leaning}");
        let unknown = turned.region("odom", unit.0, unit.1).unwrap_err();
        assert!(unknown.contains("neither"), "{unknown}");
        assert!(turned.region("", unit.1, unit.0).is_err());
        assert!(turned.region("", [f32::NAN; 3], unit.1).is_err());
        let level = empty(DQuat::IDENTITY);
        assert!(level.region("map", unit.0, unit.1).is_ok());
    }
}
