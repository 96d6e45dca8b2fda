//! What can be asked of a render.

use pss_render::{EmitterStrategy, Parametrisation};
use serde::{Deserialize, Serialize};

use crate::choice::GuideChoice;
use crate::error::RenderError;

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

/// What a sample of the pilot counts in the image beside one of a later pass. Fixed, since a weight that looked at the
/// samples would bias the image. Where the guide's paths have 1/G of the variance of a pilot's and the pilot is a share s
/// of all, the image gains (1 − s + s/2)² ÷ ((1 − s)/G + s/4) over uniform numbers: with s = ⅛, at most 28 in place of 8,
/// and where nothing is learned 3 % are lost.
pub(crate) const PILOT_WEIGHT: f64 = 0.5;

/// How passes become one image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Combine {
    /// A sample of the pilot counts half, all others the same. These weights are fixed before sampling, so with a number
    /// of samples the image is unbiased; with a time, what a pass came to may decide how many follow, a bias of the order
    /// of 1 ÷ their number.
    #[default]
    Samples,
    /// Each pass's samples count with 1 ÷ their variance, one number for the whole image, estimated for each half of
    /// a checkerboard of tiles from the other half. Its bias is of the order of 1 ÷ the samples of the passes.
    Variance,
}

impl Combine {
    /// The name used in options and records.
    pub fn name(self) -> &'static str {
        match self {
            Self::Samples => "samples",
            Self::Variance => "variance",
        }
    }

    /// What a sample of such a pass counts, as far as that is known before it is drawn.
    pub(crate) fn weight(self, kind: PassKind) -> f64 {
        match (self, kind) {
            (Self::Samples, PassKind::Pilot) => PILOT_WEIGHT,
            _ => 1.0,
        }
    }
}

/// One pass over the image; a list of these is the record from which a render is replayed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PassPlan {
    /// What its paths are.
    pub kind: PassKind,
    /// Samples per pixel.
    pub spp: u32,
    /// Share of the light-carrying paths that is kept for training; chosen before the pass.
    #[serde(default = "all")]
    pub record: f32,
    /// Guided: what drew it, by the name of its recipe.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guide: Option<String>,
    /// Guided: the mixture's share of uniform paths.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub a: Option<f32>,
    /// Guided: whether the guide was fitted anew, to all paths kept so far, before this pass.
    #[serde(default)]
    pub fit: bool,
}

fn all() -> f32 {
    1.0
}

/// All options of a render.
#[derive(Clone)]
pub struct Options {
    /// Where the numbers come from.
    pub guide: GuideChoice,
    /// Bounces, 1 … 32; 0 for emitters that the camera sees, where there is nothing to guide.
    pub k: usize,
    /// What a direction's numbers mean.
    pub parametrisation: Parametrisation,
    /// How the light is joined.
    pub strategy: EmitterStrategy,
    /// How long to render.
    pub budget: Budget,
    /// Shorter times of a [`Budget::Time`], increasing, at which the image so far is handed out.
    pub snapshots: Vec<f64>,
    /// Probability that a path is traced at all, in (0, 1]: Russian roulette before its first ray. A path that it ends
    /// counts in the image, as black, and in nothing else; all others count 1 ÷ this.
    pub survival: f32,
    /// Share of uniform paths in the mixture, in [0, 1]; `None`: the guide's own, or what a chooser found best.
    pub uniform_fraction: Option<f32>,
    /// Samples per pixel of the pilot; `None`: for a guide that is refined from pass to pass a thirty-second of `Spp`, or of
    /// `Time` a fortieth to a tenth, until 65,536 paths carry light; a quarter or a seventh for one that is trained once.
    pub pilot_spp: Option<u32>,
    /// Whether the pilot enters the image.
    pub keep_pilot: bool,
    /// How passes become one image.
    pub combine: Combine,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Threads; 0 is one a core.
    pub threads: usize,
    /// Paths that carry light kept for training, at most: older ones give way to those of the last pass, which may be
    /// half of all where more passes are to teach. A replay needs the number of the render that it repeats.
    pub max_records: usize,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            guide: GuideChoice::None,
            k: 2,
            parametrisation: Parametrisation::default(),
            strategy: EmitterStrategy::default(),
            budget: Budget::Spp(16),
            snapshots: Vec::new(),
            survival: 1.0,
            uniform_fraction: None,
            pilot_spp: None,
            keep_pilot: true,
            combine: Combine::Samples,
            seed: 0,
            threads: 0,
            max_records: 2_000_000,
        }
    }
}

impl Options {
    /// Samples per pixel beyond which single-precision numbers have nothing new to say.
    pub(crate) const MOST_SPP: u32 = 1 << 24;

    pub(crate) fn check(&self) -> Result<(), RenderError> {
        let error = |name, value: String, rule| Err(RenderError::Option { name, value, rule });
        if let Some(a) = self.uniform_fraction.filter(|a| !(0.0..=1.0).contains(a)) {
            return error("uniform_fraction", a.to_string(), "in [0, 1]");
        }
        if !(self.survival > 0.0 && self.survival <= 1.0) {
            return error("survival", self.survival.to_string(), "in (0, 1]");
        }
        if self.k == 0 && !matches!(self.guide, GuideChoice::None) {
            return error("k", "0".to_owned(), "1 or more with a guide");
        }
        match &self.budget {
            Budget::Spp(spp) if !(1..=Self::MOST_SPP).contains(spp) => {
                return error("spp", spp.to_string(), "between 1 and 16777216");
            }
            Budget::Time(t) if !(t.is_finite() && *t > 0.0) => {
                return error("time", t.to_string(), "positive and finite (seconds)");
            }
            Budget::Replay(passes) => self.check_replay(passes)?,
            _ => {}
        }
        self.check_snapshots()?;
        let pilot = self.pilot_spp.unwrap_or(1);
        if self.guide.learns() && !(1..=Self::MOST_SPP).contains(&pilot) {
            return error(
                "pilot_spp",
                pilot.to_string(),
                "between 1 and 16777216 for a guide that learns",
            );
        }
        let needs_more = match self.guide {
            GuideChoice::Learn(_) => true,
            GuideChoice::Auto(_) => !self.keep_pilot,
            GuideChoice::None | GuideChoice::Ready(_) => false,
        };
        if let Budget::Spp(spp) = &self.budget
            && needs_more
            && *spp <= pilot
        {
            return error(
                "spp",
                spp.to_string(),
                "more than the pilot's, since spp is the total and the image needs a pass of its own",
            );
        }
        Ok(())
    }

    fn check_snapshots(&self) -> Result<(), RenderError> {
        let Some(last) = self.snapshots.last() else {
            return Ok(());
        };
        let rule = match self.budget {
            Budget::Time(time) => {
                let increase = self.snapshots.windows(2).all(|pair| pair[0] < pair[1]);
                if increase && self.snapshots[0] > 0.0 && *last < time {
                    return Ok(());
                }
                "positive, increasing and below time"
            }
            _ => "left out without a time",
        };
        Err(RenderError::Option {
            name: "snapshots",
            value: format!("{:?}", self.snapshots),
            rule,
        })
    }

    fn check_replay(&self, passes: &[PassPlan]) -> Result<(), RenderError> {
        let error = |value: String, rule| {
            Err(RenderError::Option {
                name: "replay",
                value,
                rule,
            })
        };
        let total: u64 = passes.iter().map(|p| u64::from(p.spp)).sum();
        if passes.iter().any(|p| p.spp == 0) || !(1..=u64::from(Self::MOST_SPP)).contains(&total) {
            return error(
                format!("{} passes of {total} spp together", passes.len()),
                "at least one pass, each of 1 spp or more, and 16777216 spp at most together",
            );
        }
        if let Some(p) = passes.iter().find(|p| !(0.0..=1.0).contains(&p.record)) {
            return error(
                format!("a pass with record {}", p.record),
                "passes whose record lies in [0, 1]",
            );
        }
        if let Some(a) = passes
            .iter()
            .filter_map(|p| p.a)
            .find(|a| !(0.0..=1.0).contains(a))
        {
            return error(
                format!("a pass with a = {a}"),
                "passes whose a lies in [0, 1]",
            );
        }
        let guided = passes.iter().any(|p| p.kind == PassKind::Guided);
        if guided && matches!(self.guide, GuideChoice::None) {
            return error(
                "guided passes without a guide".to_owned(),
                "given together with the guide of the recorded render",
            );
        }
        Ok(())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::sync::Arc;

    use pss_guide::{Fit, GuideError, Records};

    use super::*;
    use crate::choice::Learner;

    struct Idle;

    impl Learner for Idle {
        fn name(&self) -> &str {
            "idle"
        }

        fn fit(
            &self,
            _records: &Records<'_>,
            _seed: u64,
            _progress: &mut dyn FnMut(f32) -> bool,
        ) -> Result<Fit, GuideError> {
            Err(GuideError::Cancelled)
        }
    }

    fn refusal(guide: GuideChoice, budget: Budget, pilot_spp: Option<u32>) -> String {
        let options = Options {
            guide,
            budget,
            pilot_spp,
            ..Options::default()
        };
        options.check().unwrap_err().to_string()
    }

    fn pass(kind: PassKind, spp: u32, record: f32) -> PassPlan {
        PassPlan {
            kind,
            spp,
            record,
            guide: None,
            a: None,
            fit: false,
        }
    }

    #[test]
    fn sample_counts_beyond_all_bounds_are_refused() {
        let learn = || GuideChoice::Learn(Arc::new(Idle));
        for pilot in [0, u32::MAX] {
            for budget in [Budget::Spp(16), Budget::Time(1.0)] {
                let message = refusal(learn(), budget, Some(pilot));
                assert!(message.starts_with("pilot_spp = "), "{message}");
            }
        }
        let message = refusal(learn(), Budget::Spp(4), Some(4));
        assert!(message.starts_with("spp = 4: must be more"), "{message}");
        let message = refusal(GuideChoice::None, Budget::Spp(u32::MAX), None);
        assert!(message.starts_with("spp = 4294967295"), "{message}");
    }

    #[test]
    fn snapshots_that_cannot_be_taken_are_refused() {
        for (budget, snapshots, rule) in [
            (Budget::Spp(4), vec![1.0], "left out without a time"),
            (Budget::Time(2.0), vec![1.0, 1.0], "increasing"),
            (Budget::Time(2.0), vec![0.0], "positive"),
            (Budget::Time(2.0), vec![1.0, 2.0], "below time"),
            (Budget::Time(2.0), vec![f64::NAN], "positive"),
        ] {
            let options = Options {
                budget,
                snapshots,
                ..Options::default()
            };
            let message = options.check().unwrap_err().to_string();
            assert!(
                message.starts_with("snapshots = [") && message.contains(rule),
                "{message}"
            );
        }
    }

    #[test]
    fn a_replay_that_cannot_be_repeated_is_refused() {
        let uniform = |spp| pass(PassKind::Uniform, spp, 1.0);
        for (passes, start) in [
            (vec![], "replay = 0 passes of 0 spp together: must be"),
            (vec![uniform(1), uniform(0)], "replay = 2 passes of 1 spp"),
            (
                vec![uniform(u32::MAX); 2],
                "replay = 2 passes of 8589934590 spp",
            ),
            (
                vec![pass(PassKind::Pilot, 1, -0.5)],
                "replay = a pass with record -0.5",
            ),
            (
                vec![pass(PassKind::Guided, 1, 1.0)],
                "replay = guided passes without a guide",
            ),
        ] {
            let message = refusal(GuideChoice::None, Budget::Replay(passes), None);
            assert!(message.starts_with(start), "{message}");
        }
    }
}
