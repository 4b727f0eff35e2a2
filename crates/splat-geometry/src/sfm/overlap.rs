//! Whether two views that are said to show one place show what they would have to.
//!
//! Plants, doors and chairs of one make stand in many places of a building, and some hundred matches on such a thing fit one rigid
//! motion as well as those of a place that is seen again. What is round it differs: there, landmarks of one view that the other
//! would have to show find no match.

use glam::DVec2;
use rayon::prelude::*;

use crate::matching::{PreparedDescriptors, matches};
use crate::sfm::reconstruction::Reconstruction;
use splat_types::transform::{Rigid, Similarity};

/// Cells of the image, by which it is counted: many landmarks on one thing are one piece of evidence.
const COLUMNS: usize = 8;
const ROWS: usize = 6;
/// Landmarks that a cell must be expected to show, and the share of them that must be found there.
const MIN_EXPECTED: usize = 4;
const MIN_FOUND: f64 = 0.12;
/// Least share of the landmarks, and of the cells. Where two corridors have a plant, a bench with books and a fire extinguisher of one
/// make each, 4 to 5 % of the landmarks are found, in 14 and 27 % of the cells; where a kitchen is seen again (kitchen7s), 22 % in 65 %.
const MIN_LANDMARKS: f64 = 0.1;
const MIN_CELLS: f64 = 0.2;
/// Landmarks that are seen from so much nearer or farther are not expected to look the same.
const MAX_ZOOM: f64 = 1.4;
/// The same of landmarks that are seen from so far aside, in radians.
const MAX_ANGLE: f64 = 0.26;
/// A match must lie so near to where its landmark is expected, in pixels of the working image at `Limits::max_error_px` 1: poses
/// are not adjusted together yet.
const NEAR: f64 = 8.0;

/// What is expected and what is found of it, summed over pairs of views.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Overlap {
    landmarks: Counts,
    /// Of the image, in which landmarks of the other view are expected.
    cells: Counts,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Counts {
    expected: usize,
    found: usize,
}

impl Counts {
    fn has(&self, share: f64) -> bool {
        self.found as f64 >= share * self.expected as f64
    }

    fn add(&mut self, other: Self) {
        self.expected += other.expected;
        self.found += other.found;
    }
}

impl Overlap {
    /// Whether enough of what two views of one place must share is there; so it is where nothing is expected.
    pub(crate) fn is_one_place(&self) -> bool {
        self.landmarks.has(MIN_LANDMARKS) && self.cells.has(MIN_CELLS)
    }

    fn add(&mut self, other: Self) {
        self.landmarks.add(other.landmarks);
        self.cells.add(other.cells);
    }
}

/// Of pairs of registered views: the frame of the first of each from that of the second.
pub(crate) fn overlap(
    scene: &Reconstruction,
    pairs: &[(usize, usize)],
    first_from_second: &Similarity,
    max_error_px: f64,
) -> Overlap {
    let second_from_first = first_from_second.inverse();
    let pose = |view: usize, to_other: &Similarity| {
        let own = scene.views[view].registered.as_ref()?.cam_from_world;
        Some(to_other.transform_pose(&own.inverse()).inverse())
    };
    let one = |&(a, b): &(usize, usize)| {
        let forth = raw_matches(scene, (a, b));
        let back: Vec<(u32, u32)> = forth.iter().map(|&(i, j)| (j, i)).collect();
        let mut sum = Overlap::default();
        if let Some((a_there, b_here)) = pose(a, &second_from_first).zip(pose(b, first_from_second))
        {
            sum.add(shown(scene, (a, b), &b_here, (&forth, max_error_px)));
            sum.add(shown(scene, (b, a), &a_there, (&back, max_error_px)));
        }
        sum
    };
    let all: Vec<Overlap> = pairs.par_iter().map(one).collect();
    let mut sum = Overlap::default();
    all.into_iter().for_each(|own| sum.add(own));
    sum
}

/// The same of a view that would stand at a pose in the frame of others, which are registered.
pub(crate) fn overlap_with(
    scene: &Reconstruction,
    others: &[usize],
    (view, cam_from_world): (usize, &Rigid),
    max_error_px: f64,
) -> Overlap {
    let mut sum = Overlap::default();
    for &other in others {
        let matches = raw_matches(scene, (other, view));
        let found = (&matches[..], max_error_px);
        sum.add(shown(scene, (other, view), cam_from_world, found));
    }
    sum
}

fn raw_matches(scene: &Reconstruction, (a, b): (usize, usize)) -> Vec<(u32, u32)> {
    let of = |view: usize| PreparedDescriptors::new(&scene.views[view].features.descriptors);
    matches(&of(a), &of(b))
}

/// Landmarks of one view in the image of another, whose pose is given in the frame of the first; with matches of the two, as
/// (feature of the first, feature of the second).
fn shown(
    scene: &Reconstruction,
    (from, to): (usize, usize),
    cam_from_world: &Rigid,
    (matches, max_error_px): (&[(u32, u32)], f64),
) -> Overlap {
    let (first, second) = (&scene.views[from], &scene.views[to]);
    let Some(own) = first.registered.as_ref().map(|r| r.cam_from_world) else {
        return Overlap::default();
    };
    let size = DVec2::new(
        f64::from(second.lens.width_px),
        f64::from(second.lens.height_px),
    );
    let [own_centre, centre] = [own, *cam_from_world].map(|pose| pose.inverse().translation);
    let cell = |pixel: DVec2| {
        let share = pixel / size * DVec2::new(COLUMNS as f64, ROWS as f64);
        let (x, y) = (share.x as usize, share.y as usize);
        y.min(ROWS - 1) * COLUMNS + x.min(COLUMNS - 1)
    };
    let place = |landmark: u32| {
        let point = scene.landmarks.get(landmark as usize)?.point;
        let in_second = cam_from_world.transform_point(point);
        let zoom = in_second.z / own.transform_point(point).z;
        let (a, b) = (point - own_centre, point - centre);
        let is_alike =
            (1.0 / MAX_ZOOM..MAX_ZOOM).contains(&zoom) && a.angle_between(b) <= MAX_ANGLE;
        let pixel = second.lens.project(in_second).filter(|_| is_alike)?;
        let is_inside = pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all();
        is_inside.then_some(pixel)
    };
    let expected: Vec<Option<DVec2>> = first.landmark_of.iter().map(|l| place(*l)).collect();
    let mut cells = [[0usize; 2]; COLUMNS * ROWS];
    for pixel in expected.iter().flatten() {
        cells[cell(*pixel)][0] += 1;
    }
    for &(theirs, ours) in matches {
        let found = second.features.pixels[ours as usize];
        let near = |pixel: &DVec2| found.distance(*pixel) <= NEAR * max_error_px;
        if let Some(pixel) = expected[theirs as usize].filter(near) {
            cells[cell(pixel)][1] += 1;
        }
    }
    let sum = |which: usize| cells.iter().map(|cell| cell[which]).sum::<usize>();
    let counted = cells.iter().filter(|cell| cell[0] >= MIN_EXPECTED);
    let is_found = |cell: &&[usize; 2]| cell[1] as f64 >= MIN_FOUND * cell[0] as f64;
    Overlap {
        landmarks: Counts {
            // A blurred image has no match for all.
            expected: sum(0).min(second.features.len()),
            found: sum(1),
        },
        cells: Counts {
            expected: counted.clone().count(),
            found: counted.filter(is_found).count(),
        },
    }
}
