//! Ground truth poses by stamp: from PoseStamped, from tf chains, from TUM trajectories.
//!
//! Knows nothing of files. Poses are `world_from_cam` with OpenCV axes.

use std::collections::BTreeMap;
use std::sync::Arc;

use splat_msgs::ros::TfMessage;
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, extent};

/// Poses and transforms kept of one recording: an hour at 100 Hz, in 35 MB.
const MAX_POSES: usize = 400_000;
/// Links from the camera up to the map; a longer chain is a loop.
const MAX_CHAIN: usize = 32;
/// Frames that count as the fixed world, best first (REP-105).
const WORLD_FRAMES: [&str; 2] = ["map", "world"];
/// Frame in which odometry counts its steps (REP-105).
const ODOM_FRAME: &str = "odom";
/// Odometry is not reported across longer gaps.
const MAX_ODOMETRY_GAP_NANOS: i64 = 500_000_000;
/// Assumed between frames when a recording has a single one.
const FALLBACK_INTERVAL_NANOS: i64 = 100_000_000;

/// Where ground truth comes from.
#[derive(Debug)]
pub(crate) enum GroundTruth {
    None,
    Track(Track),
    Transforms {
        transforms: Arc<Transforms>,
        camera_frame: String,
    },
}

impl GroundTruth {
    /// A chain of transforms has none until it is walked.
    pub(crate) fn extent(&self) -> Option<f64> {
        match self {
            Self::Track(track) => track.extent(),
            Self::None | Self::Transforms { .. } => None,
        }
    }

    pub(crate) fn at(&self, stamp: Stamp, within_nanos: i64) -> Option<Rigid> {
        match self {
            Self::None => None,
            Self::Track(track) => track.nearest(stamp, within_nanos),
            Self::Transforms {
                transforms,
                camera_frame,
            } => transforms.world_from(camera_frame, stamp, within_nanos),
        }
    }
}

/// Poses over time.
#[derive(Debug, Clone, Default)]
pub struct Track {
    by_nanos: BTreeMap<i64, Rigid>,
}

impl Track {
    /// False when the track is full and the pose was left out.
    pub fn insert(&mut self, stamp: Stamp, pose: Rigid) -> bool {
        let has_room = self.by_nanos.len() < MAX_POSES;
        if has_room {
            self.by_nanos.insert(stamp.nanos, pose);
        }
        has_room
    }

    pub fn is_empty(&self) -> bool {
        self.by_nanos.is_empty()
    }

    #[cfg(feature = "live-messages")]
    pub fn forget_before(&mut self, stamp: Stamp) {
        self.by_nanos = self.by_nanos.split_off(&stamp.nanos);
    }

    /// Largest distance between two positions.
    pub(crate) fn extent(&self) -> Option<f64> {
        let positions: Vec<_> = self.by_nanos.values().map(|p| p.translation).collect();
        (!positions.is_empty()).then(|| extent(&positions))
    }

    /// The pose at a time between two that are not far apart.
    pub fn between(&self, stamp: Stamp) -> Option<Rigid> {
        let before = self.by_nanos.range(..=stamp.nanos).next_back()?;
        let after = self.by_nanos.range(stamp.nanos..).next()?;
        let gap = after.0.checked_sub(*before.0)?;
        if gap > MAX_ODOMETRY_GAP_NANOS {
            return None;
        }
        let share = (stamp.nanos - before.0) as f64 / gap.max(1) as f64;
        Some(before.1.between(after.1, share))
    }

    /// The pose nearest in time, if it is at most `within_nanos` away.
    pub fn nearest(&self, stamp: Stamp, within_nanos: i64) -> Option<Rigid> {
        let before = self.by_nanos.range(..=stamp.nanos).next_back();
        let after = self.by_nanos.range(stamp.nanos..).next();
        let distance = |nanos: &i64| nanos.abs_diff(stamp.nanos);
        let nearest = before
            .into_iter()
            .chain(after)
            .min_by_key(|(nanos, _)| distance(nanos))?;
        (distance(nearest.0) <= within_nanos.unsigned_abs()).then_some(*nearest.1)
    }
}

/// Where odometry comes from: `odom_from_cam`.
#[derive(Debug, Default)]
pub(crate) enum Odometry {
    #[default]
    None,
    Messages {
        /// `odom_from_base`.
        track: Track,
        base_from_cam: Rigid,
    },
    Transforms {
        transforms: Arc<Transforms>,
        camera_frame: String,
    },
}

impl Odometry {
    pub(crate) fn at(&self, stamp: Stamp) -> Option<Rigid> {
        match self {
            Self::None => None,
            Self::Messages {
                track,
                base_from_cam,
            } => Some(track.between(stamp)? * *base_from_cam),
            Self::Transforms {
                transforms,
                camera_frame,
            } => transforms.moving(ODOM_FRAME, camera_frame, stamp),
        }
    }
}

/// How far a pose may be from its frame: half the usual gap between frames.
pub(crate) fn half_interval(stamps: &[Stamp]) -> i64 {
    let mut gaps: Vec<i64> = stamps
        .windows(2)
        .map(|pair| pair[1].nanos.saturating_sub(pair[0].nanos))
        .filter(|&gap| gap > 0)
        .collect();
    gaps.sort_unstable();
    gaps.get(gaps.len() / 2)
        .copied()
        .unwrap_or(FALLBACK_INTERVAL_NANOS)
        / 2
}

/// Transforms of a recording: each frame has one parent at a time.
#[derive(Debug, Clone, Default)]
pub struct Transforms {
    /// child -> (parent, parent_from_child over time, is it static).
    links: BTreeMap<String, Link>,
    n_transforms: usize,
}

#[derive(Debug, Clone)]
struct Link {
    parent: String,
    is_static: bool,
    track: Track,
}

impl Transforms {
    /// False when there is no room for more.
    pub fn insert(&mut self, message: &TfMessage, is_static: bool) -> bool {
        for transform in &message.transforms {
            if self.n_transforms >= MAX_POSES {
                return false;
            }
            let Some(parent_from_child) = transform.transform.to_rigid() else {
                continue;
            };
            // tf1 wrote a leading slash, and bags that were converted still have it.
            let name = |frame: &str| frame.trim_start_matches('/').to_owned();
            let child = name(&transform.child_frame_id);
            let parent = name(&transform.header.frame_id);
            let link = self.links.entry(child).or_insert_with(|| Link {
                parent,
                is_static,
                track: Track::default(),
            });
            link.track
                .insert(transform.header.stamp.into(), parent_from_child);
            self.n_transforms += 1;
        }
        true
    }

    /// Whether the camera's frame hangs below a world frame.
    pub(crate) fn reaches_world(&self, camera_frame: &str) -> bool {
        WORLD_FRAMES
            .iter()
            .any(|world| self.chain(camera_frame, world).is_some())
    }

    /// `world_from_cam` at a time: each moving link within `within_nanos` of it.
    pub fn world_from(&self, camera_frame: &str, stamp: Stamp, within_nanos: i64) -> Option<Rigid> {
        let chain = WORLD_FRAMES
            .iter()
            .find_map(|world| self.chain(camera_frame, world))?;
        Self::along(&chain, |track| track.nearest(stamp, within_nanos))
    }

    /// The transform up a chain; moving links are asked for their own.
    fn along(chain: &[&Link], moving: impl Fn(&Track) -> Option<Rigid>) -> Option<Rigid> {
        let mut top_from_child = Rigid::IDENTITY;
        for link in chain {
            let parent_from_child = if link.is_static {
                link.track.by_nanos.values().next_back().copied()
            } else {
                moving(&link.track)
            };
            top_from_child = parent_from_child? * top_from_child;
        }
        Some(top_from_child)
    }

    /// `parent_from_child` at a time between messages.
    pub fn moving(&self, parent: &str, child: &str, stamp: Stamp) -> Option<Rigid> {
        let chain = self.chain(child, parent)?;
        Self::along(&chain, |track| track.between(stamp))
    }

    /// Live input goes on for ever: what moves is kept from `stamp` on, what is fixed as it was reported last.
    #[cfg(feature = "live-messages")]
    pub fn forget_before(&mut self, stamp: Stamp) {
        for link in self.links.values_mut() {
            let from = match link.track.by_nanos.last_key_value() {
                Some((newest, _)) if link.is_static => *newest,
                _ => stamp.nanos,
            };
            link.track.forget_before(Stamp::from_nanos(from));
        }
        self.links.retain(|_, link| !link.track.is_empty());
        let lengths = self.links.values().map(|link| link.track.by_nanos.len());
        self.n_transforms = lengths.sum();
    }

    /// Whether a frame is above another.
    #[cfg(feature = "live-messages")]
    pub fn reaches(&self, child: &str, parent: &str) -> bool {
        self.chain(child, parent).is_some()
    }

    /// Whether odometry's frame is above the camera's.
    pub(crate) fn reaches_odometry(&self, camera_frame: &str) -> bool {
        self.chain(camera_frame, ODOM_FRAME).is_some()
    }

    /// How the camera is mounted: links of a robot's body, which never move.
    pub fn fixed(&self, parent: &str, child: &str) -> Option<Rigid> {
        let chain = self.chain(child, parent.trim_start_matches('/'))?;
        Self::along(&chain, |_| None)
    }

    /// `to_from_from` of two frames on one body, of which neither need be above the other.
    pub fn between(&self, to: &str, from: &str) -> Option<Rigid> {
        let (above_to, above_from) = (self.fixed_above(to), self.fixed_above(from));
        above_from.iter().find_map(|(name, top_from_from)| {
            let (_, top_from_to) = above_to.iter().find(|(other, _)| other == name)?;
            Some(top_from_to.inverse() * *top_from_from)
        })
    }

    /// A frame and those above it by links that never move, each with `above_from_frame`.
    fn fixed_above<'a>(&'a self, frame: &'a str) -> Vec<(&'a str, Rigid)> {
        let mut above = vec![(frame.trim_start_matches('/'), Rigid::IDENTITY)];
        while let Some((name, from_frame)) = above.last().copied()
            && above.len() <= MAX_CHAIN
        {
            let Some(link) = self.links.get(name).filter(|link| link.is_static) else {
                break;
            };
            let Some(parent_from_child) = link.track.by_nanos.values().next_back() else {
                break;
            };
            above.push((&link.parent, *parent_from_child * from_frame));
        }
        above
    }

    /// Links from the camera up to `world`.
    fn chain(&self, camera_frame: &str, world: &str) -> Option<Vec<&Link>> {
        let mut chain = Vec::new();
        let mut frame = camera_frame.trim_start_matches('/');
        while frame != world {
            let link = self.links.get(frame)?;
            chain.push(link);
            if chain.len() > MAX_CHAIN {
                return None;
            }
            frame = &link.parent;
        }
        (!chain.is_empty()).then_some(chain)
    }
}

/// Lines `t tx ty tz qx qy qz qw`; comments begin with #. Lines that are none are left out and counted.
pub(crate) fn track_of_tum(text: &str) -> (Track, usize) {
    let mut track = Track::default();
    let mut n_bad = 0;
    for line in text
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty() && !line.starts_with('#'))
    {
        match pose_of_tum(line) {
            Some((stamp, pose)) if track.insert(stamp, pose) => {}
            _ => n_bad += 1,
        }
    }
    (track, n_bad)
}

fn pose_of_tum(line: &str) -> Option<(Stamp, Rigid)> {
    let mut words = line.split_whitespace();
    let stamp = stamp_of_decimal(words.next()?)?;
    let numbers: Vec<f64> = words.map(str::parse).collect::<Result<_, _>>().ok()?;
    let [x, y, z, qx, qy, qz, qw] = numbers.try_into().ok()?;
    let pose = splat_msgs::ros::Pose {
        position: splat_msgs::ros::Vector3 { x, y, z },
        orientation: splat_msgs::ros::Quaternion {
            x: qx,
            y: qy,
            z: qz,
            w: qw,
        },
    };
    Some((stamp, pose.to_rigid()?))
}

/// Seconds as decimal text, exactly: f64 has no room for nanoseconds since 1970.
pub(crate) fn stamp_of_decimal(text: &str) -> Option<Stamp> {
    let (sign, digits) = text.strip_prefix('-').map_or((1, text), |rest| (-1, rest));
    let is_plain = digits.bytes().all(|b| b.is_ascii_digit() || b == b'.')
        && digits.bytes().any(|b| b.is_ascii_digit());
    if !is_plain {
        // Exponents and the like; NaN and infinity are no times.
        return text
            .parse()
            .ok()
            .filter(|secs: &f64| secs.is_finite())
            .map(Stamp::from_secs);
    }
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let whole: i64 = if whole.is_empty() {
        0
    } else {
        whole.parse().ok()?
    };
    let fraction: String = fraction
        .chars()
        .chain("000000000".chars())
        .take(9)
        .collect();
    let nanos = whole
        .checked_mul(1_000_000_000)?
        .checked_add(fraction.parse().ok()?)?;
    Some(Stamp::from_nanos(sign * nanos))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn decimal_stamps_are_exact_to_the_nanosecond() {
        let nanos = |text: &str| stamp_of_decimal(text).map(|stamp| stamp.nanos);
        assert_eq!(nanos("1403715273.262143"), Some(1_403_715_273_262_143_000));
        assert_eq!(
            nanos("1403715273.262143001"),
            Some(1_403_715_273_262_143_001)
        );
        assert_eq!(nanos("0.1"), Some(100_000_000));
        assert_eq!(nanos("-2.5"), Some(-2_500_000_000));
        assert_eq!(nanos("7"), Some(7_000_000_000));
        assert_eq!(nanos("1e-3"), Some(1_000_000));
        for bad in ["", ".", "1.2.3", "nan", "inf", "99999999999999", "a.png"] {
            assert_eq!(nanos(bad), None, "{bad}");
        }
    }

    #[test]
    fn a_pose_counts_only_near_its_frame() {
        let mut track = Track::default();
        let at = |x: f64| Rigid::new(glam::DQuat::IDENTITY, DVec3::new(x, 0.0, 0.0));
        track.insert(Stamp::from_nanos(100), at(1.0));
        track.insert(Stamp::from_nanos(200), at(2.0));
        let x = |nanos: i64, within: i64| {
            track
                .nearest(Stamp::from_nanos(nanos), within)
                .map(|p| p.translation.x)
        };
        assert_eq!(x(100, 0), Some(1.0));
        assert_eq!(x(140, 50), Some(1.0));
        assert_eq!(x(160, 50), Some(2.0));
        assert_eq!(x(150, 49), None);
        assert_eq!(x(260, 50), None);
    }

    #[test]
    fn half_the_usual_gap_ignores_one_long_pause() {
        let stamps = [0, 10, 20, 1000, 1010].map(Stamp::from_nanos);
        assert_eq!(half_interval(&stamps), 5);
        assert_eq!(half_interval(&[]), FALLBACK_INTERVAL_NANOS / 2);
    }
}
