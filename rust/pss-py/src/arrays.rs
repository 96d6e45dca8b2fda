//! Numpy in and out. Everything that crosses is copied: no view outlives the GIL.

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pss_render::Array;
use pss_render::math::{Rgb, Vec3};
use pyo3::prelude::*;

use crate::errors;

/// A float32, uint8 or uint32 array, whatever its shape.
pub(crate) fn any(array: &Bound<'_, PyAny>, index: usize) -> PyResult<Array> {
    if let Ok(a) = array.extract::<PyReadonlyArrayDyn<'_, f32>>() {
        return Ok(Array::F32 {
            shape: a.shape().to_vec(),
            data: elements(&a),
        });
    }
    if let Ok(a) = array.extract::<PyReadonlyArrayDyn<'_, u32>>() {
        return Ok(Array::U32 {
            shape: a.shape().to_vec(),
            data: elements(&a),
        });
    }
    if let Ok(a) = array.extract::<PyReadonlyArrayDyn<'_, u8>>() {
        return Ok(Array::U8 {
            shape: a.shape().to_vec(),
            data: elements(&a),
        });
    }
    let found = match array.getattr("dtype") {
        Ok(dtype) => format!("an array of {dtype}"),
        Err(_) => array.get_type().to_string(),
    };
    Err(errors::value(format!(
        "arrays[{index}] is {found}, but must be a numpy array of float32, uint8 or uint32"
    )))
}

fn elements<T: numpy::Element + Copy>(a: &PyReadonlyArrayDyn<'_, T>) -> Vec<T> {
    // Room for what Embree wants behind an array that it reads in place.
    let mut owned = Vec::with_capacity(a.len() + 4);
    match a.as_slice() {
        Ok(slice) => owned.extend_from_slice(slice),
        Err(_) => owned.extend(a.as_array().iter().copied()),
    }
    owned
}

/// Rows of a matrix and their length.
pub(crate) fn matrix(a: &PyReadonlyArray2<'_, f32>) -> (Vec<f32>, usize) {
    let width = a.shape()[1];
    let data = match a.as_slice() {
        Ok(slice) => slice.to_vec(),
        Err(_) => a.as_array().iter().copied().collect(),
    };
    (data, width)
}

/// Rows of exactly `N` numbers.
pub(crate) fn rows<const N: usize>(
    a: &PyReadonlyArray2<'_, f32>,
    name: &str,
) -> PyResult<Vec<[f32; N]>> {
    if a.shape()[1] != N {
        return Err(errors::value(format!(
            "{name} has shape {:?}, expected (n, {N})",
            a.shape()
        )));
    }
    let (data, _) = matrix(a);
    Ok(data.as_chunks::<N>().0.to_vec())
}

/// Errors unless `found` rows are as many as `expected`.
pub(crate) fn same_rows(name: &str, found: usize, expected: usize) -> PyResult<()> {
    if found == expected {
        Ok(())
    } else {
        Err(errors::value(format!(
            "{name} has {found} rows, expected {expected}"
        )))
    }
}

/// A vector.
pub(crate) fn vector(a: &PyReadonlyArray1<'_, f32>) -> Vec<f32> {
    a.as_array().iter().copied().collect()
}

/// (n,) out.
pub(crate) fn to_vector<T: numpy::Element>(py: Python<'_>, data: Vec<T>) -> Py<PyAny> {
    PyArray1::from_vec(py, data).into_any().unbind()
}

/// (n, width) out.
pub(crate) fn to_matrix(py: Python<'_>, data: Vec<f32>, width: usize) -> PyResult<Py<PyAny>> {
    let rows = data.len() / width.max(1);
    Ok(PyArray1::from_vec(py, data)
        .reshape([rows, width])?
        .into_any()
        .unbind())
}

/// Counts as (n, width).
pub(crate) fn to_counts(py: Python<'_>, data: Vec<u32>, width: usize) -> PyResult<Py<PyAny>> {
    let rows = data.len() / width.max(1);
    Ok(PyArray1::from_vec(py, data)
        .reshape([rows, width])?
        .into_any()
        .unbind())
}

/// (n, a, b) out.
pub(crate) fn to_cube(py: Python<'_>, data: Vec<f32>, shape: [usize; 3]) -> PyResult<Py<PyAny>> {
    let array: Bound<'_, PyArray3<f32>> = PyArray1::from_vec(py, data).reshape(shape)?;
    Ok(array.into_any().unbind())
}

/// Colours or points as (n, 3).
pub(crate) fn to_rows3(py: Python<'_>, data: &[Vec3]) -> PyResult<Py<PyAny>> {
    to_matrix(py, flatten(data), 3)
}

/// (n, 3) numbers one after another.
pub(crate) fn flatten(data: &[Rgb]) -> Vec<f32> {
    data.iter().flat_map(|v| v.to_array()).collect()
}

/// Pairs as (n, 2).
pub(crate) fn to_rows2(py: Python<'_>, data: &[[f32; 2]]) -> PyResult<Py<PyAny>> {
    let array: Bound<'_, PyArray2<f32>> =
        PyArray1::from_vec(py, data.as_flattened().to_vec()).reshape([data.len(), 2])?;
    Ok(array.into_any().unbind())
}
