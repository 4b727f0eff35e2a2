//! Lengths that two things report of the same steps -> their ratio, with its standard deviation, however many are wrong.
//!
//! The median of the logarithms, then Huber's mean (Huber 1964).

use splat_types::transform::Rigid;

/// Ratios below which nothing is said.
const MIN_RATIOS: usize = 5;
/// A relative standard deviation above is no knowledge.
const MAX_STD: f64 = 0.1;
/// The path is cut into so many segments: long ones drown the noise of single poses, many report how well they agree.
const N_SEGMENTS: f64 = 24.0;
/// Huber's loss bends at so many standard deviations, for so many rounds.
const HUBER: f64 = 1.5;
const ROUNDS: usize = 5;
/// Standard deviation of a normal distribution over its median absolute deviation.
const NORMAL_MAD: f64 = 1.4826;

/// The logarithm of a ratio, for example of metres per unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LogRatio {
    pub log: f64,
    pub std: f64,
}

/// Of independent ratios; `common` is what all of them may be off by together. `None` where they are few or disagree.
pub fn robust(mut logs: Vec<f64>, common: f64) -> Option<LogRatio> {
    logs.retain(|l| l.is_finite());
    if logs.len() < MIN_RATIOS {
        return None;
    }
    logs.sort_by(f64::total_cmp);
    let mut mean = logs[logs.len() / 2];
    let mut off: Vec<f64> = logs.iter().map(|l| (l - mean).abs()).collect();
    off.sort_by(f64::total_cmp);
    let spread = (NORMAL_MAD * off[off.len() / 2]).max(1e-6);
    let bend = HUBER * spread;
    let mut n_effective = 0.0;
    for _ in 0..ROUNDS {
        let weight = |l: &f64| (bend / (l - mean).abs()).min(1.0);
        n_effective = logs.iter().map(weight).sum::<f64>();
        mean = logs.iter().map(|l| weight(l) * l).sum::<f64>() / n_effective;
    }
    let std = (spread * spread / n_effective + common * common).sqrt();
    (std <= MAX_STD).then_some(LogRatio { log: mean, std })
}

/// Metres per unit of (world_from_cam, odom_from_cam in metres) of keyframes in order. Odometry drifts, so only its steps count.
pub fn of_odometry(track: &[(Rigid, Rigid)], common: f64) -> Option<LogRatio> {
    let step = |a: &Rigid, b: &Rigid| (a.translation - b.translation).length();
    let path: f64 = track.windows(2).map(|two| step(&two[0].0, &two[1].0)).sum();
    let length = path / N_SEGMENTS;
    let (mut logs, mut start) = (Vec::new(), track.first()?);
    for end in track {
        let in_world = step(&start.0, &end.0);
        if in_world >= length && in_world > 0.0 {
            // Where wheels say that nothing moved, the logarithm is no number and goes.
            logs.push((step(&start.1, &end.1) / in_world).ln());
            start = end;
        }
    }
    robust(logs, common)
}

#[cfg(test)]
mod tests;
