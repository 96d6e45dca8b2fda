//! Options of `vegas`.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::NAME;
use crate::GuideError;
use crate::options::{self, Condition};

/// Options of `vegas`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VegasOptions {
    /// Bins of equal probability for each number, 2 … 256. (Default: 32)
    pub bins: usize,
    /// Lepage's α, in (0, 4]: how far an iteration moves the bins; lower is slower and steadier. (Default: 1)
    pub damping: f64,
    /// Iterations over the paths, 1 … 100. (Default: 5)
    pub iterations: usize,
    /// `none`: one density for the image. `pixel`: one a tile of it. (Default: pixel)
    pub condition: Condition,
    /// Tiles along each side of the image, 1 … 64, for the condition `pixel`. (Default: 8)
    pub tiles: usize,
    /// Paths that the density of the whole image counts for in a tile's, in (0, 10⁶]. (Default: 32)
    pub kappa: f64,
    /// Paths count at most as much as this quantile of their f²/g, in (0, 1]; 1 clips none. The estimate itself is
    /// not touched. (Default: 0.999)
    pub clip_quantile: f64,
}

impl Default for VegasOptions {
    fn default() -> Self {
        Self {
            bins: 32,
            damping: 1.0,
            iterations: 5,
            condition: Condition::Pixel,
            tiles: 8,
            kappa: 32.0,
            clip_quantile: 0.999,
        }
    }
}

impl VegasOptions {
    /// `given` over the defaults, checked.
    pub(crate) fn parse(given: &Map<String, Value>) -> Result<Self, GuideError> {
        let parsed = options::parse(NAME, &Self::default(), given)?;
        let rules = options::Rules::new(NAME, &parsed);
        rules.check("bins", (2..=256).contains(&parsed.bins), "2 to 256 bins")?;
        rules.check(
            "damping",
            options::positive(parsed.damping, 4.0),
            "a number in (0, 4]",
        )?;
        rules.check(
            "iterations",
            (1..=100).contains(&parsed.iterations),
            "1 to 100 iterations",
        )?;
        rules.check("tiles", (1..=64).contains(&parsed.tiles), "1 to 64 tiles")?;
        rules.check(
            "kappa",
            options::positive(parsed.kappa, 1e6),
            "a number in (0, 1000000]",
        )?;
        rules.check(
            "clip_quantile",
            options::positive(parsed.clip_quantile, 1.0),
            "a number in (0, 1]",
        )?;
        Ok(parsed)
    }

    /// Tiles along each side; 1 where the film position is not looked at.
    pub(super) fn side(&self) -> usize {
        match self.condition {
            Condition::None => 1,
            Condition::Pixel => self.tiles,
        }
    }
}
