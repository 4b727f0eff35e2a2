//! What Adam keeps of a splat: moments, and how many updates they have had (Kingma & Ba 2015).

use std::sync::LazyLock;

pub(crate) const BETA_1: f32 = 0.9;
pub(crate) const BETA_2: f32 = 0.999;
pub(crate) const EPS: f32 = 1e-15;
/// What a decay leaves of a rate at least.
const MIN_RATE_SHARE: f32 = 0.01;
/// From this age on both corrections are 1 in f32.
const MAX_CORRECTED_AGE: u16 = 16_640;

/// What bias correction makes of the moments, by age: `1 / (1 - beta_1^t)` and `1 / sqrt(1 - beta_2^t)`.
static CORRECTIONS: LazyLock<Vec<[f32; 2]>> = LazyLock::new(|| {
    let correction = |age: u16| {
        let rest = [BETA_1, BETA_2].map(|beta| 1.0 - f64::from(beta).powf(f64::from(age)));
        [1.0 / rest[0], 1.0 / rest[1].sqrt()].map(|c| c as f32)
    };
    (0..=MAX_CORRECTED_AGE).map(correction).collect()
});

/// First and second moment of one attribute, one row a splat.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Moments {
    pub(crate) first: Vec<f32>,
    pub(crate) second: Vec<f32>,
}

/// Updates that a splat has had; both counts stop at their largest.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct UpdateCounts {
    /// Since its moments were 0: what bias correction needs.
    pub(crate) since_cleared: u16,
    /// In all, those of the splat that it was copied from included: what admits SH bands. A splat that is shared out
    /// every few hundred steps would else never come to its upper bands.
    pub(crate) in_all: u16,
}

impl UpdateCounts {
    /// What a decay leaves of a rate at this update, 0 to 1: settled splats shall not follow each view.
    pub(crate) fn share_of_rate(self, decay: f32) -> f32 {
        (1.0 / (1.0 + decay * f32::from(self.in_all))).max(MIN_RATE_SHARE)
    }

    /// Updates of an SH band, this one included; `None`: it is not its turn yet.
    pub(crate) fn of_band(self, band: u32, interval: u32) -> Option<u16> {
        let first = band.saturating_mul(interval).clamp(1, u32::from(u16::MAX)) as u16;
        let since_first = self.in_all.checked_sub(first)?.saturating_add(1);
        Some(since_first.min(self.since_cleared))
    }
}

pub(crate) fn correction(age: u16) -> [f32; 2] {
    CORRECTIONS[usize::from(age.min(MAX_CORRECTED_AGE))]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_band_waits_for_its_turn_and_then_counts_its_own_updates() {
        let update_counts = |since_cleared, in_all| UpdateCounts {
            since_cleared,
            in_all,
        };
        assert_eq!(update_counts(5, 5).of_band(3, 0), Some(5), "no interval");
        assert_eq!(update_counts(99, 99).of_band(1, 100), None);
        assert_eq!(
            update_counts(100, 100).of_band(1, 100),
            Some(1),
            "its first"
        );
        assert_eq!(update_counts(150, 250).of_band(2, 100), Some(51));
        assert_eq!(
            update_counts(3, 250).of_band(2, 100),
            Some(3),
            "cleared since"
        );
        assert_eq!(update_counts(9, 9).of_band(3, u32::MAX), None);
    }
}
