//! Any Python object with `fit`, `sample` and `log_prob` as a guide.

use std::sync::{Arc, Mutex, PoisonError};

use numpy::{PyReadonlyArray1, PyReadonlyArray2};
use pss_guide::{Context, Decision, Fit, GuideError, Header, Records};
use pssflow::{Learner, Phase, Progress};
use pyo3::prelude::*;

use crate::arrays;
use crate::watch::Shared;

/// The object, and the first error that it raised.
#[derive(Clone)]
pub(crate) struct ForeignGuide {
    object: Arc<Py<PyAny>>,
    name: String,
    error: Arc<Mutex<Option<PyErr>>>,
    /// Columns of the render that asks.
    dims: usize,
}

impl std::fmt::Debug for ForeignGuide {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "ForeignGuide({})", self.name)
    }
}

impl ForeignGuide {
    pub(crate) fn new(object: &Bound<'_, PyAny>, dims: usize) -> PyResult<Self> {
        let name = object.get_type().name()?.to_string();
        for method in ["fit", "sample", "log_prob"] {
            if !object.hasattr(method)? {
                return Err(crate::errors::value(format!(
                    "guide={name}: it has no method {method:?}; a guide needs fit, sample and log_prob"
                )));
            }
        }
        Ok(Self {
            object: Arc::new(object.clone().unbind()),
            name,
            error: Arc::default(),
            dims,
        })
    }

    /// The first error that a method raised.
    pub(crate) fn take_error(&self) -> Option<PyErr> {
        self.error
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take()
    }

    fn keep(&self, error: PyErr) {
        let mut first = self.error.lock().unwrap_or_else(PoisonError::into_inner);
        first.get_or_insert(error);
    }

    fn failed(&self) -> bool {
        self.error
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .is_some()
    }

    fn draw(&self, u: &mut [f32], q: &mut [f32]) -> PyResult<()> {
        let (n, dims) = (q.len(), self.dims);
        // A seed made of the block's own uniform numbers: the same for any number of threads.
        let seed = u.iter().take(8).fold(0u64, |h, x| {
            (h ^ u64::from(x.to_bits())).wrapping_mul(0x0100_0000_01B3)
        }) >> 1;
        Python::attach(|py| {
            let drawn = self.object.call_method1(py, "sample", (n, seed))?;
            let (rows, log_q): (Bound<'_, PyAny>, Bound<'_, PyAny>) = drawn.extract(py)?;
            let rows = as_f32(&rows)?.extract::<PyReadonlyArray2<'_, f32>>()?;
            let (rows, width) = arrays::matrix(&rows);
            let log_q = vector(&log_q)?;
            if width != dims || rows.len() != n * dims || log_q.len() != n {
                return Err(crate::errors::value(format!(
                    "guide={}: sample({n}, seed) returned {} numbers of {width} columns and {} densities, \
                     expected ({n}, {dims}) and ({n},)",
                    self.name,
                    rows.len(),
                    log_q.len()
                )));
            }
            u.copy_from_slice(&rows);
            q.iter_mut().zip(log_q).for_each(|(q, l)| *q = l.exp());
            Ok(())
        })
    }

    fn evaluate(&self, u: &[f32], q: &mut [f32]) -> PyResult<()> {
        Python::attach(|py| {
            let rows = arrays::to_matrix(py, u.to_vec(), self.dims)?;
            let log_q = self.object.call_method1(py, "log_prob", (rows,))?;
            let log_q = vector(log_q.bind(py))?;
            if log_q.len() != q.len() {
                return Err(crate::errors::value(format!(
                    "guide={}: log_prob returned {} densities for {} rows",
                    self.name,
                    log_q.len(),
                    q.len()
                )));
            }
            q.iter_mut().zip(log_q).for_each(|(q, l)| *q = l.exp());
            Ok(())
        })
    }
}

/// A listener that also stops the render once the foreign guide has raised.
pub(crate) struct Guarded<'a> {
    pub(crate) progress: &'a Shared,
    pub(crate) guide: Option<&'a ForeignGuide>,
}

impl Progress for Guarded<'_> {
    fn update(&self, phase: Phase, done: f32) {
        self.progress.update(phase, done);
    }

    fn cancelled(&self) -> bool {
        self.progress.cancelled() || self.guide.is_some_and(ForeignGuide::failed)
    }
}

/// Other float types are welcome: `numpy.asarray(x, float32)`.
fn as_f32<'py>(x: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    x.py()
        .import("numpy")?
        .call_method1("asarray", (x, "float32"))
}

fn vector(x: &Bound<'_, PyAny>) -> PyResult<Vec<f32>> {
    Ok(arrays::vector(
        &as_f32(x)?.extract::<PyReadonlyArray1<'_, f32>>()?,
    ))
}

impl Learner for ForeignGuide {
    fn name(&self) -> &str {
        &self.name
    }

    // Python libraries may keep state by thread: all fits of a render are one thread's.
    fn on_callers_thread(&self) -> bool {
        true
    }

    fn fit(
        &self,
        records: &Records<'_>,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError> {
        let start = std::time::Instant::now();
        if records.f.len() < 2 {
            return Err(GuideError::TooFewPaths {
                usable: records.f.len(),
                given: records.f.len(),
                nonfinite: 0,
                zeros: records.zeros,
            });
        }
        progress(0.0);
        let done = Python::attach(|py| {
            let u = arrays::to_matrix(py, records.u.to_vec(), records.dims)?;
            let f = arrays::to_vector(py, records.f.to_vec());
            let g = arrays::to_vector(py, records.g.to_vec());
            self.object
                .call_method1(py, "fit", (u, f, g, records.zeros, seed))
                .map(drop)
        });
        if let Err(error) = done {
            self.keep(error);
        }
        // A failed fit stops the render; its caller then raises the error that was kept.
        if self.failed() || !progress(1.0) {
            return Err(GuideError::Cancelled);
        }
        Ok(Fit {
            guide: Box::new(self.clone()),
            history: Vec::new(),
            seconds: start.elapsed().as_secs_f64(),
            dropped_nonfinite: 0,
            outliers_removed: 0,
            trained_on: records.f.len(),
            samples: records.f.len(),
        })
    }
}

impl pss_guide::Guide for ForeignGuide {
    fn name(&self) -> &str {
        &self.name
    }

    fn models(&self) -> &[Decision] {
        &[Decision::Path]
    }

    fn dims(&self) -> usize {
        self.dims
    }

    fn sample(&self, _decision: Decision, _contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        q.fill(1.0);
        if self.failed() {
            return;
        }
        if let Err(error) = self.draw(u, q) {
            self.keep(error);
        }
    }

    fn density(&self, _decision: Decision, _contexts: &[Context], u: &[f32], q: &mut [f32]) {
        q.fill(1.0);
        if self.failed() {
            return;
        }
        if let Err(error) = self.evaluate(u, q) {
            self.keep(error);
        }
    }

    fn mass_outside(&self) -> f64 {
        f64::NAN
    }

    fn parameters(&self) -> usize {
        0
    }

    fn describe(&self) -> serde_json::Value {
        serde_json::json!({ "name": self.name, "foreign": true })
    }

    fn save(&self, path: &std::path::Path, _header: &Header) -> Result<(), GuideError> {
        let saved = Python::attach(|py| self.object.call_method1(py, "save", (path,)).map(drop));
        saved.map_err(|error| GuideError::Io {
            path: path.to_owned(),
            source: std::io::Error::other(error.to_string()),
        })
    }
}
