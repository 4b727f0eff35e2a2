//! Grids of a mapper elsewhere, with their updates -> the grid that a viewer draws, and the frame that it lies in.

use std::collections::BTreeMap;

use glam::{DQuat, IVec2};

use splat_msgs::ros::TfMessage;
use splat_msgs::ros::navigation::{OccupancyGrid, OccupancyGridUpdate};
use splat_view::hub::Hub;
use splat_view::plan_frames::PlanFrames;
use splat_volume::grid::{Extent, FREE, Grid, OCCUPIED, UNKNOWN};

/// Cells along a side of a grid that is drawn; ours are no larger.
const MAX_SIDE: u32 = 4096;

/// Frames below the map frame that are remembered.
const MAX_FRAMES: usize = 16;

/// The newest grid as the messages say.
#[derive(Debug)]
pub struct FollowedGrid {
    map_frame: String,
    /// What turns frames into the map's; they share its origin where they are of a grid.
    turned: BTreeMap<String, DQuat>,
    frame: String,
    ground: f64,
    grid: Option<Grid>,
}

impl FollowedGrid {
    pub fn new(map_frame: &str) -> Self {
        Self {
            map_frame: map_frame.to_owned(),
            turned: BTreeMap::from([(map_frame.to_owned(), DQuat::IDENTITY)]),
            frame: map_frame.to_owned(),
            ground: 0.0,
            grid: None,
        }
    }

    /// The frame of the grid may be another than the map's.
    pub fn take_transforms(&mut self, message: &TfMessage) {
        let links = message.transforms.iter();
        for link in links.filter(|link| link.header.frame_id == self.map_frame) {
            let is_known = self.turned.contains_key(&link.child_frame_id);
            if let Some(found) = link.transform.to_rigid()
                && (is_known || self.turned.len() < MAX_FRAMES)
            {
                let name = link.child_frame_id.clone();
                self.turned.insert(name, found.rotation);
            }
        }
    }

    /// What is no sound grid is left out.
    pub fn take(&mut self, message: &OccupancyGrid) {
        let info = &message.info;
        let is_sized =
            (1..=MAX_SIDE).contains(&info.width) && (1..=MAX_SIDE).contains(&info.height);
        let n = u64::from(info.width) * u64::from(info.height);
        let resolution = f64::from(info.resolution);
        let origin = info.origin.position;
        let first = [origin.x, origin.y].map(|v| (v / resolution).round());
        let is_near = first.iter().all(|v| v.abs() < f64::from(i32::MAX / 4));
        if !is_sized
            || n != message.data.len() as u64
            || !(1e-3..=10.0).contains(&resolution)
            || !is_near
        {
            return;
        }
        message.header.frame_id.clone_into(&mut self.frame);
        self.ground = if origin.z.is_finite() { origin.z } else { 0.0 };
        self.grid = Some(Grid {
            extent: Extent {
                first: IVec2::new(first[0] as i32, first[1] as i32),
                width: info.width as i32,
                height: info.height as i32,
            },
            resolution,
            cells: message.data.iter().copied().map(known).collect(),
            is_cropped: false,
        });
    }

    /// One that reaches out of the grid is left out.
    pub fn update(&mut self, message: &OccupancyGridUpdate) {
        let Some(grid) = &mut self.grid else {
            return;
        };
        let at = |v: i32| usize::try_from(v).ok();
        let (Some(x), Some(y)) = (at(message.x), at(message.y)) else {
            return;
        };
        let (width, height) = (message.width as usize, message.height as usize);
        let side = grid.extent.width as usize;
        let is_inside = x.saturating_add(width) <= side
            && y.saturating_add(height) <= grid.extent.height as usize
            && message.data.len() == width.saturating_mul(height)
            && message.header.frame_id == self.frame;
        if !is_inside || width == 0 {
            return;
        }
        for (row, cells) in message.data.chunks_exact(width).enumerate() {
            let start = (y + row) * side + x;
            for (cell, new) in grid.cells[start..start + width].iter_mut().zip(cells) {
                *cell = known(*new);
            }
        }
    }

    /// Not while nobody has said how its frame lies.
    pub fn show(&self, hub: &Hub, frames: &mut PlanFrames) {
        if let (Some(grid), Some(turned)) = (&self.grid, self.turned.get(&self.frame)) {
            frames.set_grid(&self.frame, *turned, self.ground);
            hub.grid(grid, *turned, self.ground);
        }
    }
}

fn known(cell: i8) -> i8 {
    match cell {
        FREE | OCCUPIED => cell,
        _ => UNKNOWN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_msgs::ros::Header;
    use splat_msgs::ros::navigation::MapMetaData;

    fn header(frame: &str) -> Header {
        Header {
            frame_id: frame.to_owned(),
            ..Header::default()
        }
    }

    fn message(width: u32, height: u32) -> OccupancyGrid {
        let mut info = MapMetaData {
            resolution: 0.05,
            width,
            height,
            ..MapMetaData::default()
        };
        info.origin.position.x = -0.5;
        info.origin.position.z = -1.5;
        OccupancyGrid {
            header: header("map_level"),
            info,
            data: vec![-1; 12],
        }
    }

    #[test]
    fn updates_go_into_the_grid_and_bad_ones_do_not() {
        let mut followed = FollowedGrid::new("map");
        followed.take(&message(4, 3));
        let grid = followed.grid.clone().unwrap();
        assert_eq!(grid.extent.first, IVec2::new(-10, 0));
        let update = |x: i32, frame: &str| OccupancyGridUpdate {
            header: header(frame),
            x,
            y: 1,
            width: 2,
            height: 2,
            data: vec![0, 100, 50, 0],
        };
        for (x, frame) in [
            (3, "map_level"),
            (-1, "map_level"),
            (i32::MAX, "map_level"),
            (1, "map"),
        ] {
            followed.update(&update(x, frame));
            assert_eq!(followed.grid, Some(grid.clone()), "{x} {frame}");
        }
        followed.update(&update(1, "map_level"));
        let cells = &followed.grid.as_ref().unwrap().cells;
        assert_eq!(cells[4..], [-1, 0, 100, -1, -1, -1, 0, -1]);
        // Sizes that are lies.
        for lie in [message(5, 3), message(0, 3), message(1 << 20, 1 << 20)] {
            let before = followed.grid.clone();
            followed.take(&lie);
            assert_eq!(followed.grid, before);
        }
    }
}
