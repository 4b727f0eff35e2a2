//! A start and a cost -> a state that costs less, step by step: damped least squares (Levenberg 1944, Marquardt 1963).
//!
//! Knows nothing of what moves. How steps are made, and what they cost, says the problem.

/// What is to be minimised.
pub trait LeastSquares {
    type State;
    /// Derivatives at a state, of use for every damping.
    type Linear;

    fn cost(&self, state: &Self::State) -> f64;

    fn linearise(&self, state: &Self::State) -> Self::Linear;

    /// The state after a step; `None` where the damped equations have no solution.
    fn stepped(
        &self,
        state: &Self::State,
        linear: &Self::Linear,
        damping: f64,
    ) -> Option<Self::State>;
}

/// How damping follows the steps, and when they end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    pub first: f64,
    /// Factor after a step that helped, down to the least.
    pub down: f64,
    pub least: f64,
    /// Factor after a step that did not, up to the most, which ends the descent.
    pub up: f64,
    /// By this the factor itself grows from one failure to the next.
    pub up_growth: f64,
    pub most: f64,
    /// A step that gains less than this share of the cost is the last one.
    pub min_gain: f64,
}

/// What came of it.
#[derive(Debug)]
pub struct Descent<Linear> {
    pub cost_before: f64,
    pub cost_after: f64,
    /// Tried, with success or without.
    pub n_steps: usize,
    /// Derivatives at the last state, where they are known: after a step that did not help.
    pub linear: Option<Linear>,
}

/// Takes steps that lower the cost.
pub fn descend<Problem: LeastSquares>(
    problem: &Problem,
    state: &mut Problem::State,
    schedule: &Schedule,
    max_steps: usize,
) -> Descent<Problem::Linear> {
    let cost = problem.cost(state);
    let mut descent = Descent {
        cost_before: cost,
        cost_after: cost,
        n_steps: 0,
        linear: None,
    };
    let (mut damping, mut up) = (schedule.first, schedule.up);
    while descent.n_steps < max_steps {
        descent.n_steps += 1;
        let known = descent.linear.take();
        let linear = known.unwrap_or_else(|| problem.linearise(state));
        let cost = descent.cost_after;
        let candidate = problem.stepped(state, &linear, damping);
        let new_cost = candidate
            .as_ref()
            .map_or(f64::INFINITY, |candidate| problem.cost(candidate));
        if let Some(candidate) = candidate.filter(|_| new_cost < cost) {
            *state = candidate;
            descent.cost_after = new_cost;
            damping = (damping * schedule.down).max(schedule.least);
            up = schedule.up;
            if (cost - new_cost) / cost.max(1e-300) < schedule.min_gain {
                break;
            }
        } else {
            descent.linear = Some(linear);
            damping *= up;
            up *= schedule.up_growth;
            if damping >= schedule.most {
                break;
            }
        }
    }
    descent
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCHEDULE: Schedule = Schedule {
        first: 1e-3,
        down: 0.1,
        least: 1e-12,
        up: 10.0,
        up_growth: 1.0,
        most: 1e8,
        min_gain: 1e-12,
    };

    /// Rosenbrock's valley: residuals 10 (y - x^2) and 1 - x.
    struct Valley;

    impl LeastSquares for Valley {
        type State = [f64; 2];
        type Linear = ([[f64; 2]; 2], [f64; 2]);

        fn cost(&self, [x, y]: &[f64; 2]) -> f64 {
            (10.0 * (y - x * x)).powi(2) + (1.0 - x).powi(2)
        }

        fn linearise(&self, [x, y]: &[f64; 2]) -> Self::Linear {
            (
                [[-20.0 * x, 10.0], [-1.0, 0.0]],
                [10.0 * (y - x * x), 1.0 - x],
            )
        }

        fn stepped(
            &self,
            state: &[f64; 2],
            (by, r): &Self::Linear,
            damping: f64,
        ) -> Option<[f64; 2]> {
            let dot = |i: usize, j: usize| by[0][i] * by[0][j] + by[1][i] * by[1][j];
            let (a, b, c) = (dot(0, 0) + damping, dot(0, 1), dot(1, 1) + damping);
            let g = [0, 1].map(|i| by[0][i] * r[0] + by[1][i] * r[1]);
            let det = a * c - b * b;
            let step = [(c * g[0] - b * g[1]) / det, (a * g[1] - b * g[0]) / det];
            (det > 0.0).then(|| [state[0] - step[0], state[1] - step[1]])
        }
    }

    #[test]
    fn a_curved_valley_is_followed_to_its_end() {
        let mut state = [-1.2, 1.0];
        let descent = descend(&Valley, &mut state, &SCHEDULE, 100);
        assert!(
            (state[0] - 1.0).abs() < 1e-6 && (state[1] - 1.0).abs() < 1e-6,
            "{state:?}"
        );
        assert!(descent.cost_after < 1e-12 * descent.cost_before);
        assert!(descent.n_steps < 100, "the gain ends it");
    }

    /// Lowest where it starts.
    struct Bottom;

    impl LeastSquares for Bottom {
        type State = f64;
        type Linear = ();

        fn cost(&self, state: &f64) -> f64 {
            state.abs()
        }

        fn linearise(&self, _: &f64) {}

        fn stepped(&self, state: &f64, (): &(), damping: f64) -> Option<f64> {
            (damping > 1e-2).then_some(state + 1.0 / damping)
        }
    }

    #[test]
    fn without_a_better_step_nothing_moves_and_damping_ends_it() {
        let mut state = 0.0;
        let descent = descend(&Bottom, &mut state, &SCHEDULE, 100);
        // 1e-3 grows tenfold each time until it is 1e8.
        assert!(
            state == 0.0 && (11..=12).contains(&descent.n_steps),
            "{descent:?}"
        );
        assert!(descent.linear.is_some());
        let faster = Schedule {
            up_growth: 10.0,
            ..SCHEDULE
        };
        assert!(descend(&Bottom, &mut state, &faster, 100).n_steps < 6);
    }
}
