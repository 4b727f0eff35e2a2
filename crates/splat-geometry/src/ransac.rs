//! Samples drawn at random -> the model that most of the data agree with (Fischler and Bolles 1981).
//!
//! Knows nothing of what is sampled. Seeded by its caller, so equal inputs give equal outputs.

use rand::{Rng, RngExt};

/// How many samples are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tries {
    pub min: usize,
    pub max: usize,
    /// Chance of having missed a sample without outliers at which the search ends.
    pub miss: f64,
    /// Loss of a model that no datum agrees with.
    pub all_wrong: f64,
    /// Share of the data that is taken to agree at least, however high the loss.
    pub least_share: f64,
}

impl Tries {
    /// As many as that, whatever is found.
    pub fn fixed(n: usize) -> Self {
        Self {
            min: n,
            max: n,
            miss: 1.0,
            all_wrong: 1.0,
            least_share: 0.0,
        }
    }

    /// Samples of `size` that are enough once a model with that loss is known. Truncated losses overestimate what is
    /// wrong, so the share is a safe lower bound.
    fn needed(&self, loss: f64, size: usize) -> usize {
        if self.min == self.max {
            return self.max;
        }
        let share = (1.0 - loss / self.all_wrong).max(self.least_share);
        let needed = self.miss.ln() / (1.0 - share.powi(size as i32)).max(1e-12).ln();
        (needed.ceil() as usize).clamp(self.min, self.max)
    }
}

/// The model with the lowest loss, and that loss. Each sample is `N` of the `n` data by their numbers, which may repeat;
/// `models` makes any number of models of it, and `loss` is reported the lowest one so far: it may answer `None` as soon as
/// that is passed. `None` where no sample gave a model.
pub fn search<const N: usize, Model, Models: IntoIterator<Item = Model>>(
    rng: &mut impl Rng,
    n: usize,
    tries: &Tries,
    models: impl Fn([usize; N]) -> Models,
    loss: impl Fn(&Model, f64) -> Option<f64>,
) -> Option<(Model, f64)> {
    let mut best = None;
    let (mut lowest, mut n_tries, mut done) = (f64::INFINITY, tries.max, 0);
    while done < n_tries {
        done += 1;
        for model in models(std::array::from_fn(|_| rng.random_range(0..n))) {
            if let Some(found) = loss(&model, lowest).filter(|found| *found < lowest) {
                (best, lowest) = (Some(model), found);
                n_tries = tries.needed(found, N);
            }
        }
    }
    best.map(|model| (model, lowest))
}

/// Fits the model anew to all that agree with it, at most `rounds` times, as long as no fewer agree then.
pub fn refit<Model>(
    (mut model, mut inliers): (Model, Vec<usize>),
    rounds: usize,
    fit: impl Fn(&[usize]) -> Option<Model>,
    agree: impl Fn(&Model) -> Vec<usize>,
) -> (Model, Vec<usize>) {
    for _ in 0..rounds {
        let Some(better) = fit(&inliers) else {
            break;
        };
        let now = agree(&better);
        if now.len() < inliers.len() {
            break;
        }
        (model, inliers) = (better, now);
    }
    (model, inliers)
}

/// Whether a sample names something twice: of that, most models are none.
pub fn repeats<const N: usize>(sample: &[usize; N]) -> bool {
    (1..N).any(|i| sample[..i].contains(&sample[i]))
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use rand::SeedableRng;
    use rand_pcg::Pcg32;

    use super::*;

    /// Slope and offset.
    type Line = (f64, f64);

    /// Points on one line but for every third.
    fn points() -> Vec<(f64, f64)> {
        let at = |i: u32| {
            let x = f64::from(i);
            let off = if i.is_multiple_of(3) {
                5.0 + x * x
            } else {
                0.0
            };
            (x, 2.0 * x + 1.0 + off)
        };
        (0..30).map(at).collect()
    }

    fn through(a: (f64, f64), b: (f64, f64)) -> Line {
        let slope = (b.1 - a.1) / (b.0 - a.0);
        (slope, a.1 - slope * a.0)
    }

    fn is_on(line: &Line, (x, y): (f64, f64)) -> bool {
        (line.0 * x + line.1 - y).abs() < 1e-6
    }

    fn found(tries: &Tries, n_drawn: &Cell<usize>) -> Option<(Line, f64)> {
        let points = points();
        let models = |sample: [usize; 2]| {
            n_drawn.set(n_drawn.get() + 1);
            let line = through(points[sample[0]], points[sample[1]]);
            (!repeats(&sample)).then_some(line)
        };
        let loss =
            |line: &Line, _| Some(points.iter().filter(|p| !is_on(line, **p)).count() as f64);
        search(
            &mut Pcg32::seed_from_u64(3),
            points.len(),
            tries,
            models,
            loss,
        )
    }

    #[test]
    fn the_model_of_the_majority_is_found_and_ends_the_search() {
        let tries = Tries {
            min: 5,
            max: 500,
            miss: 1e-3,
            all_wrong: 30.0,
            least_share: 0.05,
        };
        let n_drawn = Cell::new(0);
        let (line, loss) = found(&tries, &n_drawn).unwrap();
        assert!(
            is_on(&line, (100.0, 201.0)) && loss == 10.0,
            "{line:?} {loss}"
        );
        // Two thirds agree: ln(0.001) / ln(1 - 4/9) = 11.8 samples.
        assert!((5..=12).contains(&n_drawn.get()), "{}", n_drawn.get());
    }

    #[test]
    fn a_fixed_number_of_samples_is_drawn_whatever_is_found() {
        let n_drawn = Cell::new(0);
        assert!(found(&Tries::fixed(40), &n_drawn).is_some());
        assert_eq!(n_drawn.get(), 40);
        assert!(found(&Tries::fixed(0), &n_drawn).is_none());
    }

    #[test]
    fn refitting_ends_where_fewer_agree() {
        let shrinking = |model: &usize| (0..*model).collect::<Vec<usize>>();
        let fewer = refit((5, shrinking(&5)), 9, |_| Some(3), shrinking);
        assert_eq!(fewer.0, 5);
        let more = refit((5, shrinking(&5)), 2, |on| Some(on.len() + 1), shrinking);
        assert_eq!(more, (7, shrinking(&7)));
    }
}
