//! The extension module `pssflow._core`: array checks, release of the GIL, one table of errors. No formula.
//!
//! Types and documentation for Python are in `python/pssflow/_core.pyi`.

mod arrays;
mod contexts;
mod drawn;
mod errors;
mod foreign;
mod guide;
mod outcome;
mod output;
mod parity;
mod rows;
mod scene;
mod watch;

use pyo3::prelude::*;

// glibc's malloc hands big batches back to the system after each use, and the page faults cost more than
// the arithmetic.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// The Rust core of pssflow.
#[pymodule]
mod _core {
    #[pymodule_export]
    use super::guide::{Guide, guide_aliases, guides};
    #[pymodule_export]
    use super::output::{read_exr, write_exr};
    #[pymodule_export]
    use super::scene::{Scene, last_probed};

    use pyo3::prelude::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
