//! Options of the nets.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::Kind;
use super::mixture::Mixture;
use super::model::Head;
use super::spline::Spline;
use crate::options::Rules;
use crate::{GuideError, options};

/// Rows that training looks at where nothing else is asked for: four thousand steps.
const USUAL_ROWS: usize = 1 << 21;

/// Most epochs that are made of few paths.
const MOST_EPOCHS: usize = 64;

/// Options of `mixture-net`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MixtureNetOptions {
    /// Normals of the mixture, 1 … 64. (Default: 8)
    pub components: usize,
    /// Network and training.
    #[serde(flatten)]
    pub net: NetOptions,
}

impl Default for MixtureNetOptions {
    fn default() -> Self {
        Self {
            components: 8,
            net: NetOptions::default(),
        }
    }
}

/// Options of `spline-net`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SplineNetOptions {
    /// Bins of each number's spline, 2 … 64. (Default: 8)
    pub bins: usize,
    /// Networks and training.
    #[serde(flatten)]
    pub net: NetOptions,
}

impl Default for SplineNetOptions {
    fn default() -> Self {
        Self {
            bins: 8,
            net: NetOptions::default(),
        }
    }
}

/// Options that all nets have.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NetOptions {
    /// Units of a hidden layer, 1 … 512. (Default: 32)
    pub hidden: usize,
    /// Hidden layers, 1 … 8. (Default: 2)
    pub layers: usize,
    /// First step of Adam, in (0, 1]; it falls to 0 as half a cosine. (Default: 5e-3)
    pub learning_rate: f64,
    /// Paths per step, 1 … 65,536. (Default: 512)
    pub batch: usize,
    /// Passes over the paths, 1 … 10,000; `null`: as many as show the network 2²¹ paths, at most 64.
    pub epochs: Option<usize>,
    /// Paths that are trained with, 2 … 2²⁴; of more, evenly spaced ones are taken. (Default: 524,288)
    pub max_rows: usize,
    /// Share a of uniform paths in the mixture whose second moment is the loss, in (0, 1]. (Default: 0.1)
    pub loss_fraction: f64,
    /// Paths count at most as much as this quantile of their f²/g, in (0, 1]; 1 clips none. The estimate itself is
    /// not touched. (Default: 0.999)
    pub clip_quantile: f64,
}

impl Default for NetOptions {
    fn default() -> Self {
        Self {
            hidden: 32,
            layers: 2,
            learning_rate: 5e-3,
            batch: 512,
            epochs: None,
            max_rows: 524_288,
            loss_fraction: 0.1,
            clip_quantile: 0.999,
        }
    }
}

impl NetOptions {
    fn check(&self, rules: &Rules<'_>) -> Result<(), GuideError> {
        rules.check("hidden", (1..=512).contains(&self.hidden), "1 to 512 units")?;
        rules.check(
            "layers",
            (1..=8).contains(&self.layers),
            "1 to 8 hidden layers",
        )?;
        rules.check(
            "learning_rate",
            options::positive(self.learning_rate, 1.0),
            "a number in (0, 1]",
        )?;
        rules.check(
            "batch",
            (1..=65_536).contains(&self.batch),
            "1 to 65536 paths",
        )?;
        rules.check(
            "epochs",
            self.epochs.is_none_or(|e| (1..=10_000).contains(&e)),
            "1 to 10000 epochs, or null",
        )?;
        rules.check(
            "max_rows",
            (2..=1 << 24).contains(&self.max_rows),
            "2 to 16777216 paths",
        )?;
        rules.check(
            "loss_fraction",
            options::positive(self.loss_fraction, 1.0),
            "a number in (0, 1]",
        )?;
        rules.check(
            "clip_quantile",
            options::positive(self.clip_quantile, 1.0),
            "a number in (0, 1]",
        )
    }

    /// Epochs over so many paths.
    pub(super) fn epochs(&self, rows: usize) -> usize {
        let usual = USUAL_ROWS.div_ceil(rows.max(1)).clamp(1, MOST_EPOCHS);
        self.epochs.unwrap_or(usual)
    }

    /// Paths, with repetitions, that a training on `rows` sees.
    pub(super) fn seen(&self, rows: usize) -> usize {
        let rows = rows.min(self.max_rows);
        self.epochs(rows).saturating_mul(rows)
    }
}

/// Checked options of either net.
#[derive(Clone, Debug)]
pub(super) struct Options {
    pub(super) head: Head,
    pub(super) net: NetOptions,
    /// All of them, as they are saved and shown.
    pub(super) map: Map<String, Value>,
}

impl Options {
    /// `given` over the defaults, checked.
    pub(super) fn parse(kind: Kind, given: &Map<String, Value>) -> Result<Self, GuideError> {
        match kind {
            Kind::Mixture => {
                let own: MixtureNetOptions = filled(kind, given)?;
                let components = own.components;
                let accepted = (1..=64).contains(&components);
                let rule = ("components", accepted, "1 to 64 components");
                let head = Head::Mixture(Mixture { components });
                Self::checked(kind, head, rule, &own, &own.net)
            }
            Kind::Spline => {
                let own: SplineNetOptions = filled(kind, given)?;
                let bins = own.bins;
                let rule = ("bins", (2..=64).contains(&bins), "2 to 64 bins");
                let head = Head::Spline(Spline { bins });
                Self::checked(kind, head, rule, &own, &own.net)
            }
        }
    }

    /// All options of one net, after the head's own rule and those that all nets have.
    fn checked<T: Serialize>(
        kind: Kind,
        head: Head,
        (name, accepted, rule): (&str, bool, &'static str),
        all: &T,
        net: &NetOptions,
    ) -> Result<Self, GuideError> {
        let rules = Rules::new(kind.name(), all);
        rules.check(name, accepted, rule)?;
        net.check(&rules)?;
        Ok(Self {
            head,
            net: net.clone(),
            map: options::to_map(all),
        })
    }

    /// Units of the layers of each network.
    pub(super) fn widths(&self) -> Vec<Vec<usize>> {
        self.head.widths(self.net.hidden, self.net.layers)
    }
}

fn filled<T: Default + Serialize + DeserializeOwned>(
    kind: Kind,
    given: &Map<String, Value>,
) -> Result<T, GuideError> {
    options::parse(kind.name(), &T::default(), given)
}
