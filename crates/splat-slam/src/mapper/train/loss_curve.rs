//! Losses of steps -> a curve of bounded length.

/// Points beyond which the distance between those of the loss curve doubles.
const MAX_CURVE: usize = 400;
/// Steps between points of the loss curve at first.
const FIRST_NOTE_EVERY: u64 = 20;

#[derive(Debug)]
pub(crate) struct LossCurve {
    points: Vec<(u64, f64)>,
    /// Steps between points of the curve.
    note_every: u64,
}

impl Default for LossCurve {
    fn default() -> Self {
        Self {
            points: Vec::new(),
            note_every: FIRST_NOTE_EVERY,
        }
    }
}

impl LossCurve {
    /// (step, mean loss since the one before).
    pub(crate) fn points(&self) -> &[(u64, f64)] {
        &self.points
    }

    pub(crate) fn is_due(&self, n_steps: u64) -> bool {
        n_steps.is_multiple_of(self.note_every)
    }

    pub(crate) fn push(&mut self, n_steps: u64, loss: f64) {
        self.points.push((n_steps, loss));
    }

    /// A live run has no end: half the points at twice the distance show the same curve.
    pub(crate) fn bound(&mut self) {
        if self.points.len() > MAX_CURVE {
            let mut odd = false;
            self.points.retain(|_| {
                odd = !odd;
                odd
            });
            self.note_every *= 2;
        }
    }
}
