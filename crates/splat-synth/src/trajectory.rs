//! The way of a camera that someone carries by hand: (scene, time, seed) -> pose.

use std::f64::consts::TAU;

use glam::{DMat3, DQuat, DVec3};

use crate::hallway::{BAY, N_WALKED};
use crate::noise::pick;
use crate::settings::SceneKind;
use splat_types::transform::Rigid;

/// One round takes this long at speed 1; then it goes on, closed and smooth.
pub(crate) const LAP_SECS: f64 = 12.0;

/// `hand`: its seed, and how much more than usual it trembles.
pub(crate) fn gt_from_cam(scene: SceneKind, secs: f64, hand: (u32, f64)) -> Rigid {
    let turn = TAU * secs / LAP_SECS;
    let (position, target) = match scene {
        SceneKind::Room => around_the_table(turn),
        SceneKind::Facade => along_the_street(turn),
        SceneKind::Corridor => through_the_corridor(turn),
        SceneKind::Hallway => along_the_hallway(secs),
        SceneKind::House => through_both_rooms(turn),
    };
    let (seed, shaken) = hand;
    let trembling = shake(secs, seed, 0.008 * shaken);
    let rotation = looking(target - position) * DQuat::from_scaled_axis(trembling);
    Rigid::new(
        rotation,
        position + shake(secs, seed ^ 0x51ED, 0.012 * shaken) + step_bob(secs),
    )
}

/// To and fro on an arc round the table; higher and wider on the way out than on the way back.
fn around_the_table(turn: f64) -> (DVec3, DVec3) {
    let angle = (-95.0 - 82.0 * turn.cos()).to_radians();
    let wide = 1.0 + 0.07 * turn.sin();
    let position = DVec3::new(
        2.05 * wide * angle.cos(),
        1.62 * wide * angle.sin(),
        1.5 + 0.16 * turn.sin(),
    );
    let glance = 0.35 * (2.0 * turn).sin();
    let target = DVec3::new(
        -0.35 * position.x,
        -0.35 * position.y,
        1.02 + 0.12 * (3.0 * turn).sin(),
    );
    (
        position,
        target + DVec3::new(-angle.sin(), angle.cos(), 0.0) * glance,
    )
}

/// Sideways before the house and back, nearer on the way back.
fn along_the_street(turn: f64) -> (DVec3, DVec3) {
    let position = DVec3::new(
        -4.4 * turn.cos(),
        -7.8 + 0.8 * turn.sin(),
        1.65 + 0.1 * turn.sin(),
    );
    let target = DVec3::new(
        0.8 * position.x + 0.9 * (2.0 * turn).sin(),
        0.0,
        2.45 + 0.4 * turn.sin(),
    );
    (position, target)
}

/// Once round the block of corridors, looking ahead into the bend and now and then to a side.
fn through_the_corridor(turn: f64) -> (DVec3, DVec3) {
    let place = |turn: f64| {
        // A squircle keeps to the middle of four straight corridors and rounds their corners.
        let (sin, cos) = turn.sin_cos();
        let round = (cos.powi(4) + sin.powi(4)).powf(-0.25);
        DVec3::new(2.75 * cos * round, 2.25 * sin * round, 1.55)
    };
    let side = 0.3 * (3.0 * turn).sin();
    let position = place(turn);
    let ahead = place(turn + 0.45) - position;
    let across = DVec3::new(-ahead.y, ahead.x, 0.0);
    (position, position + ahead + across * side - DVec3::Z * 0.1)
}

/// A figure of eight (the lemniscate of Gerono) whose crossing lies in the door, looking ahead and now and then to a side.
fn through_both_rooms(turn: f64) -> (DVec3, DVec3) {
    let place = |turn: f64| DVec3::new(2.5 * turn.sin(), 0.85 * (2.0 * turn).sin(), 1.45);
    let side = 0.8 * (3.0 * turn).sin();
    let position = place(turn);
    let ahead = place(turn + 0.3) - position;
    let across = DVec3::new(-ahead.y, ahead.x, 0.0);
    (position, position + ahead + across * side - DVec3::Z * 0.2)
}

/// Straight on, and at rest at the end; the camera looks about as often as bays go by, so that bays look alike, too.
fn along_the_hallway(secs: f64) -> (DVec3, DVec3) {
    const METRES_PER_SEC: f64 = 1.1;
    let position = DVec3::new((METRES_PER_SEC * secs).min(N_WALKED * BAY), 0.0, 1.5);
    let side = 0.35 * (TAU * position.x / (2.0 * BAY)).sin();
    (position, position + DVec3::new(1.0, side, -0.08))
}

/// Camera axes (x right, y down, z forward) for someone who looks along `forward` with a level horizon.
fn looking(forward: DVec3) -> DQuat {
    let forward = forward.normalize();
    let right = forward.cross(DVec3::Z).normalize();
    DQuat::from_mat3(&DMat3::from_cols(right, forward.cross(right), forward))
}

/// Three slow waves on each axis, never in step.
fn shake(secs: f64, seed: u32, size: f64) -> DVec3 {
    let wave = |axis: u32| {
        (0..3)
            .map(|n| {
                let id = 10 * axis + n;
                let hertz = 0.35 + 0.5 * f64::from(n) + 0.3 * f64::from(pick(seed, id));
                let phase = TAU * f64::from(pick(seed, 100 + id));
                (TAU * hertz * secs + phase).sin() / (1.0 + f64::from(n))
            })
            .sum::<f64>()
    };
    DVec3::new(wave(0), wave(1), wave(2)) * size
}

/// The head goes up and down with every step.
fn step_bob(secs: f64) -> DVec3 {
    DVec3::Z * 0.012 * (TAU * 1.7 * secs).sin()
}
