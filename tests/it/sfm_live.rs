//! Structure from motion as the live node asks for it: poses first, what improves them and depth later.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use splat_geometry::answer::GeometryBatch;
use splat_geometry::model::{DepthTask, GeometryModel, Work};
use splat_geometry::mvs::depth_stream::SweepJob;
use splat_geometry::sfm::estimator::Sfm;
use splat_geometry::similarity;
use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;
use splat_types::depth::DepthMap;
use splat_types::frame::{Batch, Keyframe};
use splat_types::time::Stopwatch;
use splat_types::transform::{Rigid, extent};

const SCENE: &str = "synthetic:room?frames=48&width=320&height=240";
const EVERY: usize = 2;

fn keyframes() -> Vec<Arc<Keyframe>> {
    keyframes_of(SCENE, EVERY)
}

/// Every `every`-th frame of a scene, numbered from 0.
pub(crate) fn keyframes_of(scene: &str, every: usize) -> Vec<Arc<Keyframe>> {
    let params = Settings::shipped().params().unwrap();
    let mut source = open_source::open(scene, &params.source, 0).unwrap();
    let frames = std::iter::from_fn(|| source.next()).step_by(every);
    let keyframe = |(id, frame)| {
        Arc::new(Keyframe {
            id: id as u32,
            frame,
            age: Stopwatch::start(),
        })
    };
    frames.enumerate().map(keyframe).collect()
}

/// What the map would know of each keyframe.
#[derive(Default)]
struct Known {
    poses: BTreeMap<u32, Rigid>,
    depths: BTreeMap<u32, DepthMap>,
}

impl Known {
    fn take(&mut self, geometry: &GeometryBatch) {
        for view in &geometry.views {
            self.poses.insert(view.keyframe_id, view.submap_from_cam);
            if view.depth.width_px > 0 {
                self.depths.insert(view.keyframe_id, view.depth.clone());
            }
        }
        for revised in &geometry.revised {
            self.poses
                .insert(revised.keyframe_id, revised.submap_from_cam);
            if let Some(depth) = self.depths.get_mut(&revised.keyframe_id) {
                let factor = revised.depth_factor as f32;
                depth.depth.iter_mut().for_each(|z| *z *= factor);
            }
        }
    }

    /// RMSE of the places after the best similarity, as a share of the path's extent; and the median relative error of depth
    /// that was verified.
    fn errors(&self, keyframes: &[Arc<Keyframe>]) -> (f64, f64) {
        let truth = |id: &u32| keyframes[*id as usize].frame.truth.unwrap();
        let pairs = self.poses.iter();
        let pairs: Vec<_> = pairs
            .map(|(id, pose)| (truth(id).translation, pose.translation))
            .collect();
        let fit = similarity::of_points(&pairs).unwrap();
        let off = |(t, o): &(_, _)| fit.transform_point(*o).distance_squared(*t);
        let rmse = (pairs.iter().map(off).sum::<f64>() / pairs.len() as f64).sqrt();
        let way: Vec<_> = pairs.iter().map(|(t, _)| *t).collect();
        let mut relative = Vec::new();
        for (id, found) in &self.depths {
            let exact = keyframes[*id as usize].frame.sensor_depth.as_ref().unwrap();
            let (from, to) = (found.width_px as usize, exact.width_px as usize);
            for ix in (0..found.depth.len()).filter(|ix| found.confidence[*ix] > 0.0) {
                let (x, y) = (ix % from, ix / from);
                let rows = (exact.height_px as usize, found.height_px as usize);
                let at = y * rows.0 / rows.1 * to + x * to / from;
                let scaled = f64::from(found.depth[ix]) * fit.scale;
                relative.push((scaled / f64::from(exact.depth[at]) - 1.0).abs());
            }
        }
        relative.sort_by(f64::total_cmp);
        (rmse / extent(&way), relative[relative.len() / 2])
    }
}

fn batch(id: usize, keyframes: &[Arc<Keyframe>]) -> Batch {
    Batch {
        id: id as u32,
        n_shared: 0,
        keyframes: keyframes.to_vec(),
    }
}

/// The depth that is left, and the last word.
fn finish(model: &mut Sfm, known: &mut Known) {
    while let Some(task) = model.depth() {
        let depth = match task {
            DepthTask::Sweep(job) => model.take_depth(job.run()).unwrap(),
            DepthTask::Known(depth) => depth,
        };
        known.take(&depth);
    }
    known.take(&model.finish().unwrap());
}

/// Errors of poses and depth where each batch has all the time that it takes.
fn replayed(keyframes: &[Arc<Keyframe>]) -> (f64, f64) {
    let params = Settings::shipped().params().unwrap();
    let mut model = Sfm::new(&params.sfm, &params.mvs, 1).unwrap();
    let mut whole = Known::default();
    for (id, new) in keyframes.chunks(5).enumerate() {
        whole.take(&model.infer(&batch(id, new)).unwrap());
    }
    whole.take(&model.finish().unwrap());
    whole.errors(keyframes)
}

#[test]
fn poses_come_first_and_what_comes_later_makes_the_same_map() {
    let keyframes = keyframes();
    let params = Settings::shipped().params().unwrap();
    let mut model = Sfm::new(&params.sfm, &params.mvs, 1).unwrap();
    let mut known = Known::default();
    // A sweep is at work while the next keyframe is registered.
    let mut at_work: Option<Box<SweepJob>> = None;
    // So is the adjustment of all, from one moment to the next.
    let mut adjusting: Option<Work> = None;
    let mut n_adjusted = 0;
    let n_asked = AtomicUsize::new(0);
    let (start, rest) = keyframes.split_at(5);
    let singles = rest.iter().map(std::slice::from_ref);
    for (id, new) in std::iter::once(start).chain(singles).enumerate() {
        let reported = model.poses(&batch(id, new)).unwrap();
        assert!(reported.views.iter().all(|view| view.depth.width_px == 0));
        let views: BTreeSet<u32> = reported.views.iter().map(|v| v.keyframe_id).collect();
        assert!(new.iter().all(|k| views.contains(&k.id)), "batch {id}");
        known.take(&reported);
        if let Some(job) = at_work.take() {
            let give_way = || {
                n_asked.fetch_add(1, Ordering::Relaxed);
            };
            known.take(&model.take_depth(job.run_giving_way(&give_way)).unwrap());
        }
        // Every third time there is a moment for what was left.
        if id % 3 == 2 {
            let slices: Vec<_> = std::iter::from_fn(|| model.refine()).take(20).collect();
            assert!((2..20).contains(&slices.len()), "a slice for each view");
            slices.iter().for_each(|slice| known.take(slice));
            if let Some(work) = adjusting.take() {
                work();
                let adjusted = model.take_adjustment();
                n_adjusted += usize::from(adjusted.is_some());
                adjusted.iter().for_each(|adjusted| known.take(adjusted));
            }
            adjusting = model.adjustment();
        }
        match model.depth() {
            Some(DepthTask::Sweep(job)) => {
                assert!(model.depth().is_none(), "one sweep at a time");
                at_work = Some(job);
            }
            Some(DepthTask::Known(depth)) => known.take(&depth),
            None => {}
        }
    }
    if let Some(job) = at_work.take() {
        known.take(&model.take_depth(job.run()).unwrap());
    }
    let n_asked = n_asked.into_inner();
    assert!(
        n_asked > params.mvs.depth_planes,
        "sweeps give way: {n_asked}"
    );
    assert!(n_adjusted >= 1 && model.take_adjustment().is_none());
    finish(&mut model, &mut known);
    assert_eq!(known.poses.len(), keyframes.len());
    assert!(
        known.depths.len() >= keyframes.len() - 1,
        "{}",
        known.depths.len()
    );
    let (live, live_depth) = known.errors(&keyframes);

    let (replayed, depth) = replayed(&keyframes);
    eprintln!("ATE live {live:.5}, replay {replayed:.5}; depth {live_depth:.5}, {depth:.5}");
    assert!(live < 1.3 * replayed + 0.001, "{live} and {replayed}");
    assert!(live_depth < 1.3 * depth + 0.001, "{live_depth} and {depth}");
}

#[test]
fn where_no_time_is_left_between_batches_all_keyframes_are_registered_as_well() {
    let keyframes = keyframes();
    let params = Settings::shipped().params().unwrap();
    let mut model = Sfm::new(&params.sfm, &params.mvs, 1).unwrap();
    let mut known = Known::default();
    for (id, new) in keyframes.chunks(5).enumerate() {
        let answer = model.poses(&batch(id, new)).unwrap();
        known.take(&answer);
        // Each of them got less effort, and the answer says so; 24 at most can still be compared with places of long ago.
        let n_hurried = answer.load_shed.hurried_keyframes as usize;
        assert_eq!(n_hurried, (5 * (id + 1)).min(keyframes.len()));
        let n_behind = n_hurried.saturating_sub(24);
        assert!(answer.load_shed.unsought_keyframes as usize <= n_behind);
        let n_expected = (5 * (id + 1)).min(keyframes.len());
        assert_eq!(known.poses.len(), n_expected, "batch {id}");
    }
    finish(&mut model, &mut known);
    let ((live, _), (replayed, _)) = (known.errors(&keyframes), replayed(&keyframes));
    eprintln!("ATE in haste {live:.5}, replay {replayed:.5}");
    assert!(live < 1.3 * replayed + 0.001, "{live} and {replayed}");
}
