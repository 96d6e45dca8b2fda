//! Options of the tables.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::cells::MOST_DEPTH;
use super::square::Square;
use crate::{GuideError, options};

/// Options of `direction-table`, `light-table` and `ray-table`. What is `null` follows the number of pilot paths.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TableOptions {
    /// Paths that the parent cell's distribution counts for, in (0, 10⁶]. (Default: 16 of a direction, 32 of a light's pair,
    /// 64 of the BSDF-sampled ray's)
    pub kappa: Option<f64>,
    /// Bins for each of the two numbers, 4, 8, 16 or 32; on area lights at most 8. (Default: 16, above 10⁶ paths 32)
    pub bins: Option<usize>,
    /// The finest grid has 2^depth cells per axis, 0 … 6. (Default: 4, above 2·10⁶ paths 5)
    pub depth: Option<usize>,
    /// Memory for the finished tables, 1 … 65,536 MiB: cells that few paths met give way. (Default: 256)
    pub memory_mib: usize,
    /// Paths count at most as much as this quantile of their f²/g, in (0, 1]; 1 clips none. The estimate itself is
    /// not touched. (Default: 0.999)
    pub clip_quantile: f64,
}

/// Options of `emitter-table`: those of [`TableOptions`] but for the bins, which are the emitters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EmitterTableOptions {
    /// As in [`TableOptions`]. (Default: 8)
    pub kappa: Option<f64>,
    /// As in [`TableOptions`].
    pub depth: Option<usize>,
    /// As in [`TableOptions`].
    pub memory_mib: usize,
    /// As in [`TableOptions`].
    pub clip_quantile: f64,
}

impl Default for TableOptions {
    fn default() -> Self {
        Self {
            kappa: None,
            bins: None,
            depth: None,
            memory_mib: options::MEMORY_MIB,
            clip_quantile: 0.999,
        }
    }
}

impl Default for EmitterTableOptions {
    fn default() -> Self {
        let TableOptions {
            kappa,
            depth,
            memory_mib,
            clip_quantile,
            ..
        } = TableOptions::default();
        Self {
            kappa,
            depth,
            memory_mib,
            clip_quantile,
        }
    }
}

impl TableOptions {
    /// `given` over the defaults, checked.
    pub(crate) fn parse(guide: &str, given: &Map<String, Value>) -> Result<Self, GuideError> {
        options::parse(guide, &Self::default(), given)?.checked(guide)
    }

    fn checked(self, guide: &str) -> Result<Self, GuideError> {
        let rules = options::Rules::new(guide, &self);
        rules.check(
            "kappa",
            self.kappa.is_none_or(|k| options::positive(k, 1e6)),
            "a number in (0, 1000000], or null",
        )?;
        rules.check(
            "bins",
            self.bins.is_none_or(|b| Square::BINS.contains(&b)),
            "4, 8, 16, 32 or null",
        )?;
        rules.check(
            "depth",
            self.depth.is_none_or(|d| d <= MOST_DEPTH),
            "0 to 6, or null",
        )?;
        rules.check(
            "memory_mib",
            (1..=65_536).contains(&self.memory_mib),
            "1 to 65536 MiB",
        )?;
        rules.check(
            "clip_quantile",
            options::positive(self.clip_quantile, 1.0),
            "a number in (0, 1]",
        )?;
        Ok(self)
    }

    /// Bins for a number of paths.
    pub(super) fn bins(&self, paths: f64) -> usize {
        self.bins.unwrap_or(if paths > 1e6 { 32 } else { 16 })
    }

    /// Depth of the grid for a number of paths.
    pub(super) fn depth(&self, paths: f64) -> usize {
        self.depth.unwrap_or(if paths > 2e6 { 5 } else { 4 })
    }
}

impl EmitterTableOptions {
    /// `given` over the defaults, checked.
    pub(crate) fn parse(guide: &str, given: &Map<String, Value>) -> Result<Self, GuideError> {
        let parsed: Self = options::parse(guide, &Self::default(), given)?;
        parsed.common().checked(guide)?;
        Ok(parsed)
    }

    /// The same with no word on bins.
    pub(super) fn common(&self) -> TableOptions {
        TableOptions {
            kappa: self.kappa,
            bins: None,
            depth: self.depth,
            memory_mib: self.memory_mib,
            clip_quantile: self.clip_quantile,
        }
    }
}
