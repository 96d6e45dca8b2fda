//! Tables: what paths of a place carried, counted, and used as the density of the numbers drawn there.
//!
//! Space is divided into cells, from all of it down to a fine grid by dominant normal (`cells`); every cell has a
//! histogram of f², shrunk towards that of the cell around it (`tree`), so that a cell which few paths met
//! still has a sensible one. Numbers are drawn in proportion to the root of the mean of f² (`square` for the two
//! numbers of a direction or of a position on a light, `line` for the emitter's). At run time a decision costs a hash look-up
//! and one or two searches in a few cache lines.
//!
//! Practical path guiding (Müller et al. 2017, doi:10.1111/cgf.13227) keeps radiance over directions in such
//! trees; here it is f² over the path's primary numbers, so that the BSDF is part of what is learnt.

mod bank;
pub(crate) mod cells;
mod line;
pub(crate) mod options;
mod square;
mod tree;

use rayon::prelude::*;
use serde_json::{Map, Value, json};

use self::bank::{Bank, Example, Plan, Squares};
use self::line::{Line, Lines};
use self::options::{EmitterTableOptions, TableOptions};
use self::square::Square;
use crate::file::Contents;
use crate::records::Clipped;
use crate::{Context, Decision, Fit, Guide, GuideError, Records, options as json_options};

/// Most bins on an area light: its image in the two numbers has few details.
const AREA_BINS: usize = 8;

/// Which numbers a table is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// The directions' pairs at x₁ … x_{k−1}; each bounce has its own cells, since what it is lit by has another
    /// number of bounces behind it, and each has as many paths to learn from as there are.
    Direction,
    /// The emitter's number.
    Emitter,
    /// The light's pair.
    Light,
    /// The pair of the BSDF-sampled ray at x_k.
    Ray,
}

impl Kind {
    /// Name in the registry.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Direction => "direction-table",
            Self::Emitter => "emitter-table",
            Self::Light => "light-table",
            Self::Ray => "ray-table",
        }
    }

    fn models(self) -> &'static [Decision] {
        match self {
            Self::Direction => &[Decision::Direction],
            Self::Emitter => &[Decision::Emitter],
            Self::Light => &[Decision::Light],
            Self::Ray => &[Decision::Ray],
        }
    }

    /// Paths that the parent cell's distribution counts for where no option says it (ARCHITECTURE.md tells why so many).
    const fn kappa(self) -> f64 {
        match self {
            Self::Direction => 16.0,
            Self::Emitter => 8.0,
            Self::Light => 32.0,
            Self::Ray => 64.0,
        }
    }

    /// Options with their defaults.
    pub(crate) fn defaults(self) -> Map<String, Value> {
        match self {
            Self::Emitter => json_options::to_map(&EmitterTableOptions::default()),
            _ => json_options::to_map(&TableOptions::default()),
        }
    }

    /// Checks options.
    pub(crate) fn validate(self, given: &Map<String, Value>) -> Result<(), GuideError> {
        self.parse(given).map(drop)
    }

    /// The options, and the same in the form in which they were given.
    fn parse(self, given: &Map<String, Value>) -> Result<(TableOptions, Value), GuideError> {
        if self == Self::Emitter {
            let options = EmitterTableOptions::parse(self.name(), given)?;
            let map = json_options::to_map(&options);
            return Ok((options.common(), map.into()));
        }
        let options = TableOptions::parse(self.name(), given)?;
        let map = json_options::to_map(&options);
        Ok((options, map.into()))
    }
}

/// The tables of each kind.
#[derive(Debug)]
enum Tables {
    /// Of a pair at a vertex; groups are bounces.
    Vertex(Bank<Squares>),
    Emitter(Bank<Lines>),
    Light(Lights),
}

/// Tables of the pairs on emitters; groups are emitters.
#[derive(Debug)]
struct Lights {
    area: Bank<Squares>,
    environment: Bank<Squares>,
    /// By emitter: whether its tables are among the environments'.
    surrounds: Vec<bool>,
}

impl Lights {
    /// The banks that hold tables, and whether of environments.
    fn banks(&self) -> impl Iterator<Item = (&Bank<Squares>, bool)> {
        let both = [(&self.area, false), (&self.environment, true)];
        both.into_iter().filter(|(bank, _)| bank.entries() > 0)
    }

    /// The group of a context in the bank of that side.
    #[inline]
    fn group(&self, context: &Context, environment: bool) -> Option<u32> {
        let around = self.surrounds.get(context.emitter as usize) == Some(&true);
        (around == environment).then_some(context.emitter)
    }
}

/// A table as a guide.
#[derive(Debug)]
pub(crate) struct TableGuide {
    kind: Kind,
    dims: usize,
    /// Options, what followed from the number of paths, and what was met.
    facts: Value,
    tables: Tables,
}

impl TableGuide {
    /// Fits a table; the `fit` of its registry lines. No number is drawn.
    pub(crate) fn fit(
        kind: Kind,
        given: &Map<String, Value>,
        records: &Records<'_>,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError> {
        let start = std::time::Instant::now();
        let (options, given) = kind.parse(given)?;
        let mut stage = |done: f32| progress(done).then_some(()).ok_or(GuideError::Cancelled);
        stage(0.0)?;
        let usable = records.usable(1.0)?;
        stage(0.1)?;
        let rows = Weighted::new(kind, records, &usable.rows, options.clip_quantile);
        stage(0.2)?;

        let paths = records.paths();
        let (kappa, depth) = (options.kappa.unwrap_or(kind.kappa()), options.depth(paths));
        let square = |bins| Square { bins, kappa };
        let plan = Plan {
            depth,
            oriented: true,
            pooled: true,
            memory: options.memory_mib << 20,
        };
        let line = Line::new(records.emitters.iter().map(|e| e.cdf), kappa);
        let examples = |leaf: &(dyn Fn(&[f32]) -> u32 + Sync)| rows.examples(kind, records, leaf);
        let pair = |square: Square| move |u: &[f32]| square.leaf([u[0], u[1]]);
        let mut rest = |done: f32| progress(0.25 + 0.74 * done);
        let tables = match kind {
            Kind::Direction | Kind::Ray => {
                let square = square(options.bins(paths));
                let examples = examples(&pair(square));
                Bank::<Squares>::fit(square, plan, &examples, &mut rest).map(Tables::Vertex)
            }
            Kind::Emitter => {
                let mut examples = examples(&|u| line.leaf(u[0]));
                if line.len() == 1 {
                    examples.clear(); // There is nothing to choose.
                }
                Bank::<Lines>::fit(&line, plan, &examples, &mut rest).map(Tables::Emitter)
            }
            Kind::Light => {
                let surrounds: Vec<bool> = records.emitters.iter().map(|e| e.environment).collect();
                let around = |e: &Example| surrounds.get(e.group as usize) == Some(&true);
                let bins = options.bins(paths);
                let parts = [(square(bins.min(AREA_BINS)), false), (square(bins), true)];
                let mut banks = Vec::new();
                for (i, (square, environment)) in parts.into_iter().enumerate() {
                    let mut own = examples(&pair(square));
                    own.retain(|e| around(e) == environment);
                    let used: usize = banks.iter().map(Bank::<Squares>::bytes).sum();
                    // However many lamps there are, a sky finds room.
                    let memory = if surrounds.contains(&true) && !environment {
                        plan.memory / 2
                    } else {
                        plan.memory.saturating_sub(used)
                    };
                    let plan = Plan {
                        oriented: environment,
                        pooled: false,
                        memory,
                        ..plan
                    };
                    let mut half = |done: f32| rest(0.5 * (i as f32 + done));
                    banks.extend(Bank::<Squares>::fit(square, plan, &own, &mut half));
                }
                let environment = banks.pop();
                let area = banks.pop();
                area.zip(environment).map(|(area, environment)| {
                    Tables::Light(Lights {
                        area,
                        environment,
                        surrounds,
                    })
                })
            }
        };
        let tables = tables.ok_or(GuideError::Cancelled)?;
        let facts = json!({
            "options": given,
            "kappa": kappa,
            "paths": paths,
            "clipped": rows.clipped,
        });
        progress(1.0).then_some(()).ok_or(GuideError::Cancelled)?;
        Ok(Fit {
            guide: Box::new(Self {
                kind,
                dims: records.dims,
                facts,
                tables,
            }),
            history: Vec::new(),
            seconds: start.elapsed().as_secs_f64(),
            dropped_nonfinite: usable.nonfinite,
            outliers_removed: 0,
            trained_on: usable.rows.len(),
            samples: usable.rows.len(),
        })
    }

    /// Rebuilds a table from a file.
    pub(crate) fn restore(kind: Kind, mut contents: Contents) -> Result<Box<dyn Guide>, String> {
        let number = |value: &Value, name: &str| {
            let number = value.as_u64().and_then(|n| usize::try_from(n).ok());
            number.ok_or_else(|| format!("its configuration has no `{name}`"))
        };
        let config = std::mem::take(&mut contents.config);
        let dims = number(&config["dims"], "dims")?;
        let bins = |i: usize| number(&config["bins"][i], "bins");
        let tables = match kind {
            Kind::Direction | Kind::Ray => {
                Tables::Vertex(Bank::<Squares>::restore("", bins(0)?, &mut contents)?)
            }
            Kind::Emitter => Tables::Emitter(Bank::<Lines>::restore("", &mut contents)?),
            Kind::Light => Tables::Light(Lights {
                area: Bank::<Squares>::restore("area.", bins(0)?, &mut contents)?,
                environment: Bank::<Squares>::restore("environment.", bins(1)?, &mut contents)?,
                surrounds: serde_json::from_value(config["environments"].clone())
                    .map_err(|e| format!("its configuration's `environments`: {e}"))?,
            }),
        };
        let reals = contents.tensors.first().map(|t| &t.0);
        if let Some(name) = reals.or(contents.words.first().map(|t| &t.0)) {
            return Err(format!("tensor {name:?} belongs to no table"));
        }
        Ok(Box::new(Self {
            kind,
            dims,
            facts: config["facts"].clone(),
            tables,
        }))
    }

    fn facts(&self) -> (Vec<(usize, usize, usize)>, usize, usize) {
        let squares = |banks: &[&Bank<Squares>]| {
            (
                banks.iter().map(|b| b.facts()).collect(),
                banks.iter().map(|b| b.entries()).sum(),
                banks.iter().map(|b| b.bytes()).sum(),
            )
        };
        match &self.tables {
            Tables::Vertex(bank) => squares(&[bank]),
            Tables::Light(lights) => squares(&[&lights.area, &lights.environment]),
            Tables::Emitter(bank) => (vec![bank.facts()], bank.entries(), bank.bytes()),
        }
    }
}

impl Guide for TableGuide {
    fn name(&self) -> &str {
        self.kind.name()
    }

    fn models(&self) -> &[Decision] {
        self.kind.models()
    }

    fn dims(&self) -> usize {
        self.dims
    }

    fn sample(&self, decision: Decision, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        q.fill(1.0);
        if !self.models().contains(&decision) {
            return;
        }
        match &self.tables {
            Tables::Vertex(bank) => {
                let pairs = u.as_chunks_mut::<2>().0;
                bank.sample(contexts, pairs, q, |c| Some(c.bounce));
            }
            Tables::Emitter(bank) => bank.sample(contexts, u, q),
            Tables::Light(lights) => {
                let pairs = u.as_chunks_mut::<2>().0;
                for (bank, environment) in lights.banks() {
                    bank.sample(contexts, pairs, q, |c| lights.group(c, environment));
                }
            }
        }
    }

    fn density(&self, decision: Decision, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        q.fill(1.0);
        if !self.models().contains(&decision) {
            return;
        }
        match &self.tables {
            Tables::Vertex(bank) => {
                let pairs = u.as_chunks::<2>().0;
                bank.density(contexts, pairs, q, |c| Some(c.bounce));
            }
            Tables::Emitter(bank) => bank.density(contexts, u, q),
            Tables::Light(lights) => {
                let pairs = u.as_chunks::<2>().0;
                for (bank, environment) in lights.banks() {
                    bank.density(contexts, pairs, q, |c| lights.group(c, environment));
                }
            }
        }
    }

    fn cell(&self, decision: Decision, context: &Context) -> Option<usize> {
        match &self.tables {
            _ if !self.models().contains(&decision) => None,
            Tables::Vertex(bank) => bank.find(context.bounce, context),
            Tables::Emitter(bank) => bank.find(0, context),
            Tables::Light(lights) => lights
                .banks()
                .find_map(|(bank, side)| bank.find(lights.group(context, side)?, context)),
        }
    }

    fn mass_outside(&self) -> f64 {
        0.0
    }

    fn parameters(&self) -> usize {
        self.facts().1
    }

    fn describe(&self) -> Value {
        let (banks, parameters, memory) = self.facts();
        json!({
            "name": self.name(),
            "models": self.models(),
            "dims": self.dims,
            "parameters": parameters,
            "memory": memory,
            "cells": banks.iter().map(|b| b.0).sum::<usize>(),
            "cells_per_axis": banks.iter().map(|b| b.1).max(),
            "fewest_rows": banks.iter().map(|b| b.2).max(),
            "kappa": self.facts["kappa"],
            "paths": self.facts["paths"],
            "clipped": self.facts["clipped"],
            "options": self.facts["options"],
        })
    }

    fn contents(&self) -> Option<Contents> {
        let mut contents = Contents {
            guide: self.name().to_owned(),
            config: json!({ "dims": self.dims, "facts": self.facts }),
            ..Contents::default()
        };
        match &self.tables {
            Tables::Vertex(bank) => {
                contents.config["bins"] = json!([bank.tables.bins]);
                bank.put("", &mut contents);
            }
            Tables::Emitter(bank) => bank.put("", &mut contents),
            Tables::Light(Lights {
                area,
                environment,
                surrounds,
            }) => {
                contents.config["bins"] = json!([area.tables.bins, environment.tables.bins]);
                contents.config["environments"] = json!(surrounds);
                area.put("area.", &mut contents);
                environment.put("environment.", &mut contents);
            }
        }
        Some(contents)
    }
}

/// Rows to learn from and their weights.
struct Weighted {
    rows: Vec<(usize, f32)>,
    clipped: usize,
}

impl Weighted {
    /// Weights are the estimates of ∫f² that the decision can change, clipped at a quantile, as shares of it.
    fn new(kind: Kind, records: &Records<'_>, usable: &[usize], clip: f64) -> Self {
        let weight = |row: usize| {
            let terms = records.terms(row);
            match kind {
                Kind::Direction => terms.square(),
                Kind::Emitter | Kind::Light => terms.nee_square(),
                Kind::Ray => terms.bsdf_square(),
            }
        };
        let clipped = Clipped::new(usable.iter().copied(), weight, clip);
        let share =
            |&(row, w): &(usize, f64)| (row, ((w / clipped.limit) as f32).max(f32::MIN_POSITIVE));
        Self {
            rows: clipped.rows.iter().map(share).collect(),
            clipped: clipped.count,
        }
    }

    fn examples(
        &self,
        kind: Kind,
        records: &Records<'_>,
        leaf: &(dyn Fn(&[f32]) -> u32 + Sync),
    ) -> Vec<Example> {
        let mut list = Vec::new();
        for (vertex, columns) in records.columns(kind.models()[0]) {
            let example = |&(row, weight): &(usize, f32)| {
                let context = records.context(row, vertex);
                let u = records.numbers(kind.models()[0], row, columns.clone());
                Example {
                    group: match kind {
                        Kind::Direction | Kind::Ray => context.bounce,
                        Kind::Emitter => 0,
                        Kind::Light => context.emitter,
                    },
                    position: context.position,
                    normal: context.normal,
                    leaf: leaf(u),
                    weight,
                }
            };
            list.par_extend(self.rows.par_iter().map(example));
        }
        list
    }
}
