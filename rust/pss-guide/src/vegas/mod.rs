//! VEGAS: each number's own histogram (Lepage 1978, doi:10.1016/0021-9991(78)90004-9; with damping as in Lepage 2021,
//! doi:10.1016/j.jcp.2021.110386).
//!
//! The density is a product over the numbers of a path, each factor constant on bins that are narrow where f² is large
//! (`grid`, `fit`). It cannot know that the light stands elsewhere for another first direction, but it is cheap,
//! and a look-up costs a few nanoseconds a number. With the condition `pixel` each tile of the image has its own
//! probabilities of the shared bins, shrunk towards those of the whole image.

mod fit;
mod grid;
pub(crate) mod options;

use serde_json::{Map, Value, json};

use self::fit::Row;
use self::grid::Grid;
use self::options::VegasOptions;
use crate::file::{self, Contents};
use crate::records::Clipped;
use crate::{Context, Decision, Fit, Guide, GuideError, Records, options as json_options};

/// Name in the registry.
pub(crate) const NAME: &str = "vegas";

/// Numbers of a path, at most.
const MOST_DIMS: usize = 64;

/// The guide.
#[derive(Debug)]
pub(crate) struct Vegas {
    grid: Grid,
    /// Options, and what was met.
    facts: Value,
}

impl Vegas {
    /// Fits; no number is drawn.
    pub(crate) fn fit(
        given: &Map<String, Value>,
        records: &Records<'_>,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError> {
        let start = std::time::Instant::now();
        let options = VegasOptions::parse(given)?;
        if !(1..=MOST_DIMS).contains(&records.dims) {
            return Err(json_options::bad(
                NAME,
                "dims",
                &json!(records.dims),
                "1 to 64 numbers per path",
            ));
        }
        let mut stage = |done: f32| progress(done).then_some(()).ok_or(GuideError::Cancelled);
        stage(0.0)?;
        let usable = records.usable(1.0)?;
        stage(0.1)?;
        let square = |path: usize| records.terms(path).square();
        let weighted = Clipped::new(usable.rows.iter().copied(), square, options.clip_quantile);
        let empty = Grid::uniform(records.dims, options.bins, options.side());
        let row = |&(path, w): &(usize, f64)| Row {
            path,
            tile: empty.tile(&records.pixel(path)),
            weight: w / weighted.limit,
        };
        let mut rows: Vec<Row> = weighted.rows.iter().map(row).collect();
        let mut rest = |done: f32| progress(0.2 + 0.79 * done);
        let grid = fit::fit(&options, records, &mut rows, &mut rest);
        let grid = grid.ok_or(GuideError::Cancelled)?;
        progress(1.0).then_some(()).ok_or(GuideError::Cancelled)?;
        Ok(Fit {
            guide: Box::new(Self {
                grid,
                facts: json!({
                    "options": json_options::to_map(&options),
                    "paths": records.paths(),
                    "clipped": weighted.count,
                }),
            }),
            history: Vec::new(),
            seconds: start.elapsed().as_secs_f64(),
            dropped_nonfinite: usable.nonfinite,
            outliers_removed: 0,
            trained_on: usable.rows.len(),
            samples: usable.rows.len(),
        })
    }

    /// Rebuilds the guide from a file.
    pub(crate) fn restore(contents: Contents) -> Result<Box<dyn Guide>, String> {
        let number = |name: &str, most: usize| {
            let number = contents.config[name].as_u64();
            let number = number.and_then(|n| usize::try_from(n).ok());
            let number = number.filter(|n| (1..=most).contains(n));
            number.ok_or_else(|| format!("its configuration's `{name}` is not 1 to {most}"))
        };
        let (dims, bins, side) = (
            number("dims", MOST_DIMS)?,
            number("bins", 256)?,
            number("tiles", 64)?,
        );
        let shapes = [
            ("edges".to_owned(), vec![dims, bins + 1]),
            ("sums".to_owned(), vec![side * side, dims, bins + 1]),
        ];
        if !contents.words.is_empty() {
            return Err("it holds whole numbers".to_owned());
        }
        let mut tensors = file::take(contents.tensors, &shapes)?;
        let sums = tensors.pop().unwrap_or_default();
        let edges = tensors.pop().unwrap_or_default();
        let grid = Grid {
            dims,
            bins,
            side,
            edges,
            sums,
        };
        grid.check()?;
        Ok(Box::new(Self {
            grid,
            facts: contents.config["facts"].clone(),
        }))
    }
}

impl Guide for Vegas {
    fn name(&self) -> &str {
        NAME
    }

    fn models(&self) -> &[Decision] {
        &[Decision::Path]
    }

    fn dims(&self) -> usize {
        self.grid.dims
    }

    fn looks_at_contexts(&self, decision: Decision) -> bool {
        decision == Decision::Path && self.grid.side > 1
    }

    fn sample(&self, decision: Decision, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        if decision != Decision::Path {
            return q.fill(1.0);
        }
        for (i, (u, q)) in u.chunks_exact_mut(self.grid.dims).zip(q).enumerate() {
            let tile = contexts.get(i).map_or(0, |c| self.grid.tile(&c.pixel));
            *q = self.grid.sample(tile, u);
        }
    }

    fn density(&self, decision: Decision, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        if decision != Decision::Path {
            return q.fill(1.0);
        }
        for (i, (u, q)) in u.chunks_exact(self.grid.dims).zip(q).enumerate() {
            let tile = contexts.get(i).map_or(0, |c| self.grid.tile(&c.pixel));
            *q = self.grid.density(tile, u);
        }
    }

    fn cell(&self, decision: Decision, context: &Context) -> Option<usize> {
        (decision == Decision::Path).then(|| self.grid.tile(&context.pixel))
    }

    fn mass_outside(&self) -> f64 {
        0.0
    }

    fn parameters(&self) -> usize {
        self.grid.edges.len() + self.grid.sums.len()
    }

    fn describe(&self) -> Value {
        json!({
            "name": NAME,
            "models": self.models(),
            "dims": self.grid.dims,
            "parameters": self.parameters(),
            "memory": 4 * self.parameters(),
            "tiles": self.grid.side,
            "paths": self.facts["paths"],
            "clipped": self.facts["clipped"],
            "options": self.facts["options"],
        })
    }

    fn contents(&self) -> Option<Contents> {
        let Grid {
            dims, bins, side, ..
        } = self.grid;
        let edges = vec![dims, bins + 1];
        let sums = vec![side * side, dims, bins + 1];
        Some(Contents {
            guide: NAME.to_owned(),
            config: json!({ "dims": dims, "bins": bins, "tiles": side, "facts": self.facts }),
            tensors: vec![
                ("edges".to_owned(), edges, self.grid.edges.clone()),
                ("sums".to_owned(), sums, self.grid.sums.clone()),
            ],
            ..Contents::default()
        })
    }
}
