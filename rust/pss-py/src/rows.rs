//! Paths to learn from, as Python gives them: a dictionary of arrays into [`Records`].

use numpy::{PyReadonlyArray1, PyReadonlyArray2};
use pss_guide::{Emitter, OwnedRecords, Records};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::{arrays, contexts, errors};

/// What [`Records`] borrows; see the stub of `Guide.fit` for names and shapes.
#[derive(Debug, Default)]
pub(crate) struct Rows {
    dims: usize,
    rows: OwnedRecords,
    emitters: Vec<Emitter>,
    zeros: u64,
}

impl Rows {
    /// Copies the arrays; what is missing or None is left out.
    pub(crate) fn of(dict: &Bound<'_, PyDict>) -> PyResult<Self> {
        let mut all = Self::default();
        let rows = &mut all.rows;
        let (mut vertices, mut has_f, mut has_u) = (None, false, false);
        for (key, value) in dict {
            if value.is_none() {
                continue;
            }
            let name: String = key.extract()?;
            match name.as_str() {
                "u" => {
                    (rows.u, all.dims) = arrays::matrix(&matrix(&name, &value)?);
                    has_u = true;
                }
                "f" => {
                    rows.f = vector(&name, &value)?;
                    has_f = true;
                }
                "f_max" => rows.f_max = vector(&name, &value)?,
                "f_bsdf" => rows.f_bsdf = vector(&name, &value)?,
                "g" => rows.g = vector(&name, &value)?,
                "g_bsdf" => rows.g_bsdf = vector(&name, &value)?,
                "g_both" => rows.g_both = vector(&name, &value)?,
                "ray" => rows.ray = arrays::rows::<2>(&matrix(&name, &value)?, &name)?,
                "pixel" => rows.pixel = arrays::rows::<2>(&matrix(&name, &value)?, &name)?,
                "contexts" => vertices = Some(value.cast_into::<PyDict>()?),
                "emitters" => all.emitters = contexts::emitters(value.extract()?),
                "zeros" => all.zeros = value.extract()?,
                _ => return Err(errors::value(format!("records[{name:?}] is unknown"))),
            }
        }
        if !(has_u && has_f) {
            return Err(errors::value("records lack `u` or `f`"));
        }
        let n = rows.f.len();
        arrays::same_rows("u", rows.u.len() / all.dims.max(1), n)?;
        if rows.f_max.is_empty() {
            rows.f_max.clone_from(&rows.f);
        }
        if rows.g.is_empty() {
            rows.g = vec![1.0; n];
        }
        if let Some(dict) = vertices {
            rows.contexts = contexts::contexts(&dict, n * (all.dims.saturating_sub(1) / 2))?;
        }
        for (name, found) in [
            ("f_max", rows.f_max.len()),
            ("f_bsdf", rows.f_bsdf.len()),
            ("g", rows.g.len()),
            ("g_bsdf", rows.g_bsdf.len()),
            ("g_both", rows.g_both.len()),
            ("ray", rows.ray.len()),
            ("pixel", rows.pixel.len()),
        ] {
            if found > 0 {
                arrays::same_rows(name, found, n)?;
            }
        }
        Ok(all)
    }

    /// Whether vertices were given.
    pub(crate) fn has_contexts(&self) -> bool {
        !self.rows.contexts.is_empty()
    }

    /// What a guide learns from.
    pub(crate) fn view(&self) -> Records<'_> {
        self.rows.view(self.dims, &self.emitters, self.zeros)
    }
}

fn vector(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<f32>> {
    let array: PyReadonlyArray1<'_, f32> = value.extract().map_err(|_| shape(name, "(n,)"))?;
    Ok(arrays::vector(&array))
}

fn matrix<'py>(name: &str, value: &Bound<'py, PyAny>) -> PyResult<PyReadonlyArray2<'py, f32>> {
    value.extract().map_err(|_| shape(name, "(n, d)"))
}

fn shape(name: &str, expected: &str) -> PyErr {
    errors::value(format!(
        "records[{name:?}]: expected a float32 array of shape {expected}"
    ))
}
