//! Fitting and choosing guides between passes. A guide is frozen before the first sample that it draws.

use std::sync::Arc;
use std::time::Instant;

use pss_guide::{Decision, Fit, Guide, GuideError, Records};

use crate::choice::{Chooser, DEFAULT_UNIFORM_FRACTION, GuideChoice, Learner, Left};
use crate::error::RenderError;
use crate::estimator::Run;
use crate::options::{Budget, PassPlan};
use crate::progress::Phase;

/// Learning again, from twice the samples, may take this share of the time that is left: about what it gains where a guide
/// is in use, less where none paid so far and none may pay now.
const RELEARNING_TIME: f64 = 0.1;
const RECONSIDERING_TIME: f64 = 0.02;

/// Core-seconds that learning a `table` takes longer for each record more.
const SECONDS_PER_RECORD: f64 = 1e-6;

/// Share of a training from which on its end can be foretold, and how many times longer than there is time the rest must
/// promise to take for it to be given up: shares are no exact times.
const ENOUGH_TO_TELL: f64 = 0.2;
const HOPELESS: f64 = 1.5;

/// Where a chooser picked nothing from as many light-carrying paths, more would not change its mind: keeping them and
/// choosing again only costs.
const ENOUGH_FOR_NONE: usize = 1 << 19;

/// What the next pass's numbers are drawn with, and how it came about.
#[derive(Default)]
pub(crate) struct Current {
    /// `None`: uniform numbers.
    pub(crate) guide: Option<Arc<dyn Guide>>,
    /// Name of its recipe.
    pub(crate) name: String,
    /// Share of uniform paths.
    pub(crate) uniform_fraction: f32,
    /// Fitted since the last pass.
    pub(crate) fresh: bool,
    /// No more to be learned: it is trained once only, or the time for it is over.
    pub(crate) settled: bool,
    /// Samples per pixel that it was learned from.
    pub(crate) learned_from: u32,
    /// Paths that were kept then.
    pub(crate) records: usize,
    /// Time that this took.
    pub(crate) seconds: f64,
    /// What the training reported.
    pub(crate) training: serde_json::Value,
    /// What a chooser considered.
    pub(crate) candidates: serde_json::Value,
    /// Why there is no guide where one was asked for.
    pub(crate) refusal: Option<String>,
    /// How its training broke off.
    pub(crate) diverged: Option<String>,
}

impl Current {
    /// Whether learning anew, from `records` paths now, is worth its time out of what remains. The first time it always is.
    fn worth_learning(&self, records: usize, threads: usize, remaining: f64) -> bool {
        let more = records.saturating_sub(self.records) as f64;
        let seconds = self.seconds + more * SECONDS_PER_RECORD / threads.max(1) as f64;
        let share = match self.guide {
            Some(_) => RELEARNING_TIME,
            None => RECONSIDERING_TIME,
        };
        self.learned_from == 0 || seconds <= share * remaining
    }
}

impl Run<'_> {
    /// The guide at hand, for a choice that needs no learning.
    pub(crate) fn take_ready(&mut self) -> Result<(), RenderError> {
        if let GuideChoice::Ready(guide) = &self.options.guide {
            self.check_dimensions(guide.as_ref())?;
            let registered = pss_guide::Recipe::parse(guide.name(), &serde_json::Map::new());
            let usual = registered.map_or(DEFAULT_UNIFORM_FRACTION, |r| r.uniform_fraction());
            self.current.name = guide.name().to_owned();
            self.current.uniform_fraction = self.options.uniform_fraction.unwrap_or(usual);
            self.current.guide = Some(Arc::clone(guide));
        }
        Ok(())
    }

    /// Learns from all paths kept so far where that is due: the first time, and whenever samples have doubled.
    pub(crate) fn learn(&mut self, left: Left) -> Result<(), RenderError> {
        if self.current.settled || self.next_sample < self.learning_due() {
            return Ok(());
        }
        if let Budget::Time(time) = self.options.budget {
            let remaining = time - self.clock.elapsed().as_secs_f64();
            let threads = self.context.pool.current_num_threads();
            if !self
                .current
                .worth_learning(self.records.len(), threads, remaining)
            {
                self.current.settled = true;
                return Ok(());
            }
        }
        match self.options.guide.clone() {
            GuideChoice::Learn(learner) => self.fit(learner.as_ref()),
            GuideChoice::Auto(chooser) => self.choose(chooser.as_ref(), left),
            GuideChoice::None | GuideChoice::Ready(_) => Ok(()),
        }
    }

    /// Samples per pixel at which there is enough news to learn from: twice as many as the last time.
    pub(crate) fn learning_due(&self) -> u32 {
        2 * self.current.learned_from
    }

    /// Learns what a recorded pass was drawn with.
    pub(crate) fn learn_again(&mut self, pass: &PassPlan) -> Result<(), RenderError> {
        let learner = match (self.options.guide.clone(), &pass.guide) {
            (GuideChoice::Learn(learner), _) => Some(learner),
            (GuideChoice::Auto(chooser), Some(name)) => {
                let known = chooser.recall(name);
                Some(known.ok_or_else(|| RenderError::Option {
                    name: "replay",
                    value: format!("a pass of guide {name:?}"),
                    rule: "of guides that this version knows",
                })?)
            }
            _ => None,
        };
        if let Some(learner) = learner.filter(|_| pass.fit || self.current.guide.is_none()) {
            self.fit(learner.as_ref())?;
        }
        if let Some(a) = pass.a {
            self.current.uniform_fraction = a;
        }
        Ok(())
    }

    fn fit(&mut self, learner: &dyn Learner) -> Result<(), RenderError> {
        let seed = self.options.seed;
        let here = learner.on_callers_thread();
        let fit = self.learning(here, |records, report| learner.fit(records, seed, report))?;
        if let Some(fit) = fit {
            let a = learner.uniform_fraction();
            self.take(fit, learner, a)?;
        }
        Ok(())
    }

    fn choose(&mut self, chooser: &dyn Chooser, left: Left) -> Result<(), RenderError> {
        let seed = self.options.seed;
        let chosen = self.learning(false, |records, report| {
            chooser.choose(records, &left, seed, report)
        })?;
        let Some(chosen) = chosen else { return Ok(()) };
        self.current.candidates = chosen.candidates;
        match (chosen.learner, chosen.fit) {
            (Some(learner), Some(fit)) => self.take(fit, learner.as_ref(), chosen.uniform_fraction),
            (Some(learner), None) => {
                let before = self.current.seconds;
                self.fit(learner.as_ref())?;
                self.current.seconds += before;
                if self.options.uniform_fraction.is_none() {
                    self.current.uniform_fraction = chosen.uniform_fraction;
                }
                Ok(())
            }
            (None, _) => {
                self.current.guide = None;
                self.current.settled = self.records.len() >= ENOUGH_FOR_NONE;
                Ok(())
            }
        }
    }

    /// Uses a fitted guide from the next pass on.
    fn take(&mut self, fit: Fit, learner: &dyn Learner, a: f32) -> Result<(), RenderError> {
        self.check_dimensions(fit.guide.as_ref())?;
        let current = &mut self.current;
        current.training = serde_json::json!({
            "loss": fit.history,
            "seconds": fit.seconds,
            "dropped_nonfinite": fit.dropped_nonfinite,
            "outliers_removed": fit.outliers_removed,
            "trained_on": fit.trained_on,
            "samples": fit.samples,
            "guide": fit.guide.describe(),
        });
        current.guide = Some(Arc::from(fit.guide));
        current.name = learner.name().to_owned();
        current.uniform_fraction = self.options.uniform_fraction.unwrap_or(a);
        current.fresh = true;
        current.settled = !learner.refines();
        Ok(())
    }

    /// Runs something that learns, timed, among the render's threads or, where it must be, `here`. `None`, with the reason
    /// kept, where there is nothing to learn from or no time left; a guide learned earlier then stays.
    fn learning<T: Send>(
        &mut self,
        here: bool,
        work: impl FnOnce(&Records<'_>, &mut dyn FnMut(f32) -> bool) -> Result<T, GuideError> + Send,
    ) -> Result<Option<T>, RenderError> {
        let start = Instant::now();
        let deadline = match self.options.budget {
            Budget::Time(time) => time,
            _ => f64::INFINITY,
        };
        let (clock, progress) = (self.clock, self.context.progress);
        let mut late = false;
        let mut report = |done: f32| {
            progress.update(Phase::Fit, done);
            let now = clock.elapsed().as_secs_f64();
            let rest = start.elapsed().as_secs_f64() * (1.0 / f64::from(done) - 1.0);
            let hopeless = f64::from(done) >= ENOUGH_TO_TELL && rest > HOPELESS * (deadline - now);
            late = now > deadline || hopeless;
            !late && !progress.cancelled()
        };
        let dims = self.context.tracer.columns().learned();
        let records = self.records.view(dims, &self.emitters);
        let done = if here {
            work(&records, &mut report)
        } else {
            self.context.pool.install(|| work(&records, &mut report))
        };
        self.current.learned_from = self.next_sample;
        self.current.records = self.records.len();
        self.current.seconds = start.elapsed().as_secs_f64();
        self.seconds.fit += self.current.seconds;
        match done {
            Ok(done) => {
                self.current.refusal = None;
                Ok(Some(done))
            }
            Err(GuideError::Cancelled) if late => {
                self.current.settled = true;
                self.current.refusal =
                    Some("training did not end within the time; none is used".to_owned());
                Ok(None)
            }
            Err(GuideError::Cancelled) => Err(RenderError::Cancelled),
            // What diverged once would most likely do so again, and what it drew would be worthless.
            Err(e @ GuideError::Diverged { .. }) => {
                self.current.settled = true;
                let instead = match self.current.guide {
                    Some(_) => "the one learned before",
                    None => "none",
                };
                self.current.diverged = Some(format!("{e}; {instead} is used"));
                Ok(None)
            }
            Err(e @ GuideError::TooFewPaths { .. }) => {
                self.current.refusal = Some(format!("{e}; none is used"));
                Ok(None)
            }
            Err(e) => Err(e.into()),
        }
    }

    fn check_dimensions(&self, guide: &dyn Guide) -> Result<(), RenderError> {
        let expected = self.context.tracer.columns().learned();
        let whole_path = guide.models().contains(&Decision::Path);
        if whole_path && guide.dims() != expected {
            return Err(RenderError::Dimensions {
                name: guide.name().to_owned(),
                found: guide.dims(),
                expected,
                k: self.options.k,
                guide_k: guide.dims().saturating_sub(1) / 2,
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_guide_is_learned_however_many_paths_carry_light() {
        let mut current = Current::default();
        assert!(current.worth_learning(10_000_000, 1, 0.1));
        current.learned_from = 1;
        assert!(!current.worth_learning(10_000_000, 1, 0.1));
        assert!(current.worth_learning(10_000, 1, 1.0));
        current.seconds = 0.05;
        assert!(!current.worth_learning(10_000, 1, 1.0));
    }
}
