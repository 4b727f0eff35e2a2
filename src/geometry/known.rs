//! Geometry from the recording's own truth, with stated noise: runs the whole node without estimating anything.

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::config::KnownParams;
use crate::frame::{Batch, DepthMap, Keyframe};
use crate::geometry::{GeometryBatch, GeometryError, GeometryModel, Health, View};
use crate::pose::Rigid;

/// Answers with `Frame::truth` and `Frame::truth_depth`. The batch frame is the recording's map frame, in its unit.
#[derive(Debug)]
pub struct Known {
    params: KnownParams,
    seed: u64,
}

impl Known {
    pub fn new(params: KnownParams, seed: u64) -> Self {
        Self { params, seed }
    }

    fn view(&self, keyframe: &Keyframe) -> Result<View, GeometryError> {
        let missing = |needs| GeometryError::Missing {
            model: "known",
            needs,
            keyframe_id: keyframe.id,
            way_out: "use --geometry sfm",
        };
        let frame = &keyframe.frame;
        let truth = frame
            .truth
            .ok_or_else(|| missing("a ground truth pose (PoseStamped or tf)"))?;
        let intrinsics = frame.intrinsics.ok_or_else(|| missing("a CameraInfo"))?;
        let depth = frame
            .truth_depth
            .as_ref()
            .ok_or_else(|| missing("a depth picture of equal stamp"))?;
        // One stream of numbers per keyframe: a shared keyframe gets the same noise in every batch.
        let mut rng = Pcg64Mcg::seed_from_u64(self.seed ^ (u64::from(keyframe.id) << 20));
        let median = depth.median().map_or(1.0, f64::from);
        let angle = self.params.rotation_noise_deg.to_radians();
        let mut normal3 =
            |std: f64| DVec3::new(normal(&mut rng), normal(&mut rng), normal(&mut rng)) * std;
        let (theta, rho) = (
            normal3(angle),
            normal3(self.params.translation_noise * median),
        );
        let batch_from_cam = truth * Rigid::exp(rho, theta);
        Ok(View {
            keyframe_id: keyframe.id,
            component: 0,
            intrinsics,
            batch_from_cam,
            depth: noisy_depth(depth, self.params.depth_noise as f32, &mut rng),
            health: Health::default(),
        })
    }
}

impl GeometryModel for Known {
    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let views = batch
            .keyframes
            .iter()
            .map(|keyframe| self.view(keyframe))
            .collect::<Result<_, _>>()?;
        Ok(GeometryBatch {
            batch_id: batch.id,
            views,
            revised: Vec::new(),
            note: None,
        })
    }

    fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        Ok(GeometryBatch::default())
    }
}

fn noisy_depth(depth: &DepthMap, std: f32, rng: &mut Pcg64Mcg) -> DepthMap {
    let mut noisy = depth.clone();
    if std > 0.0 {
        for value in &mut noisy.depth {
            // A depth of zero means no value and stays so; noise never makes one negative.
            *value *= (1.0 + std * normal(rng) as f32).max(0.05);
        }
    }
    noisy
}

/// Standard normal (Box and Muller 1958).
fn normal(rng: &mut Pcg64Mcg) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    let v: f64 = rng.random::<f64>();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}
