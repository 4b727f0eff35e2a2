//! A model file -> what it is, how fast it answers, and what that takes.

use serde::Serialize;

use crate::machine::memory::{forget_peak, peak_rss_mib};
use crate::machine::probe::free_bytes;
use splat_geometry::error::ModelError;
use splat_geometry::foundation::decode::Answer;
use splat_geometry::foundation::model::Model;
use splat_geometry::foundation::params::OnnxParams;
use splat_geometry::foundation::{sidecar, window};
use splat_geometry::inference::Provider;
use splat_types::time::Stopwatch;

/// Frames on which providers are compared.
const PARITY_FRAMES: usize = 2;
const MIB: f64 = (1 << 20) as f64;

/// What `splat-mapper model check` found. Many fields: the keys of what it prints as JSON.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    pub model: String,
    pub contract: u64,
    pub family: String,
    pub height: u32,
    pub width: u32,
    pub patch: u32,
    pub precision: String,
    pub licence: String,
    pub s_min: usize,
    pub s_max: usize,
    pub weights_mib: f64,
    pub provider: &'static str,
    /// Frames that the node would ask for at once.
    pub window: usize,
    pub timings: Vec<Timing>,
    /// Against the CPU; empty where no other provider takes the model.
    pub parity: Vec<Parity>,
    /// Why an answer cannot be used; empty for a model that can.
    pub faults: Vec<String>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Timing {
    pub frames: usize,
    pub secs: f64,
    /// Of the whole process; null where the system does not say.
    pub peak_rss_mib: Option<f64>,
    /// What the node reckons with, beside the weights.
    pub estimated_mib: f64,
}

/// Largest differences, relative to the largest value.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Parity {
    pub provider: &'static str,
    pub frames: usize,
    pub pose_enc: f64,
    pub depth: f64,
    pub depth_conf: f64,
}

impl Report {
    /// Runs the model on windows of 1, 2, 4 ... frames, as far as it allows and memory reaches.
    pub fn of(mut model: Model, params: &OnnxParams) -> Result<Self, ModelError> {
        let sidecar = model.sidecar.clone();
        let free = free_bytes(model.provider());
        let largest = window::size(&sidecar, params.window, free);
        let mut report = Self {
            model: model.path().display().to_string(),
            contract: sidecar::CONTRACT,
            family: format!("{:?}", sidecar.family).to_lowercase(),
            height: sidecar.height,
            width: sidecar.width,
            patch: sidecar.patch,
            precision: format!("{:?}", sidecar.precision).to_lowercase(),
            licence: sidecar.licence.clone(),
            s_min: sidecar.s_min,
            s_max: sidecar.s_max,
            weights_mib: window::weight_bytes(model.path()) as f64 / MIB,
            provider: model.provider().name(),
            window: largest,
            timings: Vec::new(),
            parity: Vec::new(),
            faults: Vec::new(),
        };
        for n in sizes(sidecar.s_min, largest) {
            let images = images(n, sidecar.width, sidecar.height);
            let is_own = forget_peak();
            let watch = Stopwatch::start();
            let answer = model.answer(images)?;
            report.timings.push(Timing {
                frames: n,
                secs: watch.secs(),
                peak_rss_mib: peak_rss_mib().filter(|_| is_own),
                estimated_mib: window::bytes_of(&sidecar, n) / MIB,
            });
            report.note_faults(&answer, &model);
        }
        report.compare(&mut model, params)?;
        Ok(report)
    }

    fn note_faults(&mut self, answer: &Answer, model: &Model) {
        let cameras = answer.cameras(model.sidecar.pose);
        for (frame, camera) in cameras.into_iter().enumerate() {
            if let Some(fault) = camera.err().or_else(|| answer.fault_of(frame)) {
                let text = format!("frame {frame} of {} has {fault}", answer.n_frames);
                self.faults.push(text);
            }
        }
    }

    /// The same images by the CPU and by every other provider that takes the model.
    fn compare(&mut self, model: &mut Model, params: &OnnxParams) -> Result<(), ModelError> {
        let sidecar = model.sidecar.clone();
        let n = PARITY_FRAMES.clamp(sidecar.s_min, sidecar.s_max);
        let images = images(n, sidecar.width, sidecar.height);
        let mut reference = None;
        for provider in [Provider::Cuda, Provider::TensorRt] {
            let only = OnnxParams {
                providers: provider.name().to_owned(),
                ..params.clone()
            };
            let Ok(mut other) = Model::open(model.path(), &only) else {
                continue;
            };
            let answer = other.answer(images.clone())?;
            if reference.is_none() {
                let cpu = OnnxParams {
                    providers: Provider::Cpu.name().to_owned(),
                    ..params.clone()
                };
                reference = Some(Model::open(model.path(), &cpu)?.answer(images.clone())?);
            }
            let Some(reference) = &reference else {
                continue;
            };
            self.parity.push(Parity {
                provider: provider.name(),
                frames: n,
                pose_enc: difference(&answer.pose_enc, &reference.pose_enc),
                depth: difference(&answer.depth, &reference.depth),
                depth_conf: difference(&answer.depth_conf, &reference.depth_conf),
            });
        }
        Ok(())
    }
}

impl std::fmt::Display for Report {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "{}", self.model)?;
        writeln!(
            f,
            "contract {}, {} {}, images {}x{} in patches of {}, {} to {} frames, {:.1} MiB, licence {:?}",
            self.contract,
            self.family,
            self.precision,
            self.width,
            self.height,
            self.patch,
            self.s_min,
            self.s_max,
            self.weights_mib,
            self.licence
        )?;
        writeln!(
            f,
            "runs on {}, {} frames at once",
            self.provider, self.window
        )?;
        writeln!(
            f,
            "frames   seconds   peak MiB   estimated MiB beside the weights"
        )?;
        for timing in &self.timings {
            let peak = timing.peak_rss_mib;
            let peak = peak.map_or("unknown".to_owned(), |mib| format!("{mib:.0}"));
            let (n, secs, estimated) = (timing.frames, timing.secs, timing.estimated_mib);
            writeln!(f, "{n:6}  {secs:8.3}  {peak:>9}  {estimated:9.0}")?;
        }
        for parity in &self.parity {
            let Parity {
                provider,
                pose_enc,
                depth,
                depth_conf,
                ..
            } = parity;
            writeln!(
                f,
                "{provider} differs from cpu by {pose_enc:.1e} in poses, {depth:.1e} in depth, {depth_conf:.1e} in confidence"
            )?;
        }
        if self.parity.is_empty() {
            writeln!(
                f,
                "no second provider to compare with: this machine has the CPU's alone"
            )?;
        }
        for fault in &self.faults {
            writeln!(f, "fault: {fault}")?;
        }
        let verdict = if self.faults.is_empty() {
            "the model can be used: --geometry onnx:FILE"
        } else {
            "the model cannot be used"
        };
        f.write_str(verdict)
    }
}

/// 1, 2, 4 ... and the last one.
fn sizes(least: usize, most: usize) -> Vec<usize> {
    let doubled = std::iter::successors(Some(least), |n| Some(2 * n));
    let mut sizes: Vec<usize> = doubled.take_while(|n| *n < most).collect();
    sizes.push(most);
    sizes
}

/// Waves of several lengths that move from frame to frame: something to see, the same every time.
fn images(n: usize, width: u32, height: u32) -> Vec<f32> {
    let mut values = Vec::with_capacity(n * 3 * width as usize * height as usize);
    for frame in 0..n {
        for channel in 0..3 {
            for y in 0..height {
                for x in 0..width {
                    let (u, v) = (x as f32 + 3.0 * frame as f32, y as f32);
                    let phase = channel as f32;
                    let wave = (0.31 * u + phase).sin() * (0.23 * v).cos() + (0.05 * (u + v)).sin();
                    values.push(0.5 + 0.24 * wave);
                }
            }
        }
    }
    values
}

fn difference(a: &[f32], b: &[f32]) -> f64 {
    let largest = b
        .iter()
        .map(|v| f64::from(v.abs()))
        .fold(f64::MIN_POSITIVE, f64::max);
    let pairs = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs()));
    pairs.fold(0.0, f64::max) / largest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn window_sizes_double_up_to_the_last() {
        assert_eq!(sizes(1, 8), [1, 2, 4, 8]);
        assert_eq!(sizes(1, 12), [1, 2, 4, 8, 12]);
        assert_eq!(sizes(4, 4), [4]);
    }
}
