//! Landmarks and views -> bundle adjustment problems and back: around one view, or of a whole submap.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use crate::optim::bundle::adjust;
use crate::optim::bundle::problem::{Camera, Observation, Problem, Settings};
use crate::optim::pose_covariance::pose_information;
use crate::sfm::gyroscope;
use crate::sfm::landmarks::filter;
use crate::sfm::limits::Limits;
use crate::sfm::metric_submap::make_metric;
use crate::sfm::odometry::motions;
use crate::sfm::params::LocalBaPrior;
use crate::sfm::reconstruction::{NONE, Reconstruction};
use crate::stats::median;
use splat_types::transform::{Rigid, Similarity};

/// Views that move freely in a local adjustment.
const N_LOCAL: usize = 7;
/// Views next to those that may bend.
const N_SOFT: usize = 8;
/// Residual at which the loss bends, as a share of the largest error of an inlier.
const LOSS_SHARE: f64 = 0.5;
/// Views from which on the focal length can be determined from depth (GEOMETRY.md measured 3 to be too few, 6 enough).
const MIN_FOCAL_VIEWS: usize = 6;
/// Share of the squared errors that a radial coefficient must explain: with few views a small one always fits some
/// error, by far more than its standard deviation. It must also move a corner by more than an inlier may be off: below
/// that a pinhole loses no matches, and resampling the images is not worth it.
const CLEAR_GAIN: f64 = 0.1;

/// What an adjustment may change.
struct Moves<'a> {
    free: &'a [usize],
    /// These, too, but their landmarks outside of the adjustment hold them.
    soft: &'a [usize],
    lens: bool,
    max_steps: usize,
}

/// Adjusts a view and those that share most landmarks with it. Of the others the nearest may bend, if the
/// parameters say so; all others stay.
pub(crate) fn adjust_local(scene: &mut Reconstruction, view_ix: usize, limits: &Limits) {
    let Some(submap) = scene.submap_of(view_ix) else {
        return;
    };
    if scene.submaps[submap as usize].views.len() <= N_LOCAL + 1 {
        adjust_global(scene, submap, limits.max_error_px, 6);
        return;
    }
    // The first view holds the frame of its submap.
    let first = scene.submaps[submap as usize].views[0];
    let mut ranked: Vec<(u32, usize)> = scene
        .shared_counts(view_ix)
        .into_iter()
        .map(|(s, n)| (n, s))
        .collect();
    ranked.sort_by(|a, b| b.0.cmp(&a.0).then(b.1.cmp(&a.1)));
    let pick = |from: usize, n: usize| {
        let picked = ranked.iter().skip(from).take(n).map(|r| r.1);
        picked.filter(|&s| s != first).collect::<Vec<usize>>()
    };
    let mut free = pick(0, N_LOCAL - 1);
    free.push(view_ix);
    let soft = match limits.local_ba_prior {
        LocalBaPrior::Fixed => Vec::new(),
        LocalBaPrior::Soft => pick(N_LOCAL - 1, N_SOFT),
    };
    let moves = Moves {
        free: &free,
        soft: &soft,
        lens: false,
        max_steps: 5,
    };
    run(scene, &moves, limits.max_error_px);
}

/// Adjusts all views of a submap but the first, and keeps its scale where no depth was measured.
pub(crate) fn adjust_global(
    scene: &mut Reconstruction,
    submap: u32,
    max_error_px: f64,
    max_steps: usize,
) {
    let views = scene.submaps[submap as usize].views.clone();
    let Some(&first) = views.first() else { return };
    make_metric(scene, submap);
    let before = spread(scene, first, &views);
    run(scene, &of_all(&views, max_steps), max_error_px);
    let is_free = !scene.submaps[submap as usize].is_metric;
    if let Some(centre) = scene.centre(first).filter(|_| is_free) {
        let after = spread(scene, first, &views);
        if let Some(new_from_old) = kept_scale(centre, &before, &after) {
            scene.transform(submap, &new_from_old);
        }
    }
    scene.submaps[submap as usize].n_adjusted = views.len();
    scene.n_rebuilt += 1;
}

/// With one camera held the scale is free; it would drift from one adjustment to the next. What puts it back, about that
/// camera, by the distances of the others to it before and after. `None` where there are none.
pub(crate) fn kept_scale(centre: DVec3, before: &[f64], after: &[f64]) -> Option<Similarity> {
    let pairs = after.iter().zip(before);
    let mut ratios: Vec<f64> = pairs.map(|(a, b)| b / a).collect();
    ratios.retain(|r| r.is_finite() && *r > 0.0);
    median(&mut ratios).map(|scale| Similarity {
        scale,
        translation: centre * (1.0 - scale),
        ..Similarity::IDENTITY
    })
}

/// All views of a submap but the first, which holds the frame.
fn of_all(views: &[usize], max_steps: usize) -> Moves<'_> {
    Moves {
        free: &views[1..],
        soft: &[],
        lens: views.len() >= MIN_FOCAL_VIEWS,
        max_steps,
    }
}

fn spread(scene: &Reconstruction, first: usize, views: &[usize]) -> Vec<f64> {
    let origin = scene.centre(first).unwrap_or_default();
    views[1..]
        .iter()
        .map(|&s| scene.centre(s).unwrap_or_default().distance(origin))
        .collect()
}

/// Median reprojection error over the landmarks of some views.
pub(crate) fn median_error_px(scene: &Reconstruction, views: &[usize]) -> f64 {
    let mut errors = Vec::new();
    for landmark in scene.landmarks_of(views) {
        let landmark = &scene.landmarks[landmark as usize];
        errors.extend(
            landmark
                .seen
                .iter()
                .filter_map(|&at| scene.observation(at))
                .map(|s| s.error_px(landmark.point)),
        );
    }
    median(&mut errors).unwrap_or(0.0)
}

/// Bundle adjustment of a part of the scene, apart from it.
#[derive(Debug)]
pub(crate) struct AdjustTask {
    pub(crate) problem: Problem,
    /// The view of each camera, and the landmark of each point.
    pub(crate) views: Vec<usize>,
    pub(crate) landmarks: Vec<u32>,
    /// Whether the lens of uncalibrated views may change.
    pub(crate) moves_lens: bool,
    settings: Settings,
    least_bend_px: f64,
}

impl AdjustTask {
    fn of(scene: &Reconstruction, moves: &Moves<'_>, max_error_px: f64) -> Self {
        let landmarks = scene.landmarks_of(moves.free);
        let loss_px = LOSS_SHARE * max_error_px;
        let (problem, views) = problem(scene, moves, &landmarks, loss_px);
        // One that is found keeps its lens more easily than it got it: near the limit it would come and go.
        let share = if scene.radial == 0.0 { 1.0 } else { 0.5 };
        Self {
            problem,
            views,
            landmarks,
            moves_lens: moves.lens,
            settings: Settings {
                max_steps: moves.max_steps,
                loss_px,
                refine_focal: moves.lens,
                refine_radial: moves.lens,
            },
            least_bend_px: share * max_error_px,
        }
    }

    /// That of a whole submap, but for its first view.
    pub(crate) fn of_submap(
        scene: &Reconstruction,
        submap: u32,
        max_error_px: f64,
        max_steps: usize,
    ) -> Self {
        let views = &scene.submaps[submap as usize].views;
        Self::of(scene, &of_all(views, max_steps), max_error_px)
    }

    pub(crate) fn solve(&mut self) {
        adjust_lens(&mut self.problem, &self.settings, self.least_bend_px);
    }
}

fn run(scene: &mut Reconstruction, moves: &Moves<'_>, max_error_px: f64) {
    let mut task = AdjustTask::of(scene, moves, max_error_px);
    task.solve();
    let AdjustTask {
        problem,
        views,
        landmarks,
        ..
    } = task;
    for (&view, camera) in views.iter().zip(&problem.cameras) {
        if let Some(registered) = &mut scene.views[view].registered {
            registered.cam_from_world = camera.cam_from_world;
        }
    }
    let moved = problem
        .cameras
        .iter()
        .zip(&views)
        .find(|(c, _)| c.shares_lens);
    if let Some((camera, &view)) = moved.filter(|_| moves.lens) {
        let factor = camera.intrinsics.fx / scene.views[view].lens.fx;
        share_lens(scene, factor, camera.radial);
    }
    for (&landmark, point) in landmarks.iter().zip(&problem.points) {
        scene.landmarks[landmark as usize].point = *point;
    }
    filter(scene, &landmarks, max_error_px);
}

/// The problem, and the view of each of its cameras.
fn problem(
    scene: &Reconstruction,
    moves: &Moves<'_>,
    landmarks: &[u32],
    loss_px: f64,
) -> (Problem, Vec<usize>) {
    let mut problem = Problem::default();
    let mut camera_of: BTreeMap<u32, u32> = BTreeMap::new();
    let mut views = Vec::new();
    for &landmark in landmarks {
        let landmark = &scene.landmarks[landmark as usize];
        let mut seen = Vec::with_capacity(landmark.seen.len());
        for &at in &landmark.seen {
            let (view_ix, view) = (at.0 as usize, &scene.views[at.0 as usize]);
            let Some(registered) = &view.registered else {
                continue;
            };
            let camera_ix = *camera_of.entry(at.0).or_insert_with(|| {
                let is_soft = moves.soft.contains(&view_ix);
                problem.cameras.push(Camera {
                    cam_from_world: registered.cam_from_world,
                    intrinsics: view.lens,
                    radial: if view.is_calibrated {
                        0.0
                    } else {
                        scene.radial
                    },
                    is_fixed: !is_soft && !moves.free.contains(&view_ix),
                    hold: is_soft.then(|| hold(scene, view_ix, landmarks, loss_px)),
                    shares_lens: !view.is_calibrated,
                });
                views.push(view_ix);
                views.len() as u32 - 1
            });
            seen.push(Observation {
                camera_ix,
                pixel: scene.distorted_pixel(at),
                depth: scene.measured(at),
            });
        }
        problem.add_point(landmark.point, seen);
    }
    let submap = moves.free.first().and_then(|ix| scene.submap_of(*ix));
    if let Some(submap) = submap {
        let camera = |view: usize| camera_of.get(&(view as u32)).copied();
        problem.motions = motions(scene, submap, camera);
        problem
            .motions
            .extend(gyroscope::motions(scene, submap, camera));
    }
    (problem, views)
}

/// What the landmarks that have no part in the adjustment know of a view's pose, as if they were exact.
fn hold(scene: &Reconstruction, view_ix: usize, landmarks: &[u32], loss_px: f64) -> [[f64; 6]; 6] {
    let view = &scene.views[view_ix];
    let numbered = view.landmark_of.iter().enumerate();
    let others = numbered.filter(|(_, l)| **l != NONE && landmarks.binary_search(l).is_err());
    let observations = others.map(|(feature, l)| {
        let at = (view_ix as u32, feature as u32);
        (scene.landmarks[*l as usize].point, scene.pixel(at))
    });
    let registered = view
        .registered
        .map_or(Rigid::IDENTITY, |p| p.cam_from_world);
    pose_information(&registered, &view.lens, observations, loss_px)
}

/// Adjusts, and leaves the lens without a radial coefficient unless the images clearly ask for one.
fn adjust_lens(problem: &mut Problem, settings: &Settings, least_bend_px: f64) {
    let report = adjust(problem, settings);
    let Some(camera) = problem.cameras.iter().find(|c| c.shares_lens) else {
        return;
    };
    let Some(found) = report.radial else { return };
    let bend_px = corner_bend_px(camera);
    tracing::debug!(camera.radial, ?found, bend_px, "lens");
    if found.gain > CLEAR_GAIN && bend_px >= least_bend_px {
        return;
    }
    let shared = problem.cameras.iter_mut().filter(|c| c.shares_lens);
    shared.for_each(|c| c.radial = 0.0);
    let pinhole = Settings {
        refine_radial: false,
        ..*settings
    };
    adjust(problem, &pinhole);
}

/// How far the lens moves what a pinhole shows in a corner.
fn corner_bend_px(camera: &Camera) -> f64 {
    let i = &camera.intrinsics;
    let corner = i.ray_in_cam(DVec2::ZERO).truncate();
    camera.radial.abs() * corner.length_squared() * corner.length() * i.fx.max(i.fy)
}

/// One camera took all uncalibrated views, so all change alike.
pub(crate) fn share_lens(scene: &mut Reconstruction, factor: f64, radial: f64) {
    for view in scene.views.iter_mut().filter(|s| !s.is_calibrated) {
        view.lens = view.lens.refocused(factor);
    }
    scene.radial = radial;
    scene.undistort();
}
