//! A window of keyframes and the points that they have in common: poses of frames by the points, points by the keyframes,
//! both adjusted together.

use std::collections::{BTreeMap, VecDeque};

use glam::{DVec2, DVec3};

use crate::visual_odometry::two_view_start::TwoViewStart;
use splat_geometry::optim::bundle::{self, problem};
use splat_geometry::optim::pose_covariance::pose_covariance;
use splat_geometry::pnp;
use splat_geometry::stats::median;
use splat_geometry::two_view::triangulate::{Observation, triangulate, widest_angle};
use splat_types::camera::Intrinsics;
use splat_types::covariance::Covariance;
use splat_types::transform::Rigid;

/// Keyframes of the window.
const N_KEYFRAMES: usize = 8;
/// Of a full window, those that hold its frame and scale.
const N_FIXED: usize = 2;
/// Keyframes that fix the frame before the window is full: the very first one.
const ADJUST_STEPS: usize = 4;
/// Shares of the longer side: residual at which the loss bends, and beyond which a corner does not show its point.
const LOSS: f64 = 1.0 / 640.0;
const MAX_ERROR: f64 = 3.0 / 640.0;
/// Rays to a point must differ by so much.
const MIN_ANGLE_RAD: f64 = 0.015;
/// Points that must agree on a pose, and their share of those that are followed.
const MIN_INLIERS: usize = 15;
const MIN_SHARE: f64 = 0.5;
/// A frame becomes a keyframe when it shows fewer than this share of the points that the last one showed, or when what it
/// shows has moved by this share of the longer side.
const KEYFRAME_SHARE: f64 = 0.8;
const KEYFRAME_FLOW: f64 = 0.05;

#[derive(Debug, Clone)]
struct Keyframe {
    cam_from_odom: Rigid,
    /// By the corner's number, where a pinhole shows it.
    pixels: BTreeMap<u32, DVec2>,
}

/// The window, in the frame and unit of its segment.
#[derive(Debug)]
pub(crate) struct LocalMap {
    camera: Intrinsics,
    keyframes: VecDeque<Keyframe>,
    points: BTreeMap<u32, DVec3>,
    /// Points that the newest keyframe showed.
    n_shown: usize,
}

/// Where a frame is.
#[derive(Debug, Clone)]
pub(crate) struct FramePose {
    pub(crate) cam_from_odom: Rigid,
    /// Of the camera in its own axes, the points taken as exact.
    pub(crate) covariance: Covariance,
    /// Numbers of corners that do not show their points.
    pub(crate) outliers: Vec<u32>,
    pub(crate) n_inliers: usize,
}

impl LocalMap {
    /// `pixels` of both images by the corner's number.
    pub(crate) fn new(
        camera: Intrinsics,
        start: TwoViewStart,
        pixels: [BTreeMap<u32, DVec2>; 2],
    ) -> Self {
        let [first, second] = pixels;
        let poses = [Rigid::IDENTITY, start.second_from_first];
        let keyframes = poses.into_iter().zip([first, second]);
        let keyframes = keyframes.map(|(cam_from_odom, pixels)| Keyframe {
            cam_from_odom,
            pixels,
        });
        let mut map = Self {
            camera,
            keyframes: keyframes.collect(),
            n_shown: start.points.len(),
            points: start.points,
        };
        map.adjust();
        map
    }

    pub(crate) fn newest_pose(&self) -> Rigid {
        let newest = self.keyframes.back();
        newest.map_or(Rigid::IDENTITY, |keyframe| keyframe.cam_from_odom)
    }

    /// Where a camera would show the point of a corner, in pixels of the pinhole.
    pub(crate) fn expected(&self, id: u32, cam_from_odom: &Rigid) -> Option<DVec2> {
        let point = self.points.get(&id)?;
        self.camera.project(cam_from_odom.transform_point(*point))
    }

    /// The same for a corner without a point, which the camera before showed at `pixel`: as if it lay at a depth.
    pub(crate) fn expected_at(
        &self,
        pixel: DVec2,
        depth: f64,
        [before, now]: [&Rigid; 2],
    ) -> Option<DVec2> {
        let point = self.camera.ray_in_cam(pixel) * depth;
        let point = before.inverse().transform_point(point);
        self.camera.project(now.transform_point(point))
    }

    /// The pose of a frame from its corners, (number, pixel), and where it may be; `None` where too few agree.
    pub(crate) fn locate(
        &self,
        seen: &[(u32, DVec2)],
        guess: &Rigid,
        seed: u64,
    ) -> Option<FramePose> {
        let shown = |(id, pixel): &(u32, DVec2)| Some((*id, *self.points.get(id)?, *pixel));
        let shown: Vec<(u32, DVec3, DVec2)> = seen.iter().filter_map(shown).collect();
        if shown.len() < MIN_INLIERS {
            return None;
        }
        let max_error_px = MAX_ERROR * self.longest();
        let needed = MIN_INLIERS.max((MIN_SHARE * shown.len() as f64) as usize);
        let near = self.refined(&shown, guess, max_error_px);
        let located = near.filter(|(_, inliers)| inliers.len() >= needed);
        let (pose, inliers) = located.or_else(|| {
            let (points, pixels): (Vec<_>, Vec<_>) = shown.iter().map(|s| (s.1, s.2)).unzip();
            let limits = (max_error_px, needed);
            let placement = pnp::place(&points, &pixels, &self.camera, limits, seed)?;
            let refined = self.refined(&shown, &placement.cam_from_world, max_error_px);
            refined.filter(|(_, inliers)| inliers.len() >= needed)
        })?;
        let pairs: Vec<(DVec3, DVec2)> =
            inliers.iter().map(|i| (shown[*i].1, shown[*i].2)).collect();
        let covariance = pose_covariance(&pose, &self.camera, &pairs)?;
        let is_inlier = |ix: &usize| inliers.binary_search(ix).is_ok();
        let outliers = (0..shown.len()).filter(|ix| !is_inlier(ix));
        Some(FramePose {
            cam_from_odom: pose,
            covariance,
            outliers: outliers.map(|ix| shown[ix].0).collect(),
            n_inliers: inliers.len(),
        })
    }

    /// A pose and the observations that agree, in order: first among all, then among those that agreed.
    fn refined(
        &self,
        shown: &[(u32, DVec3, DVec2)],
        guess: &Rigid,
        max_error_px: f64,
    ) -> Option<(Rigid, Vec<usize>)> {
        let loss_px = LOSS * self.longest();
        let all: Vec<(DVec3, DVec2)> = shown.iter().map(|s| (s.1, s.2)).collect();
        let agreeing = |pose: &Rigid| -> Vec<usize> {
            let error = |(point, pixel): &(DVec3, DVec2)| {
                let image = self.camera.project(pose.transform_point(*point));
                image.map_or(f64::INFINITY, |image| image.distance(*pixel))
            };
            (0..all.len())
                .filter(|ix| error(&all[*ix]) <= max_error_px)
                .collect()
        };
        let pose = pnp::refine(&all, &self.camera, guess, loss_px);
        let inliers = agreeing(&pose);
        if inliers.len() < MIN_INLIERS {
            return None;
        }
        let picked: Vec<(DVec3, DVec2)> = inliers.iter().map(|ix| all[*ix]).collect();
        let pose = pnp::refine(&picked, &self.camera, &pose, loss_px);
        Some((pose, agreeing(&pose)))
    }

    /// Whether a frame that was located shows enough that is new.
    pub(crate) fn is_due(&self, seen: &[(u32, DVec2)], n_inliers: usize) -> bool {
        let Some(newest) = self.keyframes.back() else {
            return true;
        };
        let moved = |(id, pixel): &(u32, DVec2)| Some(newest.pixels.get(id)?.distance(*pixel));
        let mut flow: Vec<f64> = seen.iter().filter_map(moved).collect();
        let flow = median(&mut flow).unwrap_or(f64::INFINITY);
        (n_inliers as f64) < KEYFRAME_SHARE * self.n_shown as f64
            || flow > KEYFRAME_FLOW * self.longest()
    }

    /// Takes a located frame into the window: points that it makes certain are added, and the window is adjusted.
    pub(crate) fn add_keyframe(&mut self, cam_from_odom: Rigid, seen: &[(u32, DVec2)]) {
        self.keyframes.push_back(Keyframe {
            cam_from_odom,
            pixels: seen.iter().copied().collect(),
        });
        if self.keyframes.len() > N_KEYFRAMES {
            self.keyframes.pop_front();
        }
        self.triangulate(seen);
        self.adjust();
        self.drop_unseen();
        self.n_shown = seen
            .iter()
            .filter(|(id, _)| self.points.contains_key(id))
            .count();
    }

    /// Corners whose number has no point yet and that keyframes have seen from apart.
    fn triangulate(&mut self, seen: &[(u32, DVec2)]) {
        let max_error_px = LOSS * self.longest() * 2.0;
        for (id, _) in seen {
            if self.points.contains_key(id) {
                continue;
            }
            let views = self.keyframes.iter().filter_map(|keyframe| {
                Some(Observation {
                    cam_from_world: &keyframe.cam_from_odom,
                    intrinsics: &self.camera,
                    pixel: *keyframe.pixels.get(id)?,
                })
            });
            let views: Vec<Observation<'_>> = views.collect();
            let centres: Vec<DVec3> = views.iter().map(Observation::centre_in_world).collect();
            let point = triangulate(&views).filter(|point| {
                let fits = |view: &Observation<'_>| view.error_px(*point) <= max_error_px;
                widest_angle(&centres, *point) >= MIN_ANGLE_RAD && views.iter().all(fits)
            });
            if let Some(point) = point {
                self.points.insert(*id, point);
            }
        }
    }

    /// Bundle adjustment over the window; points that fit badly go.
    fn adjust(&mut self) {
        let is_full = self.keyframes.len() == N_KEYFRAMES;
        let n_fixed = if is_full { N_FIXED } else { 1 };
        let cameras = self.keyframes.iter().enumerate();
        let cameras = cameras.map(|(ix, keyframe)| problem::Camera {
            cam_from_world: keyframe.cam_from_odom,
            intrinsics: self.camera,
            radial: 0.0,
            is_fixed: ix < n_fixed,
            hold: None,
            shares_lens: false,
        });
        let mut adjusted = problem::Problem::default();
        adjusted.cameras = cameras.collect();
        let mut ids = Vec::new();
        for (id, point) in &self.points {
            let views = self.keyframes.iter().enumerate();
            let views: Vec<problem::Observation> = views
                .filter_map(|(ix, keyframe)| {
                    Some(problem::Observation {
                        camera_ix: ix as u32,
                        pixel: *keyframe.pixels.get(id)?,
                        depth: None,
                    })
                })
                .collect();
            if views.len() >= 2 {
                adjusted.add_point(*point, views);
                ids.push(*id);
            }
        }
        let settings = problem::Settings {
            max_steps: ADJUST_STEPS,
            loss_px: LOSS * self.longest(),
            refine_focal: false,
            refine_radial: false,
        };
        // Two images leave their distance open: it stays as it is.
        let baseline = self.baseline();
        bundle::adjust(&mut adjusted, &settings);
        for (keyframe, camera) in self.keyframes.iter_mut().zip(&adjusted.cameras) {
            keyframe.cam_from_odom = camera.cam_from_world;
        }
        for (id, point) in ids.iter().zip(adjusted.points) {
            self.points.insert(*id, point);
        }
        if !is_full && let Some((before, after)) = baseline.zip(self.baseline()) {
            self.rescale(before / after);
        }
        let max_error_px = LOSS * self.longest() * 2.0;
        let keyframes = &self.keyframes;
        let camera = &self.camera;
        self.points.retain(|id, point| {
            let error = |keyframe: &Keyframe| {
                let pixel = keyframe.pixels.get(id)?;
                let image = camera.project(keyframe.cam_from_odom.transform_point(*point));
                Some(image.map_or(f64::INFINITY, |image| image.distance(*pixel)))
            };
            let errors: Vec<f64> = keyframes.iter().filter_map(error).collect();
            errors.iter().sum::<f64>() <= max_error_px * errors.len() as f64
        });
    }

    /// Distance between the first two cameras.
    fn baseline(&self) -> Option<f64> {
        let centre = |ix: usize| {
            let keyframe = self.keyframes.get(ix)?;
            Some(keyframe.cam_from_odom.inverse().translation)
        };
        Some(centre(0)?.distance(centre(1)?)).filter(|length| *length > 1e-9)
    }

    /// About the first camera, which is the origin while the window is not full.
    fn rescale(&mut self, factor: f64) {
        if !factor.is_finite() {
            return;
        }
        for keyframe in &mut self.keyframes {
            keyframe.cam_from_odom.translation *= factor;
        }
        self.points.values_mut().for_each(|point| *point *= factor);
    }

    /// Points that no keyframe of the window shows any more.
    fn drop_unseen(&mut self) {
        let keyframes = &self.keyframes;
        let is_seen = |id: &u32| keyframes.iter().any(|k| k.pixels.contains_key(id));
        self.points.retain(|id, _| is_seen(id));
    }

    /// Median distance of the points in front of the newest keyframe.
    pub(crate) fn median_depth(&self) -> f64 {
        let pose = self.newest_pose();
        let depths = self.points.values().map(|p| pose.transform_point(*p).z);
        let mut depths: Vec<f64> = depths.filter(|z| *z > 0.0).collect();
        median(&mut depths).unwrap_or(1.0)
    }

    fn longest(&self) -> f64 {
        f64::from(self.camera.width_px.max(self.camera.height_px))
    }
}
