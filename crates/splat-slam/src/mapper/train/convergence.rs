//! Losses of steps -> whether more steps on the same views would still pay.

/// Losses are compared between stretches of so many steps per view: single views differ too much.
const STEPS_PER_VIEW: u64 = 6;
const MIN_STRETCH: u64 = 200;
/// A stretch that gained less than this share of the loss is flat; so many in a row are the end.
const MIN_GAIN: f64 = 0.01;
const N_FLAT: u32 = 2;

/// Watches the loss since something new came.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Convergence {
    sum: f64,
    n_steps: u64,
    /// Mean loss of the stretch before.
    before: Option<f64>,
    n_flat: u32,
}

impl Convergence {
    /// `loss` is the mean of `n_steps` steps.
    pub(crate) fn note(&mut self, loss: f64, n_steps: u64, n_views: usize) {
        self.sum += loss * n_steps as f64;
        self.n_steps += n_steps;
        if self.n_steps < (STEPS_PER_VIEW * n_views as u64).max(MIN_STRETCH) {
            return;
        }
        let mean = self.sum / self.n_steps as f64;
        let is_flat = self
            .before
            .is_some_and(|before| mean > (1.0 - MIN_GAIN) * before);
        *self = Self {
            before: Some(mean),
            n_flat: if is_flat { self.n_flat + 1 } else { 0 },
            ..Self::default()
        };
    }

    pub(crate) fn is_over(&self) -> bool {
        self.n_flat >= N_FLAT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps_until_over(loss: impl Fn(u64) -> f64) -> Option<u64> {
        let mut convergence = Convergence::default();
        (1..2000).map(|i| 20 * i).find(|&step| {
            convergence.note(loss(step), 20, 30);
            convergence.is_over()
        })
    }

    #[test]
    fn a_falling_loss_goes_on_and_a_flat_one_ends() {
        let noise = |step: u64| 0.02 * ((step * 7919 % 13) as f64 / 13.0 - 0.5);
        let falling = |step: u64| 0.05 + 0.3 * (-(step as f64) / 1500.0).exp() + 0.1 * noise(step);
        let over = steps_until_over(falling).unwrap();
        assert!((3000..12000).contains(&over), "{over}");
        let flat = steps_until_over(|step| 0.1 + 0.1 * noise(step)).unwrap();
        assert_eq!(flat, 600, "two flat stretches behind the first");
        assert_eq!(
            steps_until_over(|step| 0.9_f64.powf(step as f64 / 200.0)),
            None
        );
    }

    #[test]
    fn a_loss_that_is_no_number_ends_nothing_for_good() {
        let over = steps_until_over(|step| if step < 400 { f64::NAN } else { 0.1 });
        assert!(over.is_some_and(|o| o > 400), "{over:?}");
    }
}
