//! The one table from Rust errors to Python exceptions. Display, never Debug.

use std::io::ErrorKind;

use pss_guide::GuideError;
use pss_render::{SceneError, TraceError};
use pssflow::RenderError;
use pyo3::exceptions::{
    PyFileNotFoundError, PyKeyboardInterrupt, PyOSError, PyRuntimeError, PyValueError,
};
use pyo3::prelude::*;

/// A wrong argument that only the binding can see.
pub(crate) fn value(message: impl Into<String>) -> PyErr {
    PyValueError::new_err(message.into())
}

pub(crate) fn scene(e: SceneError) -> PyErr {
    match e {
        SceneError::Embree(_) => PyRuntimeError::new_err(e.to_string()),
        _ => PyValueError::new_err(e.to_string()),
    }
}

pub(crate) fn load(e: embree4::LoadError) -> PyErr {
    PyRuntimeError::new_err(e.to_string())
}

pub(crate) fn trace(e: TraceError) -> PyErr {
    PyValueError::new_err(e.to_string())
}

pub(crate) fn guide(e: GuideError) -> PyErr {
    match &e {
        GuideError::Io { source, .. } if source.kind() == ErrorKind::NotFound => {
            PyFileNotFoundError::new_err(e.to_string())
        }
        GuideError::Io { .. } => PyOSError::new_err(e.to_string()),
        GuideError::Diverged { .. } | GuideError::Tensor { .. } => {
            PyRuntimeError::new_err(e.to_string())
        }
        GuideError::Cancelled => PyKeyboardInterrupt::new_err(e.to_string()),
        _ => PyValueError::new_err(e.to_string()),
    }
}

pub(crate) fn render(e: RenderError) -> PyErr {
    match e {
        RenderError::Guide(e) => guide(e),
        RenderError::Cancelled => PyKeyboardInterrupt::new_err(e.to_string()),
        RenderError::Threads { .. } => PyRuntimeError::new_err(e.to_string()),
        RenderError::Write { .. } => PyOSError::new_err(e.to_string()),
        RenderError::Trace(_)
        | RenderError::Option { .. }
        | RenderError::Dimensions { .. }
        | RenderError::Read { .. } => PyValueError::new_err(e.to_string()),
    }
}
