//! Where the robot's map frame lies among the splats. It is chosen once for a map, and saved with it: grids that were exported, goals and places that
//! somebody wrote down stay right in later runs.

use crate::transform::{Rigid, Similarity};

/// One camera in both frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapFrame {
    /// Units of the splats; optical axes.
    pub world_from_cam: Rigid,
    /// Metres, z up.
    pub map_from_camera: Rigid,
}

impl MapFrame {
    /// Takes splats to the map frame, `metres` a unit.
    pub fn map_from_world(&self, metres: f64) -> Similarity {
        let rotation = self.map_from_camera.rotation * self.world_from_cam.rotation.inverse();
        Similarity {
            scale: metres,
            rotation,
            translation: self.map_from_camera.translation
                - rotation * self.world_from_cam.translation * metres,
        }
    }
}
