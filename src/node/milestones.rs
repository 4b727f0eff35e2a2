//! Steps at which a replay stops to measure quality (`eval.at_steps`).

use std::collections::VecDeque;

use crate::eval::lpips::{Lpips, lpips};
use crate::eval::report_json::{Quality, QualityAt};
use crate::node::quality::{MeasuredViews, measure_quality};
use crate::params::params::Params;
use splat_engine::error::EngineError;
use splat_slam::mapper::mapper::Mapper;
use splat_types::time::Stopwatch;

/// More are a mistake: each costs as much as the figures at the end.
const MAX_MILESTONES: usize = 64;

/// `eval.at_steps` is not what it should be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "eval.at_steps has {found:?}, which is no number of steps above 0; write up to {MAX_MILESTONES} with commas between, as 4000,7000"
)]
pub(crate) struct MilestoneError {
    found: String,
}

/// The milestones ahead, and what was measured at those behind.
#[derive(Debug, Default)]
pub(crate) struct Milestones {
    ahead: VecDeque<u64>,
    views: Option<MeasuredViews>,
    lpips: Option<Lpips>,
    watch: Option<Stopwatch>,
    /// Seconds that measuring took.
    pub(crate) spent_secs: f64,
    pub(crate) behind: Vec<QualityAt>,
}

impl Milestones {
    /// None live, where nothing may wait.
    pub(crate) fn of(params: &Params, is_live: bool) -> anyhow::Result<Self> {
        let ahead = parse(&params.eval.at_steps)?;
        if is_live || ahead.is_empty() {
            return Ok(Self::default());
        }
        Ok(Self {
            ahead,
            views: Some(MeasuredViews {
                holdout_every: params.map.holdout,
                max_train: params.eval.train_views,
                was_stopped: false,
            }),
            lpips: lpips(&params.eval.lpips_model)?,
            watch: Some(Stopwatch::start()),
            ..Self::default()
        })
    }

    /// The end of the steps that may be made at once, where `target` is that of all.
    pub(crate) fn next(&self, target: u64) -> u64 {
        self.ahead.front().map_or(target, |next| target.min(*next))
    }

    /// Whether quality is to be measured after so many steps.
    pub(crate) fn is_due(&self, n_steps: u64) -> bool {
        self.ahead.front().is_some_and(|next| n_steps >= *next)
    }

    /// Poses of held-out views are to be refined before.
    pub(crate) fn measure(
        &mut self,
        map: &mut Mapper,
        since: &Stopwatch,
    ) -> Result<(), EngineError> {
        let steps = map.n_steps();
        while self.is_due(steps) {
            self.ahead.pop_front();
        }
        let (Some(views), Some(watch)) = (self.views, &self.watch) else {
            return Ok(());
        };
        let wall_s = watch.secs() - self.spent_secs - since.secs();
        let (quality, _): (Quality, _) =
            measure_quality(map, views, &mut self.lpips, &mut |_, _| {})?;
        self.spent_secs += since.secs();
        tracing::info!(
            "after {steps} steps, {wall_s:.0} s: {} dB on held-out views",
            quality
                .psnr_holdout
                .map_or("no".to_owned(), |db| format!("{db:.2}"))
        );
        self.behind.push(QualityAt {
            steps,
            wall_s,
            measured_s: self.spent_secs,
            splats: map.n_splats() as u64,
            quality,
        });
        Ok(())
    }
}

/// In rising order, each once.
fn parse(text: &str) -> Result<VecDeque<u64>, MilestoneError> {
    let parts = text
        .split(',')
        .map(str::trim)
        .filter(|part| !part.is_empty());
    let number = |part: &str| {
        let number = part.parse().ok().filter(|n| *n > 0);
        number.ok_or_else(|| MilestoneError {
            found: part.to_owned(),
        })
    };
    let mut all: Vec<u64> = parts.map(number).collect::<Result<_, _>>()?;
    all.sort_unstable();
    all.dedup();
    if all.len() > MAX_MILESTONES {
        return Err(MilestoneError {
            found: format!("{} numbers", all.len()),
        });
    }
    Ok(all.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn milestones_are_read_in_any_order() {
        assert_eq!(parse(" 7000, 4000,7000 ,").unwrap(), [4000, 7000]);
        assert!(parse("").unwrap().is_empty());
    }

    #[test]
    fn what_is_no_number_of_steps_is_refused_with_the_way_out() {
        for bad in ["4k", "-1", "0", "4000;7000", "1e3"] {
            let error = parse(bad).unwrap_err().to_string();
            assert!(
                error.contains(bad) && error.contains("4000,7000"),
                "{error}"
            );
        }
        let many: Vec<String> = (1..=65).map(|n| n.to_string()).collect();
        assert!(parse(&many.join(",")).is_err());
    }

    #[test]
    fn steps_end_at_the_next_milestone() {
        let milestones = Milestones {
            ahead: [10, 20].into(),
            ..Milestones::default()
        };
        assert_eq!(milestones.next(15), 10);
        assert_eq!(milestones.next(5), 5);
        assert!(milestones.is_due(10) && !milestones.is_due(9));
        assert_eq!(Milestones::default().next(15), 15);
    }
}
