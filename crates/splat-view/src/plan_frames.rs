//! Plans in the frames that planners speak of -> the robot's map frame.

use glam::{DQuat, DVec3};

use splat_ros::plan::Plan;

/// A plan on the ground is drawn so far above it, metres: else it would be within.
const ABOVE_GROUND: f64 = 0.05;

/// The map frame, and that of the grid, which is level.
#[derive(Debug, Clone)]
pub struct PlanFrames {
    map: String,
    grid: Option<GridFrame>,
}

#[derive(Debug, Clone)]
struct GridFrame {
    name: String,
    map_from_grid: DQuat,
    /// Of the ground, metres.
    ground: f64,
}

impl PlanFrames {
    pub fn new(map: &str) -> Self {
        Self {
            map: map.to_owned(),
            grid: None,
        }
    }

    pub fn set_grid(&mut self, name: &str, map_from_grid: DQuat, ground: f64) {
        self.grid = Some(GridFrame {
            name: name.to_owned(),
            map_from_grid,
            ground,
        });
    }

    /// `None` for a frame that nothing here is in: the plan would be drawn in a wrong place. Planners in the plane leave z at 0: those ways
    /// are drawn on the ground.
    pub fn in_map(&self, plan: &Plan) -> Option<Vec<DVec3>> {
        let grid = self.grid.as_ref().filter(|g| g.name == plan.frame_id);
        if grid.is_none() && plan.frame_id != self.map {
            return None;
        }
        let is_flat = plan.points.iter().all(|p| p.z.abs() < 1e-9);
        let place = |p: &DVec3| match grid {
            Some(grid) if is_flat => {
                grid.map_from_grid * p.truncate().extend(grid.ground + ABOVE_GROUND)
            }
            Some(grid) => grid.map_from_grid * *p,
            None => *p,
        };
        Some(plan.points.iter().map(place).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_lies_on_the_ground_of_its_frame_or_is_not_drawn() {
        let mut frames = PlanFrames::new("map");
        let plan = |frame: &str, z: f64| Plan {
            frame_id: frame.to_owned(),
            points: vec![DVec3::new(1.0, 0.0, z), DVec3::new(2.0, 1.0, z)],
        };
        assert_eq!(frames.in_map(&plan("map_level", 0.0)), None);
        assert_eq!(frames.in_map(&plan("map", 0.0)).unwrap()[1].z, 0.0);
        let turn = DQuat::from_rotation_y(0.2);
        frames.set_grid("map_level", turn, -1.5);
        let found = frames.in_map(&plan("map_level", 0.0)).unwrap();
        let back = turn.inverse() * found[0];
        assert!((back - DVec3::new(1.0, 0.0, -1.45)).length() < 1e-12);
        let high = frames.in_map(&plan("map_level", 0.4)).unwrap();
        assert!(((turn.inverse() * high[0]).z - 0.4).abs() < 1e-12);
        assert_eq!(frames.in_map(&plan("odom", 0.4)), None);
    }
}
