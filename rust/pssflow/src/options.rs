//! What can be asked of a render.

use std::sync::Arc;

use pss_guide::{Fit, Guide, GuideError, Records};
use pss_render::{EmitterStrategy, Parametrisation};
use serde::{Deserialize, Serialize};

use crate::error::RenderError;

/// Something that turns pilot paths into a guide.
pub trait Learner: Send + Sync {
    /// The guide's name.
    fn name(&self) -> &str;

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

/// Where the numbers come from.
#[derive(Clone)]
pub enum GuideChoice {
    /// Uniform numbers.
    None,
    /// A guide learned from the pilot.
    Learn(Arc<dyn Learner>),
    /// A guide learned before.
    Ready(Arc<dyn Guide>),
}

/// How long to render.
#[derive(Clone, Debug, PartialEq)]
pub enum Budget {
    /// Samples per pixel in all, pilot inside.
    Spp(u32),
    /// Seconds for pilot, fit and render together.
    Time(f64),
    /// The passes of an earlier render, exactly.
    Replay(Vec<PassPlan>),
}

/// What a pass's paths are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PassKind {
    /// Uniform, kept for training.
    Pilot,
    /// From the mixture with the guide.
    Guided,
    /// Uniform.
    Uniform,
}

/// One pass over the image; a list of these is the record from which a render is replayed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PassPlan {
    /// What its paths are.
    pub kind: PassKind,
    /// Samples per pixel.
    pub spp: u32,
    /// Share of a pilot's light-carrying paths that is kept for training; chosen before the pass.
    #[serde(default = "all")]
    pub record: f32,
}

fn all() -> f32 {
    1.0
}

/// All options of a render.
#[derive(Clone)]
pub struct Options {
    /// Where the numbers come from.
    pub guide: GuideChoice,
    /// Bounces, 1 … 32.
    pub k: usize,
    /// What a direction's numbers mean.
    pub parametrisation: Parametrisation,
    /// How the light is joined.
    pub strategy: EmitterStrategy,
    /// How long to render.
    pub budget: Budget,
    /// Share of uniform paths in the mixture, in [0, 1].
    pub uniform_fraction: f32,
    /// Samples per pixel of the pilot; `None`: a quarter of `Spp`, or a seventh of `Time`.
    pub pilot_spp: Option<u32>,
    /// Whether the pilot enters the image.
    pub keep_pilot: bool,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Threads; 0 is one a core.
    pub threads: usize,
    /// Paths that carry light kept for training, at most; more are thinned at random.
    pub max_records: usize,
}

/// The mixture's share of uniform paths where the user gives none: the robust value for flows and nets.
pub(crate) const DEFAULT_UNIFORM_FRACTION: f32 = 0.25;

impl Default for Options {
    fn default() -> Self {
        Self {
            guide: GuideChoice::None,
            k: 2,
            parametrisation: Parametrisation::default(),
            strategy: EmitterStrategy::default(),
            budget: Budget::Spp(16),
            uniform_fraction: DEFAULT_UNIFORM_FRACTION,
            pilot_spp: None,
            keep_pilot: true,
            seed: 0,
            threads: 0,
            max_records: 2_000_000,
        }
    }
}

impl Options {
    /// Samples per pixel that no image can hold.
    const MOST_SPP: u32 = 1 << 24;

    pub(crate) fn check(&self) -> Result<(), RenderError> {
        let error = |name, value: String, rule| Err(RenderError::Option { name, value, rule });
        let a = self.uniform_fraction;
        if !(0.0..=1.0).contains(&a) {
            return error("uniform_fraction", a.to_string(), "in [0, 1]");
        }
        match &self.budget {
            Budget::Spp(spp) if !(1..=Self::MOST_SPP).contains(spp) => {
                return error("spp", spp.to_string(), "between 1 and 16777216");
            }
            Budget::Time(t) if !(t.is_finite() && *t > 0.0) => {
                return error("time", t.to_string(), "positive and finite (seconds)");
            }
            Budget::Replay(passes) if passes.is_empty() || passes.iter().any(|p| p.spp == 0) => {
                return error(
                    "replay",
                    format!("{passes:?}"),
                    "at least one pass, each of 1 spp or more",
                );
            }
            _ => {}
        }
        if self.pilot_spp == Some(0) && matches!(self.guide, GuideChoice::Learn(_)) {
            return error(
                "pilot_spp",
                "0".to_owned(),
                "at least 1 for a guide that learns",
            );
        }
        if let (GuideChoice::Learn(_), Budget::Spp(spp), pilot) =
            (&self.guide, &self.budget, self.pilot_spp)
        {
            let least = pilot.unwrap_or(1) + 1;
            if *spp < least {
                return error(
                    "spp",
                    spp.to_string(),
                    "more than the pilot's, since spp is the total and the guide needs a pass of its own",
                );
            }
        }
        Ok(())
    }
}
