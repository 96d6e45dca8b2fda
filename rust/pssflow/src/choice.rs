//! Where the numbers come from: nothing, a guide at hand, one to learn, or whichever pays.

use std::sync::Arc;

use pss_guide::{Fit, Guide, GuideError, Records};

/// The mixture's share of uniform paths where neither the user nor the guide says one: robust for flows and nets.
pub(crate) const DEFAULT_UNIFORM_FRACTION: f32 = 0.25;

/// Something that turns recorded paths into a guide.
pub trait Learner: Send + Sync {
    /// The guide's name.
    fn name(&self) -> &str;

    /// Seconds of training that each path costs, roughly; 0 where it does not depend on their number.
    fn seconds_per_path(&self, _dims: usize) -> f64 {
        0.0
    }

    /// Whether it wants the vertices of the paths, and not only their numbers.
    fn looks_at_contexts(&self) -> bool {
        false
    }

    /// Whether a fit is so cheap that each pass's paths may refine the guide of the next; else it is fitted once.
    fn refines(&self) -> bool {
        false
    }

    /// The mixture's share of uniform paths that suits it when nothing is known of the scene.
    fn uniform_fraction(&self) -> f32 {
        DEFAULT_UNIFORM_FRACTION
    }

    /// Whether all its fits must be one thread's, the one that called the render, and not among the render's own.
    fn on_callers_thread(&self) -> bool {
        false
    }

    /// Learns. `progress` gets the share that is done and answers whether to go on.
    ///
    /// # Errors
    /// [`GuideError`]; the estimator passes it on, unless it means "too few paths", which ends in `none`.
    fn fit(
        &self,
        records: &Records<'_>,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError>;
}

/// What is left to do when a guide is chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Left {
    /// Paths still to be rendered, about, if they were uniform.
    pub paths: f64,
    /// Measured cost of a uniform path on one thread; `None` where the image must not depend on the machine.
    pub seconds_per_path: Option<f64>,
    /// Threads that render.
    pub threads: usize,
    /// Share of the paths so far that found all their vertices.
    pub found: f64,
}

/// What a chooser came to.
pub struct Chosen {
    /// The guide to use; `None` for uniform numbers.
    pub learner: Option<Arc<dyn Learner>>,
    /// The mixture's share of uniform paths.
    pub uniform_fraction: f32,
    /// Its guide, if it was fitted on the way: what `learner.fit` makes of the same records and seed, bit for bit.
    pub fit: Option<Fit>,
    /// What was considered and why it was taken or not: a list of objects, for the record.
    pub candidates: serde_json::Value,
}

/// Something that picks a guide, or none, from the paths so far.
pub trait Chooser: Send + Sync {
    /// Picks. The answer depends on the arguments alone.
    ///
    /// # Errors
    /// [`GuideError`], as for [`Learner::fit`].
    fn choose(
        &self,
        records: &Records<'_>,
        left: &Left,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Chosen, GuideError>;

    /// The learner of a name that it picked earlier, for a replay.
    fn recall(&self, name: &str) -> Option<Arc<dyn Learner>>;
}

/// A guide and the share of uniform paths that suits it.
pub type Learned = (Arc<dyn Guide>, f32);

/// Where the numbers come from.
#[derive(Clone)]
pub enum GuideChoice {
    /// Uniform numbers.
    None,
    /// A guide learned from the pilot, and refined by later passes where that is cheap.
    Learn(Arc<dyn Learner>),
    /// Whatever pays, chosen by a held-out part of the paths so far; chosen anew as they grow.
    Auto(Arc<dyn Chooser>),
    /// A guide learned before.
    Ready(Arc<dyn Guide>),
}

impl GuideChoice {
    /// Learns a guide and its share of uniform paths from paths that are at hand. What they weigh need not be radiance:
    /// of `f` and `f_bsdf` the guide lowers the second moment, whatever these are.
    ///
    /// `None` where there is nothing to learn, or too little to learn from.
    ///
    /// # Errors
    /// [`GuideError`] of the fits.
    pub fn learn(
        &self,
        records: &Records<'_>,
        left: &Left,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Option<Learned>, GuideError> {
        let learned = match self {
            Self::None | Self::Ready(_) => return Ok(None),
            Self::Learn(learner) => learner
                .fit(records, seed, progress)
                .map(|fit| Some((fit, learner.uniform_fraction()))),
            Self::Auto(chooser) => chooser.choose(records, left, seed, progress).and_then(|c| {
                let fit = match (c.fit, c.learner) {
                    (Some(fit), _) => Some(fit),
                    (None, Some(learner)) => Some(learner.fit(records, seed, progress)?),
                    (None, None) => None,
                };
                Ok(fit.map(|fit| (fit, c.uniform_fraction)))
            }),
        };
        match learned {
            Ok(learned) => Ok(learned.map(|(fit, a)| (Arc::from(fit.guide), a))),
            Err(GuideError::TooFewPaths { .. } | GuideError::Diverged { .. }) => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// Whether a pilot is needed.
    pub(crate) fn learns(&self) -> bool {
        matches!(self, Self::Learn(_) | Self::Auto(_))
    }

    /// Whether the passes after the pilot teach, too.
    pub(crate) fn refines(&self) -> bool {
        match self {
            Self::Learn(learner) => learner.refines(),
            Self::Auto(_) => true,
            Self::None | Self::Ready(_) => false,
        }
    }

    /// Whether the vertices of recorded paths are wanted.
    pub(crate) fn looks_at_contexts(&self) -> bool {
        match self {
            Self::Learn(learner) => learner.looks_at_contexts(),
            Self::Auto(_) => true,
            Self::None | Self::Ready(_) => false,
        }
    }
}
