//! Where decisions are taken, from Python: a dictionary of arrays into contexts.

use numpy::{PyReadonlyArray1, PyReadonlyArray2};
use pss_guide::{Context, Decision, Emitter};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::{arrays, errors};

/// One context a row from arrays by name: `position, normal, outgoing` (n, 3), `pixel` (n, 2), `emitter, bounce` (n,).
/// What is missing is zero; bounces count from 1.
pub(crate) fn contexts(dict: &Bound<'_, PyDict>, rows: usize) -> PyResult<Vec<Context>> {
    let mut contexts = vec![
        Context {
            bounce: 1,
            ..Context::default()
        };
        rows
    ];
    for (key, value) in dict {
        let name: String = key.extract()?;
        let shape = |expected: &str| {
            errors::value(format!(
                "contexts[{name:?}]: expected a float32 array of shape {expected}"
            ))
        };
        match name.as_str() {
            "position" | "normal" | "outgoing" => {
                let array: PyReadonlyArray2<'_, f32> =
                    value.extract().map_err(|_| shape("(n, 3)"))?;
                let values = arrays::rows::<3>(&array, &name)?;
                arrays::same_rows(&name, values.len(), rows)?;
                for (context, value) in contexts.iter_mut().zip(values) {
                    match name.as_str() {
                        "position" => context.position = value,
                        "normal" => context.normal = value,
                        _ => context.outgoing = value,
                    }
                }
            }
            "pixel" => {
                let array: PyReadonlyArray2<'_, f32> =
                    value.extract().map_err(|_| shape("(n, 2)"))?;
                let values = arrays::rows::<2>(&array, &name)?;
                arrays::same_rows(&name, values.len(), rows)?;
                contexts
                    .iter_mut()
                    .zip(values)
                    .for_each(|(c, v)| c.pixel = v);
            }
            "emitter" | "bounce" => {
                let expected = || {
                    errors::value(format!(
                        "contexts[{name:?}]: expected a uint32 array of shape (n,)"
                    ))
                };
                let array: PyReadonlyArray1<'_, u32> = value.extract().map_err(|_| expected())?;
                let values: Vec<u32> = array.as_array().iter().copied().collect();
                arrays::same_rows(&name, values.len(), rows)?;
                for (context, value) in contexts.iter_mut().zip(values) {
                    if name == "emitter" {
                        context.emitter = value;
                    } else {
                        context.bounce = value;
                    }
                }
            }
            _ => {
                return Err(errors::value(format!(
                    "contexts[{name:?}] is unknown (known: position, normal, outgoing, pixel, emitter, bounce)"
                )));
            }
        }
    }
    Ok(contexts)
}

/// Emitters from their intervals' upper ends and whether they surround the scene.
pub(crate) fn emitters(list: Vec<(f32, bool)>) -> Vec<Emitter> {
    list.into_iter()
        .map(|(cdf, environment)| Emitter { cdf, environment })
        .collect()
}

/// A decision by its name.
pub(crate) fn decision(name: &str) -> PyResult<Decision> {
    match name {
        "path" => Ok(Decision::Path),
        "direction" => Ok(Decision::Direction),
        "emitter" => Ok(Decision::Emitter),
        "light" => Ok(Decision::Light),
        "ray" => Ok(Decision::Ray),
        _ => Err(errors::value(format!(
            "decision {name:?} is unknown (known: path, direction, emitter, light, ray)"
        ))),
    }
}

/// How many numbers a decision takes.
pub(crate) fn width(decision: Decision, dims: usize) -> usize {
    match decision {
        Decision::Path => dims,
        Decision::Direction | Decision::Light | Decision::Ray => 2,
        Decision::Emitter => 1,
    }
}
