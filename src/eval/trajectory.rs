//! Trajectories as TUM text (`t tx ty tz qx qy qz qw`), and which poses of two of them belong together.
//!
//! Knows nothing of what a pose is a pose of; alignment and figures are in `align` and `evaluation`.

use std::collections::BTreeSet;
use std::path::Path;

use glam::{DQuat, DVec3};

use crate::eval::error::{EvalError, read_text, write_atomically};
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Stamps further apart are different moments. The convention of the TUM tools is 0.02 s at 30 Hz; the stamps here
/// are copies of the same header stamps, so half of that only has to cover rounding and jitter.
pub const TOLERANCE_SECS: f64 = 0.01;

/// Hours of motion capture at 1 kHz fit; an image or a bag named by mistake does not.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// Beyond this a coordinate is a mistake, and its square leaves the range of numbers.
const MAX_COORDINATE: f64 = 1e12;

/// How far a quaternion's length may be from 1; files with four decimals are within 2e-4.
const QUATERNION_SLACK: f64 = 0.05;

const HEADER: &str = "# t tx ty tz qx qy qz qw  (seconds; camera to world, OpenCV axes: x right, y down, z forward)\n";

/// Where something was, and when. The file says which frames the pose relates; here mostly `world_from_cam`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedPose {
    pub stamp: Stamp,
    pub pose: Rigid,
}

/// Reads a file; see `parse_tum`.
pub fn read_tum(path: &Path) -> Result<Vec<TimedPose>, EvalError> {
    let text = read_text("the trajectory", MAX_FILE_BYTES, path)?;
    parse_tum(&text, path)
}

/// Poses in order of time. Empty lines and lines from `#` on are comments, the order of lines is free, and a line
/// that stands there twice counts once. Anything else that is not eight finite numbers is an error with its line.
pub fn parse_tum(text: &str, path: &Path) -> Result<Vec<TimedPose>, EvalError> {
    let mut poses = Vec::new();
    for (ix, line) in text.lines().enumerate() {
        let content = line.split('#').next().unwrap_or_default().trim();
        if content.is_empty() {
            continue;
        }
        let pose = parse_line(content).map_err(|problem| EvalError::Line {
            line: ix + 1,
            problem,
            found: shortened(content),
            path: path.to_owned(),
        })?;
        poses.push((ix + 1, pose));
    }
    poses.sort_by_key(|(_, timed)| timed.stamp);
    for pair in poses.windows(2) {
        let ((first, a), (second, b)) = (pair[0], pair[1]);
        if a.stamp == b.stamp && a.pose != b.pose {
            return Err(EvalError::Repeated {
                line: first.max(second),
                stamp: a.stamp.to_string(),
                path: path.to_owned(),
            });
        }
    }
    poses.dedup_by_key(|(_, timed)| timed.stamp);
    Ok(poses.into_iter().map(|(_, timed)| timed).collect())
}

/// The text that `parse_tum` reads, with nine decimals.
pub fn format_tum(poses: &[TimedPose]) -> String {
    use std::fmt::Write;

    let mut text = HEADER.to_owned();
    for TimedPose { stamp, pose } in poses {
        let (t, q) = (pose.translation, pose.rotation);
        writeln!(
            text,
            "{stamp} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}",
            t.x, t.y, t.z, q.x, q.y, q.z, q.w
        )
        .expect("a String takes any text");
    }
    text
}

pub fn write_tum(poses: &[TimedPose], path: &Path) -> Result<(), EvalError> {
    write_atomically("the trajectory", format_tum(poses).as_bytes(), path)
}

/// Pairs (estimate, reference) of indices, nearest in time, at most `tolerance_secs` apart, each pose at most once.
/// Both lists are in order of time. When two estimates want one reference, the nearer one has it.
pub fn associate(
    estimate: &[TimedPose],
    reference: &[TimedPose],
    tolerance_secs: f64,
) -> Vec<(usize, usize)> {
    let mut pairs: Vec<(usize, usize, f64)> = Vec::new();
    for (ix, timed) in estimate.iter().enumerate() {
        let after = reference.partition_point(|r| r.stamp < timed.stamp);
        let gap = |r: usize| reference[r].stamp.secs_since(timed.stamp).abs();
        let candidates = after.saturating_sub(1)..(after + 1).min(reference.len());
        let Some(nearest) = candidates.min_by(|&a, &b| gap(a).total_cmp(&gap(b))) else {
            continue;
        };
        // Stamps are whole nanoseconds; a gap of exactly the tolerance must not fail by a rounded last bit.
        if gap(nearest) > tolerance_secs + 0.5e-9 {
            continue;
        }
        match pairs.last_mut() {
            Some(last) if last.1 == nearest => {
                if gap(nearest) < last.2 {
                    *last = (ix, nearest, gap(nearest));
                }
            }
            _ => pairs.push((ix, nearest, gap(nearest))),
        }
    }
    pairs
        .into_iter()
        .map(|(estimate_ix, reference_ix, _)| (estimate_ix, reference_ix))
        .collect()
}

/// Nanoseconds to add to the stamps of `estimate`, a whole number of seconds, so that most of them meet one of
/// `reference`: recordings often start at an epoch of their own. 0 when some meet as they are, or nothing helps.
pub fn stamp_offset_nanos(
    estimate: &[TimedPose],
    reference: &[TimedPose],
    tolerance_secs: f64,
) -> i64 {
    const NANOS: i64 = 1_000_000_000;
    const N_VOTERS: usize = 8;
    let n_met = |offset| associate(&shifted(estimate, offset), reference, tolerance_secs).len();
    if n_met(0) > 0 {
        return 0;
    }
    let voters = estimate
        .iter()
        .step_by(estimate.len().div_ceil(N_VOTERS).max(1));
    let gaps = voters.flat_map(|e| {
        reference
            .iter()
            .map(|r| r.stamp.nanos.saturating_sub(e.stamp.nanos))
    });
    let whole_secs = gaps.filter_map(|gap| {
        let whole = gap.saturating_add(NANOS / 2).div_euclid(NANOS) * NANOS;
        ((gap - whole).abs() as f64 <= tolerance_secs * 1e9).then_some(whole)
    });
    let candidates: BTreeSet<i64> = whole_secs.collect();
    // Even spacing lets several offsets meet equally many; an epoch is a rounder number than its neighbours.
    let roundness = |offset: i64| {
        let tens = std::iter::successors(Some(offset / NANOS), |v| (v % 10 == 0).then_some(v / 10));
        tens.take(18).count()
    };
    candidates
        .into_iter()
        .max_by_key(|offset| (n_met(*offset), roundness(*offset)))
        .unwrap_or(0)
}

/// The same poses at other times.
pub fn shifted(poses: &[TimedPose], offset_nanos: i64) -> Vec<TimedPose> {
    let shift = |timed: &TimedPose| TimedPose {
        stamp: Stamp::from_nanos(timed.stamp.nanos.saturating_add(offset_nanos)),
        ..*timed
    };
    poses.iter().map(shift).collect()
}

fn parse_line(content: &str) -> Result<TimedPose, &'static str> {
    let mut words = content.split_ascii_whitespace();
    let stamp =
        parse_stamp(words.next().unwrap_or_default()).ok_or("the stamp is no number of seconds")?;
    let mut numbers = [0.0; 7];
    for number in &mut numbers {
        let word = words.next().ok_or("it has fewer than eight numbers")?;
        *number = word
            .parse()
            .ok()
            .ok_or("it holds something that is no number")?;
    }
    if words.next().is_some() {
        return Err("it has more than eight numbers");
    }
    if !numbers.iter().all(|v: &f64| v.abs() <= MAX_COORDINATE) {
        return Err("it holds a number that is not finite or absurdly large");
    }
    let [tx, ty, tz, qx, qy, qz, qw] = numbers;
    let rotation = DQuat::from_xyzw(qx, qy, qz, qw);
    if (rotation.length() - 1.0).abs() > QUATERNION_SLACK {
        return Err("the quaternion has not length 1");
    }
    Ok(TimedPose {
        stamp,
        pose: Rigid::new(rotation.normalize(), DVec3::new(tx, ty, tz)),
    })
}

/// Decimal seconds to nanoseconds without loss: an f64 of seconds since 1970 resolves only 240 ns.
/// Numbers with an exponent, as numpy writes them, take the way over f64.
fn parse_stamp(word: &str) -> Option<Stamp> {
    if word.contains(['e', 'E']) {
        let secs: f64 = word.parse().ok()?;
        return (secs.abs() < i64::MAX as f64 * 1e-9).then(|| Stamp::from_secs(secs));
    }
    let digits = word.strip_prefix(['-', '+']).unwrap_or(word);
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let is_number = |part: &str| part.bytes().all(|b| b.is_ascii_digit());
    if !is_number(whole) || !is_number(fraction) || (whole.is_empty() && fraction.is_empty()) {
        return None;
    }
    let secs: i64 = if whole.is_empty() {
        0
    } else {
        whole.parse().ok()?
    };
    let digit = |ix: usize| {
        fraction
            .as_bytes()
            .get(ix)
            .map_or(0, |b| i64::from(b - b'0'))
    };
    let mut nanos = (0..9).fold(0, |nanos, ix| nanos * 10 + digit(ix));
    nanos += i64::from(digit(9) >= 5);
    let total = secs.checked_mul(1_000_000_000)?.checked_add(nanos)?;
    Some(Stamp::from_nanos(if word.starts_with('-') {
        -total
    } else {
        total
    }))
}

/// Enough of a bad line to recognise it.
fn shortened(line: &str) -> String {
    const MAX_CHARS: usize = 80;
    let mut text: String = line.chars().take(MAX_CHARS).collect();
    if text.len() < line.len() {
        text.push('…');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_are_read_to_the_nanosecond() {
        let check = |word: &str, nanos: Option<i64>| {
            assert_eq!(parse_stamp(word).map(|s| s.nanos), nanos, "{word}");
        };
        check("1403715273.262142976", Some(1_403_715_273_262_142_976));
        check("0.1", Some(100_000_000));
        check(".5", Some(500_000_000));
        check("7", Some(7_000_000_000));
        check("-1.25", Some(-1_250_000_000));
        check("0.9999999999", Some(1_000_000_000));
        check("1.5e2", Some(150_000_000_000));
        for bad in [
            "",
            ".",
            "-",
            "nan",
            "inf",
            "1e400",
            "1403715273262142976",
            "0x10",
            "1.2.3",
            "١",
        ] {
            check(bad, None);
        }
    }
}
