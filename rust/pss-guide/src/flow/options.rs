//! Options of the RealNVP guides.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::Domain;
use crate::GuideError;
use crate::options::{self, Condition};

/// Distribution of the base numbers z.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Prior {
    /// Standard normal on R^d.
    Gaussian,
    /// Uniform on [0, 1]^d: the thesis' failing experiment. A path mapped outside has density 0 and no
    /// gradient, so maximum likelihood pushes the paths out of the cube one by one. Kept to be shown.
    Hypercube,
}

/// Options of `realnvp` and `realnvp-logit`.
///
/// The thesis gives couplings, widths, masks, prior, optimiser, epochs and the resampling; learning rate,
/// batch, initial weights, the slope of LeakyReLU and the outlier quantile are ours.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RealNvpOptions {
    /// Affine couplings, 1 … 64. (Default: 8)
    pub couplings: usize,
    /// Units of a hidden layer, 1 … 512. (Default: 40)
    pub hidden: usize,
    /// Hidden layers of each of the two networks of a coupling, 1 … 8. (Default: 4)
    pub layers: usize,
    /// Base distribution. (Default: gaussian)
    pub prior: Prior,
    /// s = s_max · tanh(raw / s_max): a coupling stretches by at most e^s_max. In (0, 16].
    /// (Default: 1 for `realnvp`, which is the usual tanh; 4 for `realnvp-logit`)
    pub s_max: f64,
    /// Step of Adam, in (0, 1]. (Default: 1e-3)
    pub learning_rate: f64,
    /// Rows per step, 1 … 65,536. (Default: 256)
    pub batch: usize,
    /// Passes over the training set, 1 … 10,000. (Default: 7)
    pub epochs: usize,
    /// Rows of the training set, 2 … 2²⁴; `null`: as many as there are usable paths, at most 131,072.
    pub samples: Option<usize>,
    /// Paths brighter than this quantile of the largest RGB component are not learned from; in (0, 1],
    /// 1 keeps all. The estimate itself is not touched. (Default: 0.999)
    pub outlier_quantile: f64,
    /// What the networks look at beside the numbers that a coupling keeps (Zheng and Zwicker 2019). `realnvp` has no
    /// such option. (Default: none)
    #[serde(skip_serializing_if = "Option::is_none")]
    pub condition: Option<Condition>,
}

/// Largest training set that is used without being asked for.
const DEFAULT_SAMPLES: usize = 131_072;

impl RealNvpOptions {
    /// The defaults of one of the two guides.
    pub(crate) fn defaults(domain: Domain) -> Self {
        Self {
            couplings: 8,
            hidden: 40,
            layers: 4,
            prior: Prior::Gaussian,
            s_max: match domain {
                Domain::Cube => 1.0,
                Domain::Logit => 4.0,
            },
            learning_rate: 1e-3,
            batch: 256,
            epochs: 7,
            samples: None,
            outlier_quantile: 0.999,
            condition: match domain {
                Domain::Cube => None,
                Domain::Logit => Some(Condition::None),
            },
        }
    }

    /// `given` over the defaults, checked.
    pub(crate) fn parse(domain: Domain, given: &Map<String, Value>) -> Result<Self, GuideError> {
        let parsed = options::parse(domain.name(), &Self::defaults(domain), given)?;
        parsed.check(domain)?;
        Ok(parsed)
    }

    fn check(&self, domain: Domain) -> Result<(), GuideError> {
        let rules = options::Rules::new(domain.name(), self);
        rules.check(
            "couplings",
            (1..=64).contains(&self.couplings),
            "1 to 64 couplings",
        )?;
        rules.check("hidden", (1..=512).contains(&self.hidden), "1 to 512 units")?;
        rules.check(
            "layers",
            (1..=8).contains(&self.layers),
            "1 to 8 hidden layers",
        )?;
        rules.check(
            "s_max",
            options::positive(self.s_max, 16.0),
            "a number in (0, 16]",
        )?;
        rules.check(
            "learning_rate",
            options::positive(self.learning_rate, 1.0),
            "a number in (0, 1]",
        )?;
        rules.check(
            "batch",
            (1..=65_536).contains(&self.batch),
            "1 to 65536 rows",
        )?;
        rules.check(
            "epochs",
            (1..=10_000).contains(&self.epochs),
            "1 to 10000 epochs",
        )?;
        let samples = self.samples.unwrap_or(DEFAULT_SAMPLES);
        rules.check(
            "samples",
            (2..=1 << 24).contains(&samples),
            "2 to 16777216 rows, or null",
        )?;
        rules.check(
            "outlier_quantile",
            options::positive(self.outlier_quantile, 1.0),
            "a number in (0, 1]",
        )
    }

    /// Seconds of training that each path given costs on one core, roughly: a step forward and back is six
    /// operations a parameter and row, at the 32 GFLOP/s that `examples/guide_cost` shows for this size.
    /// 0 where the size of the training set is fixed by `samples`.
    pub(crate) fn seconds_per_path(&self, dims: usize) -> f64 {
        if self.samples.is_some() {
            return 0.0;
        }
        let network = self.hidden * (self.hidden * (self.layers - 1) + 2 * dims + self.known());
        let parameters = 2 * self.couplings * network;
        6.0 * (parameters * self.epochs) as f64 / 32e9
    }

    /// Numbers that are known of a path before it is drawn: two of the film position, or none.
    pub(super) fn known(&self) -> usize {
        match self.condition {
            Some(Condition::Pixel) => 2,
            Some(Condition::None) | None => 0,
        }
    }

    /// Rows of the training set drawn from `usable` paths.
    pub(crate) fn training_rows(&self, usable: usize) -> usize {
        self.samples.unwrap_or(usable.min(DEFAULT_SAMPLES))
    }
}
