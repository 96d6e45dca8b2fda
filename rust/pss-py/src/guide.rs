//! `Guide`: a fitted density in Python.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::PyReadonlyArray2;
use pss_guide::{Context, Decision, Header, Recipe};
use pss_rng::{Purpose, Stream};
use pssflow::{Auto, GuideChoice, Named, Phase, Progress};
use pyo3::exceptions::PyMemoryError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::{Map, Value};

use crate::rows::Rows;
use crate::watch::{Shared, watched};
use crate::{arrays, contexts, errors};

/// A fitted density on the cube of primary numbers.
#[pyclass(module = "pssflow._core", frozen)]
#[derive(Debug)]
pub(crate) struct Guide {
    pub(crate) inner: Arc<dyn pss_guide::Guide>,
}

/// Rows that are drawn or evaluated before Python is asked for signals again.
const CHUNK: usize = 1 << 14;

#[pymethods]
impl Guide {
    /// Fits guide `name` to paths; see the stub.
    #[staticmethod]
    #[pyo3(signature = (name, records, *, options="{}", seed=0, progress=None))]
    fn fit(
        py: Python<'_>,
        name: &str,
        records: &Bound<'_, PyDict>,
        options: &str,
        seed: u64,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<Self> {
        let options = parse_options(options)?;
        let recipe = Recipe::parse(name, &options).map_err(errors::guide)?;
        let rows = Rows::of(records)?;
        if !rows.has_contexts() && recipe.looks_at_contexts() {
            return Err(errors::value(format!(
                "guide {name:?} looks at where paths are: give `contexts`, as `Pilot.fit` does"
            )));
        }
        let fit = watched(py, progress.as_ref(), |shared| {
            recipe.fit(&rows.view(), seed, &mut reporting(shared))
        })?
        .map_err(errors::guide)?;
        Ok(Self {
            inner: Arc::from(fit.guide),
        })
    }

    /// Learns as a render does, `auto` included; see the stub.
    #[staticmethod]
    #[pyo3(signature = (name, records, *, paths, found, options="{}", seed=0))]
    fn learn(
        py: Python<'_>,
        name: &str,
        records: &Bound<'_, PyDict>,
        paths: f64,
        found: f64,
        options: &str,
        seed: u64,
    ) -> PyResult<Option<(Self, f32)>> {
        let choice = choice(name, &parse_options(options)?)?;
        let rows = Rows::of(records)?;
        let left = pssflow::Left {
            paths,
            seconds_per_path: None,
            threads: 0,
            found,
        };
        let learned = watched(py, None, |shared| {
            choice.learn(&rows.view(), &left, seed, &mut reporting(shared))
        })?
        .map_err(errors::guide)?;
        let guide = |(guide, a)| (Self { inner: guide }, a);
        Ok(learned.map(guide))
    }

    /// Reads a guide; with both hashes it is refused for another scene or other columns.
    #[staticmethod]
    #[pyo3(signature = (path, columns_hash=None, scene_hash=None))]
    fn load(
        path: PathBuf,
        columns_hash: Option<String>,
        scene_hash: Option<String>,
    ) -> PyResult<Self> {
        let guide = match (columns_hash, scene_hash) {
            (Some(columns_hash), Some(scene_hash)) => pss_guide::load(
                &path,
                &Header {
                    columns_hash,
                    scene_hash,
                },
            ),
            _ => pss_guide::load_unchecked(&path).map(|(guide, _)| guide),
        };
        Ok(Self {
            inner: Arc::from(guide.map_err(errors::guide)?),
        })
    }

    /// Writes the guide with the hashes of the columns and the scene that it is for.
    fn save(&self, path: PathBuf, columns_hash: String, scene_hash: String) -> PyResult<()> {
        self.inner
            .save(
                &path,
                &Header {
                    columns_hash,
                    scene_hash,
                },
            )
            .map_err(errors::guide)
    }

    /// Draws rows of numbers of a decision, and their log-density.
    #[pyo3(signature = (n, seed=0, decision="path", contexts=None))]
    fn sample(
        &self,
        py: Python<'_>,
        n: usize,
        seed: u64,
        decision: &str,
        contexts: Option<Bound<'_, PyDict>>,
    ) -> PyResult<(Py<PyAny>, Py<PyAny>)> {
        let (decision, width) = self.asked(decision)?;
        let contexts = self.contexts(decision, contexts.as_ref(), n)?;
        let stream = Stream::new(seed, Purpose::Guide);
        let too_many =
            |_| PyMemoryError::new_err(format!("n = {n}: so many rows do not fit in memory"));
        let (mut u, mut log_q) = (Vec::new(), Vec::new());
        u.try_reserve_exact(n.saturating_mul(width))
            .map_err(too_many)?;
        log_q.try_reserve_exact(n).map_err(too_many)?;
        for start in (0..n).step_by(CHUNK) {
            py.check_signals()?;
            let rows = (n - start).min(CHUNK);
            let here = contexts.get(start..start + rows).unwrap_or_default();
            let (chunk, q) = py.detach(|| {
                let mut chunk = Vec::with_capacity(rows * width);
                for row in start..start + rows {
                    let mut numbers = stream.sequence(row as u32, (row as u64 >> 32) as u32);
                    chunk.extend((0..width).map(|_| numbers.next_f32()));
                }
                let mut q = vec![0.0; rows];
                self.inner.sample(decision, here, &mut chunk, &mut q);
                (chunk, q)
            });
            u.extend(chunk);
            log_q.extend(q.into_iter().map(f32::ln));
        }
        Ok((
            arrays::to_matrix(py, u, width)?,
            arrays::to_vector(py, log_q),
        ))
    }

    /// Log-density of rows of a decision's numbers; −∞ where they lie outside the cube and the guide has no mass there.
    #[pyo3(signature = (u, decision="path", contexts=None))]
    fn log_prob(
        &self,
        py: Python<'_>,
        u: PyReadonlyArray2<'_, f32>,
        decision: &str,
        contexts: Option<Bound<'_, PyDict>>,
    ) -> PyResult<Py<PyAny>> {
        let (decision, expected) = self.asked(decision)?;
        let (u, width) = arrays::matrix(&u);
        if width != expected {
            return Err(errors::value(format!(
                "u has {width} columns, but this decision has {expected}"
            )));
        }
        let rows = u.len() / width;
        let contexts = self.contexts(decision, contexts.as_ref(), rows)?;
        let mut log_q = Vec::with_capacity(rows);
        for (i, chunk) in u.chunks(CHUNK * width).enumerate() {
            py.check_signals()?;
            let mut q = vec![0.0; chunk.len() / width];
            let here = contexts
                .get(i * CHUNK..i * CHUNK + q.len())
                .unwrap_or_default();
            py.detach(|| self.inner.density(decision, here, chunk, &mut q));
            if decision != Decision::Path {
                // Guides are never asked beyond the cube, where their formulas go on; a flow's own space is larger.
                for (q, u) in q.iter_mut().zip(chunk.chunks_exact(width)) {
                    let inside = u.iter().all(|u| (0.0..1.0).contains(u));
                    *q = if inside { *q } else { 0.0 };
                }
            }
            log_q.extend(q.into_iter().map(f32::ln));
        }
        Ok(arrays::to_vector(py, log_q))
    }

    /// The cell of each of `n` places of a decision; −1 where the guide has none.
    fn cells(
        &self,
        py: Python<'_>,
        n: usize,
        decision: &str,
        contexts: Bound<'_, PyDict>,
    ) -> PyResult<Py<PyAny>> {
        let (decision, _) = self.asked(decision)?;
        let contexts = contexts::contexts(&contexts, n)?;
        let cell = |c| self.inner.cell(decision, c);
        let cells = contexts
            .iter()
            .map(|c| cell(c).and_then(|i| i64::try_from(i).ok()).unwrap_or(-1));
        Ok(arrays::to_vector(py, cells.collect::<Vec<i64>>()))
    }

    /// The decisions that it models.
    #[getter]
    fn models(&self) -> Vec<String> {
        let names = self.inner.models().iter();
        names
            .filter_map(|d| serde_json::to_value(d).ok()?.as_str().map(str::to_owned))
            .collect()
    }

    /// Name in the registry.
    #[getter]
    fn name(&self) -> &str {
        self.inner.name()
    }

    /// Numbers a row.
    #[getter]
    fn dims(&self) -> usize {
        self.inner.dims()
    }

    /// Trained parameters.
    #[getter]
    fn parameters(&self) -> usize {
        self.inner.parameters()
    }

    /// Estimated share of samples outside the cube.
    #[getter]
    fn mass_outside(&self) -> f64 {
        self.inner.mass_outside()
    }

    /// Configuration and facts, JSON.
    fn describe(&self) -> String {
        self.inner.describe().to_string()
    }

    fn __repr__(&self) -> String {
        format!("Guide({:?}, dims={})", self.inner.name(), self.inner.dims())
    }
}

impl Guide {
    /// A decision by its name, and how many numbers it takes.
    fn asked(&self, name: &str) -> PyResult<(Decision, usize)> {
        let decision = contexts::decision(name)?;
        if self.inner.models().contains(&decision) {
            return Ok((decision, contexts::width(decision, self.inner.dims())));
        }
        Err(errors::value(format!(
            "guide {:?} has no decision {name:?} (it has: {}); name one with `decision`",
            self.inner.name(),
            self.models().join(", ")
        )))
    }

    fn contexts(
        &self,
        decision: Decision,
        given: Option<&Bound<'_, PyDict>>,
        rows: usize,
    ) -> PyResult<Vec<Context>> {
        match given {
            Some(dict) => contexts::contexts(dict, rows),
            None if self.inner.looks_at_contexts(decision) => Err(errors::value(format!(
                "guide {:?} looks at where the decision is taken: give `contexts`, a row for each",
                self.inner.name()
            ))),
            None => Ok(Vec::new()),
        }
    }
}

/// A watcher as trainings report to it.
fn reporting(shared: &Shared) -> impl FnMut(f32) -> bool + '_ {
    |done| {
        shared.update(Phase::Fit, done);
        !shared.cancelled()
    }
}

/// A guide to learn, or `auto`, by its name.
pub(crate) fn choice(name: &str, options: &Map<String, Value>) -> PyResult<GuideChoice> {
    if name == "auto" {
        let auto = Auto::new().map_err(errors::guide)?;
        return Ok(GuideChoice::Auto(Arc::new(auto)));
    }
    let recipe = Recipe::parse(name, options).map_err(errors::guide)?;
    Ok(GuideChoice::Learn(Arc::new(Named::new(recipe))))
}

/// JSON options of a guide.
pub(crate) fn parse_options(options: &str) -> PyResult<Map<String, Value>> {
    serde_json::from_str(options).map_err(|e| {
        errors::value(format!(
            "guide options {options:?}: {e}; expected a JSON object"
        ))
    })
}

/// Names that stand for several guides, JSON: {name: guides joined by `+`}.
#[pyfunction]
pub(crate) fn guide_aliases() -> String {
    let pairs = pss_guide::ALIASES.iter();
    let map: Map<String, Value> = pairs
        .map(|&(alias, guides)| (alias.to_owned(), guides.into()))
        .collect();
    Value::from(map).to_string()
}

/// The registry, JSON.
#[pyfunction]
pub(crate) fn guides() -> String {
    let list: Vec<Value> = pss_guide::registry()
        .iter()
        .map(|g| {
            serde_json::json!({
                "name": g.name,
                "summary": g.summary,
                "options": (g.defaults)(),
            })
        })
        .collect();
    Value::from(list).to_string()
}
