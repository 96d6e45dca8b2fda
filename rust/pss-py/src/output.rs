//! Images on disk, from Python.

use std::collections::HashMap;
use std::path::PathBuf;

use numpy::{PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::{arrays, errors};

/// Channels (h, w) of an OpenEXR image by their full names.
#[pyfunction]
pub(crate) fn read_exr(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyDict>> {
    let read = py
        .detach(|| pssflow::output::read_exr(&path))
        .map_err(errors::render)?;
    let dict = PyDict::new(py);
    for (name, values) in read.values {
        dict.set_item(name, arrays::to_matrix(py, values, read.width)?)?;
    }
    Ok(dict)
}

/// Writes layers of (h, w, 3) values as OpenEXR.
#[pyfunction]
pub(crate) fn write_exr(
    path: PathBuf,
    layers: HashMap<String, PyReadonlyArray3<'_, f32>>,
) -> PyResult<()> {
    let mut size = None;
    let mut owned = Vec::new();
    for (name, array) in &layers {
        let shape = array.shape();
        if shape[2] != 3
            || shape[0] == 0
            || shape[1] == 0
            || *size.get_or_insert((shape[1], shape[0])) != (shape[1], shape[0])
        {
            return Err(errors::value(format!(
                "layer {name:?} has shape {shape:?}; all layers must be (height, width, 3) of one size"
            )));
        }
        owned.push((
            name.as_str(),
            array.as_array().iter().copied().collect::<Vec<f32>>(),
        ));
    }
    let Some((width, height)) = size else {
        return Err(errors::value(
            "layers is empty; give at least the image, under the key \"\"",
        ));
    };
    owned.sort_by_key(|(name, _)| *name);
    let slices: Vec<(&str, &[f32])> = owned.iter().map(|(n, v)| (*n, v.as_slice())).collect();
    pssflow::output::write_exr(&path, width as u32, height as u32, &slices).map_err(errors::render)
}
