//! Whether a sensor beside the camera is believed: it is out when it has disagreed with the camera for a while, and back when it has
//! agreed for a longer one.

use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// What is compared spans so many seconds, and at most so many.
pub(crate) const COMPARED_SECS: f64 = 0.5;
pub(crate) const MAX_COMPARED_SECS: f64 = 2.0;
/// Standard deviations by which a sensor may be off on average over its axes; and what a measured pose may be off by: radians, and
/// as a share of the scene's depth.
const MAX_MISFIT: f64 = 4.0;
/// Beyond so many, half the time is enough to leave it out.
const GROSS_MISFIT: f64 = 12.0;
const MEASURED_TURN_STD: f64 = 0.004;
const MEASURED_STD: f64 = 0.004;
/// Seconds of disagreement after which a sensor is out, and of agreement after which it is taken back.
const OUT_AFTER_SECS: f64 = 0.8;
const BACK_AFTER_SECS: f64 = 5.0;

/// The sensor's record.
#[derive(Debug, Default)]
pub(crate) struct SensorCheck {
    /// Since when it has been otherwise than `is_out` says.
    other_since: Option<Stamp>,
    is_out: bool,
}

impl SensorCheck {
    /// By how many standard deviations the sensor of that name was off in one more comparison.
    pub(crate) fn note(&mut self, name: &str, stamp: Stamp, misfit: f64) {
        let is_off = misfit > MAX_MISFIT;
        if is_off == self.is_out {
            self.other_since = None;
            return;
        }
        let since = *self.other_since.get_or_insert(stamp);
        let needed = if self.is_out {
            BACK_AFTER_SECS
        } else if misfit > GROSS_MISFIT {
            0.5 * OUT_AFTER_SECS
        } else {
            OUT_AFTER_SECS
        };
        if stamp.secs_since(since) >= needed {
            (self.is_out, self.other_since) = (is_off, None);
            if is_off {
                tracing::warn!(
                    "{name} disagrees with the camera since {since} and is left out until it agrees for {BACK_AFTER_SECS} s"
                );
            } else {
                tracing::info!("{name} agrees with the camera again at {stamp}");
            }
        }
    }

    /// Whether the last comparison speaks against it.
    pub(crate) fn is_off(&self) -> bool {
        self.is_out == self.other_since.is_none()
    }

    pub(crate) fn is_out(&self) -> bool {
        self.is_out
    }
}

/// By how many standard deviations a motion or a pose is another than the measured one, the larger of place and turn, whose standard
/// deviations are given along and about each axis.
pub(crate) fn misfit(
    said: &Rigid,
    (place_std, turn_std): (f64, f64),
    measured: &Rigid,
    scene_depth: f64,
) -> f64 {
    let off = said.inverse() * *measured;
    let place = off.translation.length() / place_std.hypot(MEASURED_STD * scene_depth);
    let turn = off.angle_to(&Rigid::IDENTITY) / turn_std.hypot(MEASURED_TURN_STD);
    place.max(turn) / 3.0_f64.sqrt()
}
