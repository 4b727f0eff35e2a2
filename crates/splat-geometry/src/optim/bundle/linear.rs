//! Observations at the present cameras and points -> their derivatives, and from those the reduced system.
//!
//! Chunks of points are worked on apart, each in storage of its own; their number is fixed.

use std::ops::Range;

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use crate::optim::bundle::problem::{Camera, Flat, MeasuredDepth, State, project, strayed, times};
use crate::optim::bundle::reduced::{HELD, LENS, Layout, Solution, System};
use crate::optim::bundle::relative_motion::{self, MotionRows};

/// Chunks of points that are summed apart.
const CHUNKS: usize = 8;

/// One observation, linearised and weighted: u and v by pose, lens and point. A measured depth has a row of its own.
#[derive(Debug)]
struct Row {
    slot: u32,
    residual: [f64; 2],
    by_pose: [[f64; 6]; 2],
    by_lens: [[f64; LENS]; 2],
    by_point: [[f64; 3]; 2],
}

/// Point-point block (xx xy xz yy yz zz) and gradient of all observations, and the rows of those that anything but
/// the point moves.
#[derive(Debug)]
struct PointBlock {
    rows: Range<usize>,
    v: [f64; 6],
    g: DVec3,
}

#[derive(Debug)]
struct Chunk {
    blocks: Vec<PointBlock>,
    rows: Vec<Row>,
}

#[derive(Debug)]
pub(crate) struct Normal {
    chunks: Vec<Chunk>,
    /// Of the poses that are held softly: (block row, information, gradient).
    holds: Vec<(usize, [[f64; 6]; 6], [f64; 6])>,
    motions: Vec<MotionRows>,
}

impl Normal {
    /// Sum of the squares of the weighted residuals.
    pub(crate) fn squares_px(&self) -> f64 {
        let rows = self.chunks.iter().flat_map(|c| &c.rows);
        rows.flat_map(|row| row.residual).map(|r| r * r).sum()
    }

    /// Their mean square.
    pub(crate) fn variance_px(&self) -> f64 {
        let n_rows: usize = self.chunks.iter().map(|c| c.rows.len()).sum();
        self.squares_px() / (2 * n_rows.max(1)) as f64
    }
}

pub(crate) fn linearise(flat: &Flat<'_>, state: &State, layout: &Layout) -> Normal {
    let rotations = state.rotations();
    let chunk = |points: Range<usize>| chunk(flat, state, layout, &rotations, points);
    let chunks = flat.chunks(CHUNKS).into_par_iter().map(chunk).collect();
    let mut holds = Vec::new();
    for (i, camera) in state.cameras.iter().enumerate() {
        if let Some(information) = camera.hold.filter(|_| layout.slot_of[i] != HELD) {
            let gradient = times(&information, &strayed(camera, &flat.start[i]));
            holds.push((layout.slot_of[i] as usize, information, gradient));
        }
    }
    Normal {
        chunks,
        holds,
        motions: relative_motion::linearise(&state.cameras, flat, layout),
    }
}

fn chunk(
    flat: &Flat<'_>,
    state: &State,
    layout: &Layout,
    rotations: &[DMat3],
    points: Range<usize>,
) -> Chunk {
    let mut out = Chunk {
        blocks: Vec::with_capacity(points.len()),
        rows: Vec::with_capacity(flat.seen(points.clone()).len()),
    };
    for point_ix in points {
        let start = out.rows.len();
        let (mut v, mut g) = ([0.0; 6], DVec3::ZERO);
        for seen in flat.seen(point_ix..point_ix + 1) {
            let camera_ix = seen.camera_ix as usize;
            let camera = &state.cameras[camera_ix];
            let turn = &rotations[camera_ix];
            let point = state.points[point_ix];
            let in_image = row(camera, turn, point, seen.pixel, flat);
            let in_depth = seen.depth.filter(|_| in_image.is_some());
            let in_depth = in_depth.map(|depth| depth_row(camera, turn, point, depth, flat));
            for mut row in in_image.into_iter().chain(in_depth) {
                let [a, b] = row.by_point.map(DVec3::from_array);
                g += a * row.residual[0] + b * row.residual[1];
                for (k, (i, j)) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
                    .into_iter()
                    .enumerate()
                {
                    v[k] += a[i] * a[j] + b[i] * b[j];
                }
                row.slot = layout.slot_of[camera_ix];
                if row.slot != HELD || (camera.shares_lens && flat.moves_lens()) {
                    out.rows.push(row);
                }
            }
        }
        out.blocks.push(PointBlock {
            rows: start..out.rows.len(),
            v,
            g,
        });
    }
    out
}

fn row(
    camera: &Camera,
    rotation: &DMat3,
    point: DVec3,
    pixel: DVec2,
    flat: &Flat<'_>,
) -> Option<Row> {
    let p = *rotation * point + camera.cam_from_world.translation;
    let (image, DVec2 { x, y }, stretch) = project(camera, p)?;
    let r = image - pixel;
    // Square root of the weight of iteratively reweighted least squares.
    let w = (1.0 / (1.0 + r.length_squared() / (flat.loss_px * flat.loss_px))).sqrt();
    let (fx, fy, iz) = (
        w * camera.intrinsics.fx,
        w * camera.intrinsics.fy,
        1.0 / p.z,
    );
    // Plane z = 1 by the point in the camera, then pixel by plane.
    let (x_by, y_by) = (DVec3::new(iz, 0.0, -x * iz), DVec3::new(0.0, iz, -y * iz));
    let x_by_turn = [-x * y, 1.0 + x * x, -y];
    let y_by_turn = [-1.0 - y * y, x * y, x];
    let k2 = 2.0 * camera.radial;
    let across = k2 * x * y;
    let u_by = [fx * (stretch + k2 * x * x), fx * across];
    let v_by = [fy * across, fy * (stretch + k2 * y * y)];
    let mut by_pose = [[0.0; 6]; 2];
    let mut by_point = [[0.0; 3]; 2];
    for (by, (pose, in_world)) in [u_by, v_by]
        .into_iter()
        .zip(by_pose.iter_mut().zip(&mut by_point))
    {
        let in_cam = x_by * by[0] + y_by * by[1];
        pose[..3].copy_from_slice(&in_cam.to_array());
        for k in 0..3 {
            pose[3 + k] = by[0] * x_by_turn[k] + by[1] * y_by_turn[k];
        }
        *in_world = (rotation.transpose() * in_cam).to_array();
    }
    let r2 = x * x + y * y;
    let by_lens = if camera.shares_lens {
        [
            [fx * x * stretch, fx * x * r2],
            [fy * y * stretch, fy * y * r2],
        ]
    } else {
        [[0.0; LENS]; 2]
    };
    Some(Row {
        slot: HELD,
        residual: [w * r.x, w * r.y],
        by_pose,
        by_lens,
        by_point,
    })
}

/// The row of a measured depth, beside that of the pixel; the second residual is none. The lens has no part in it.
fn depth_row(
    camera: &Camera,
    rotation: &DMat3,
    point: DVec3,
    depth: MeasuredDepth,
    flat: &Flat<'_>,
) -> Row {
    let p = *rotation * point + camera.cam_from_world.translation;
    let r = depth.residual_px(p.z);
    let w = (1.0 / (1.0 + r * r / (flat.loss_px * flat.loss_px))).sqrt();
    // A shift of the camera along its axis moves z by as much; a turn (a, b, c) moves it by (a, b, c) x p.
    let by_z = -w * depth.px_per_inverse / (p.z * p.z);
    let none = [0.0; 6];
    Row {
        slot: HELD,
        residual: [w * r, 0.0],
        by_pose: [[0.0, 0.0, by_z, by_z * p.y, -by_z * p.x, 0.0], none],
        by_lens: [[0.0; LENS]; 2],
        by_point: [
            (rotation.transpose() * DVec3::new(0.0, 0.0, by_z)).to_array(),
            [0.0; 3],
        ],
    }
}

/// The system that is left of the cameras when each point follows them.
pub(crate) fn eliminate(
    normal: &Normal,
    layout: &Layout,
    moves_lens: bool,
    damping: f64,
) -> System {
    let part = |chunk: &Chunk| {
        let mut system = System::zero(layout);
        let mut room = Room::default();
        for block in &chunk.blocks {
            let rows = &chunk.rows[block.rows.clone()];
            if moves_lens {
                eliminate_with_lens(&mut system, rows, block, damping);
            }
            eliminate_point(&mut system, rows, block, (damping, moves_lens), &mut room);
        }
        system
    };
    let parts: Vec<System> = normal.chunks.par_iter().map(part).collect();
    let mut parts = parts.into_iter();
    let mut system = parts.next().unwrap_or_else(|| System::zero(layout));
    parts.for_each(|part| system.add(&part));
    for (slot, information, gradient) in &normal.holds {
        let own = system.block(*slot, *slot);
        for (k, value) in information.as_flattened().iter().enumerate() {
            own[k] += value;
        }
        (0..6).for_each(|k| system.gradient[*slot][k] += gradient[k]);
    }
    relative_motion::add(&mut system, &normal.motions, damping);
    system
}

/// Pose by point (6x3) of each row of one point, plain and times the inverse of the point's block.
#[derive(Debug, Default)]
struct Room {
    cross: Vec<[f64; 18]>,
    reduced: Vec<[f64; 18]>,
}

fn eliminate_point(
    system: &mut System,
    rows: &[Row],
    block: &PointBlock,
    (damping, moves_lens): (f64, bool),
    room: &mut Room,
) {
    let Some(inverse) = damped_inverse(&block.v, damping) else {
        return;
    };
    let lens = moves_lens.then(|| lens_by_point(rows));
    room.cross.clear();
    room.reduced.clear();
    for row in rows {
        let cross: [f64; 18] = std::array::from_fn(|k| {
            let (i, j) = (k / 3, k % 3);
            row.by_pose[0][i] * row.by_point[0][j] + row.by_pose[1][i] * row.by_point[1][j]
        });
        let reduced = times_symmetric(&cross, &inverse);
        room.cross.push(cross);
        room.reduced.push(reduced);
        if row.slot == HELD {
            continue;
        }
        let slot = row.slot as usize;
        let [u, v] = row.by_pose;
        for i in 0..6 {
            let by_point = DVec3::new(reduced[3 * i], reduced[3 * i + 1], reduced[3 * i + 2]);
            system.gradient[slot][i] +=
                u[i] * row.residual[0] + v[i] * row.residual[1] - by_point.dot(block.g);
            if let Some(lens) = &lens {
                for (k, lens) in lens.iter().enumerate() {
                    system.border[slot][LENS * i + k] +=
                        u[i] * row.by_lens[0][k] + v[i] * row.by_lens[1][k] - by_point.dot(*lens);
                }
            }
        }
        let own = system.block(slot, slot);
        for i in 0..6 {
            for j in 0..6 {
                own[6 * i + j] += u[i] * u[j] + v[i] * v[j];
            }
            own[7 * i] += damping * (u[i] * u[i] + v[i] * v[i]);
        }
        subtract(own, &reduced, &cross);
    }
    for (i, a) in rows.iter().enumerate().filter(|r| r.1.slot != HELD) {
        for (j, b) in rows[..i].iter().enumerate().filter(|r| r.1.slot != HELD) {
            if a.slot >= b.slot {
                let block = system.block(a.slot as usize, b.slot as usize);
                subtract(block, &room.reduced[i], &room.cross[j]);
            }
            // Two observations by one camera need both.
            if a.slot <= b.slot {
                let block = system.block(b.slot as usize, a.slot as usize);
                subtract(block, &room.reduced[j], &room.cross[i]);
            }
        }
    }
}

fn eliminate_with_lens(system: &mut System, rows: &[Row], block: &PointBlock, damping: f64) {
    let Some(inverse) = damped_inverse(&block.v, damping) else {
        return;
    };
    let by_point = lens_by_point(rows);
    let reduced = by_point.map(|v| inverse * v);
    for row in rows {
        let [u, v] = row.by_lens;
        for i in 0..LENS {
            system.lens_gradient[i] += u[i] * row.residual[0] + v[i] * row.residual[1];
            for j in 0..LENS {
                system.corner[i][j] += u[i] * u[j] + v[i] * v[j];
            }
            system.corner[i][i] += damping * (u[i] * u[i] + v[i] * v[i]);
        }
    }
    for (i, reduced) in reduced.iter().enumerate() {
        system.lens_gradient[i] -= reduced.dot(block.g);
        (0..LENS).for_each(|j| system.corner[i][j] -= reduced.dot(by_point[j]));
    }
}

fn lens_by_point(rows: &[Row]) -> [DVec3; LENS] {
    std::array::from_fn(|k| {
        let one = |row: &Row| {
            let [a, b] = row.by_point.map(DVec3::from_array);
            a * row.by_lens[0][k] + b * row.by_lens[1][k]
        };
        rows.iter().map(one).sum()
    })
}

/// `to -= left * right^T` of 6x3 and 6x3.
fn subtract(to: &mut [f64; 36], left: &[f64; 18], right: &[f64; 18]) {
    // Columns of `right` side by side: the inner loop runs along one row.
    let turned: [[f64; 6]; 3] = std::array::from_fn(|k| std::array::from_fn(|c| right[3 * c + k]));
    for (to, left) in to
        .as_chunks_mut::<6>()
        .0
        .iter_mut()
        .zip(left.as_chunks::<3>().0)
    {
        for c in 0..6 {
            to[c] -= left[0] * turned[0][c] + left[1] * turned[1][c] + left[2] * turned[2][c];
        }
    }
}

fn times_symmetric(left: &[f64; 18], right: &DMat3) -> [f64; 18] {
    let columns = right.to_cols_array_2d();
    std::array::from_fn(|k| {
        let (row, column) = (3 * (k / 3), &columns[k % 3]);
        left[row] * column[0] + left[row + 1] * column[1] + left[row + 2] * column[2]
    })
}

fn damped_inverse(v: &[f64; 6], damping: f64) -> Option<DMat3> {
    let own = |value: f64| value + damping * value + 1e-12;
    let damped = DMat3::from_cols(
        DVec3::new(own(v[0]), v[1], v[2]),
        DVec3::new(v[1], own(v[3]), v[4]),
        DVec3::new(v[2], v[4], own(v[5])),
    );
    let inverse = damped.inverse();
    inverse.is_finite().then_some(inverse)
}

/// Moves every point to where the step of the cameras leaves it best.
pub(crate) fn follow(
    normal: &Normal,
    solution: &Solution,
    (damping, moves_lens): (f64, bool),
    points: &mut [DVec3],
) {
    let mut rest = points;
    let mut parts = Vec::with_capacity(normal.chunks.len());
    for chunk in &normal.chunks {
        let (own, after) = rest.split_at_mut(chunk.blocks.len());
        parts.push((chunk, own));
        rest = after;
    }
    parts.into_par_iter().for_each(|(chunk, points)| {
        for (block, point) in chunk.blocks.iter().zip(points) {
            let Some(inverse) = damped_inverse(&block.v, damping) else {
                continue;
            };
            let mut right = block.g;
            for row in &chunk.rows[block.rows.clone()] {
                for k in 0..2 {
                    let mut moved = 0.0;
                    if row.slot != HELD {
                        let step = &solution.poses[row.slot as usize];
                        moved += (0..6).map(|i| row.by_pose[k][i] * step[i]).sum::<f64>();
                    }
                    if moves_lens {
                        let step = &solution.lens;
                        moved += (0..LENS).map(|i| row.by_lens[k][i] * step[i]).sum::<f64>();
                    }
                    right += DVec3::from_array(row.by_point[k]) * moved;
                }
            }
            *point -= inverse * right;
        }
    });
}

#[cfg(test)]
mod tests;
