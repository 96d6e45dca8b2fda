//! What a render came to, as Python gets it.

use std::sync::Arc;

use pssflow::{Options, Outcome};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use serde_json::{Value, json};

use crate::arrays;
use crate::guide::Guide;

/// Arrays, the record and the guide, and the same for each snapshot; `foreign` is the object that drew, if one did.
pub(crate) fn to_dict<'py>(
    py: Python<'py>,
    mut outcome: Outcome,
    options: &Options,
    foreign: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let snapshots = PyList::empty(py);
    for snapshot in std::mem::take(&mut outcome.snapshots) {
        let dict = to_dict(py, snapshot.outcome, options, foreign)?;
        dict.set_item("time", snapshot.time)?;
        snapshots.append(dict)?;
    }
    let shape = [outcome.height as usize, outcome.width as usize, 3];
    let dict = PyDict::new(py);
    dict.set_item("record", record(&outcome, options).to_string())?;
    let guide = match (&outcome.guide, foreign) {
        (Some(_), Some(object)) => Some(object.clone().unbind()),
        (Some(inner), None) => {
            let inner = Arc::clone(inner);
            Some(Py::new(py, Guide { inner })?.into_any())
        }
        (None, _) => None,
    };
    dict.set_item("guide", guide)?;
    let film = outcome.film;
    dict.set_item("image", arrays::to_cube(py, film.image, shape)?)?;
    dict.set_item("variance", arrays::to_cube(py, film.variance, shape)?)?;
    dict.set_item("found", arrays::to_counts(py, film.found, shape[1])?)?;
    dict.set_item("nonzero", arrays::to_counts(py, film.nonzero, shape[1])?)?;
    dict.set_item("snapshots", snapshots)?;
    Ok(dict)
}

/// The record of a render: what was counted, chosen and timed.
fn record(outcome: &Outcome, options: &Options) -> Value {
    let mut record = json!(outcome.rendered.counts);
    let mut pilot = json!(outcome.pilot.counts);
    pilot["nonzero_share"] = json!(outcome.pilot.counts.nonzero_share());
    pilot["mean_square"] = json!(outcome.pilot.estimates().mean_square());
    let summary = json!({
        "chosen": outcome.chosen,
        "a": outcome.uniform_fraction,
        "k": options.k,
        "parametrisation": options.parametrisation.name(),
        "emitter_strategy": options.strategy.name(),
        "seed": options.seed,
        "survival": options.survival,
        "threads": outcome.threads,
        "nonzero_share": outcome.rendered.counts.nonzero_share(),
        "pilot": pilot,
        "mean": outcome.mean(),
        "variance": outcome.relative_variance(),
        "max_weight": outcome.in_image.max_weight,
        "max_contribution": outcome.in_image.max_contribution(),
        "ess": outcome.in_image.ess(),
        "diagnostics": outcome.diagnostics,
        "passes": outcome.passes,
        "combine": options.combine.name(),
        "candidates": outcome.candidates,
        "notes": outcome.notes,
        "training": outcome.training,
        "seconds": outcome.seconds,
        "elapsed": outcome.elapsed,
    });
    if let (Some(record), Value::Object(summary)) = (record.as_object_mut(), summary) {
        record.extend(summary);
    }
    record
}
