//! Densities on the unit cube: flows, their training and their files.
//!
//! A path is a function f of d primary numbers u ∈ [0, 1)^d. A *guide* is a density q on the cube that is
//! large where f is large; ∫ f du is then estimated by the mean of f(u)/q(u), u ~ q (learned q on the
//! primary sample space: Zheng and Zwicker 2019, doi:10.1111/cgf.13628).
//!
//! ```text
//! pilot paths ─► Records ─► fit(name, options, …) ─► Box<dyn Guide> ─► sample / density   (this crate)
//!                                                        └──────────► save ─► load
//! ```
//!
//! Start reading at [`Guide`]; a guide is made by [`fit`], which looks its name up in [`registry()`].
//! All densities are with respect to the uniform measure on the cube. This crate knows no rays, no film
//! and no Python, reads no environment variable but `PSSFLOW_ISA` ([`isa`]), and draws random numbers for training only: a sample is
//! made from the caller's uniform numbers, in place.

mod composite;
mod error;
mod file;
mod flow;
mod kernel;
mod net;
mod normal;
mod options;
mod predict;
mod recipe;
mod records;
mod registry;
mod select;
mod table;
mod vegas;

use std::path::Path;

use serde::{Deserialize, Serialize};

pub use error::GuideError;
pub use file::{Contents, FORMAT_VERSION, load, load_unchecked};
pub use flow::options::{Prior, RealNvpOptions};
pub use kernel::isa;
pub use net::options::{MixtureNetOptions, NetOptions, SplineNetOptions};
pub use options::Condition;
pub use recipe::{ALIASES, Recipe};
pub use records::{Emitter, OwnedRecords, Records};
pub use registry::{FitFn, GuideSpec, find, fit, registry};
pub use select::{CandidateReport, Remaining, Selection, candidates, recall, select};
pub use table::options::{EmitterTableOptions, TableOptions};
pub use vegas::options::VegasOptions;

/// What a number of a path decides; a guide models some of these.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Decision {
    /// All learned columns of a path at once, before anything is traced.
    Path,
    /// The two numbers of a direction at a vertex.
    Direction,
    /// The number that chooses an emitter.
    Emitter,
    /// The two numbers of a position on the emitter.
    Light,
    /// The two numbers of the BSDF-sampled ray at the last vertex, where light is looked for that way, too.
    Ray,
}

/// What is known where a decision is taken; fields that a decision does not have are zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Context {
    /// Vertex in world space.
    pub position: [f32; 3],
    /// Unit shading normal there.
    pub normal: [f32; 3],
    /// Unit direction towards the previous vertex.
    pub outgoing: [f32; 3],
    /// Film position in [0, 1)²; of decision [`Decision::Path`] all that is known.
    pub pixel: [f32; 2],
    /// Index of the chosen emitter (decision [`Decision::Light`]).
    pub emitter: u32,
    /// Number of the vertex, from 1.
    pub bounce: u32,
}

/// Whose paths a saved guide may serve; compared by [`load`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// Hash of the table of columns of u.
    pub columns_hash: String,
    /// Hash of the scene.
    pub scene_hash: String,
}

/// A density on the cube.
///
/// Calls may come from several threads at once. Rows are independent: a row's result does not depend,
/// bit for bit, on the rows beside it or on the number of threads.
pub trait Guide: Send + Sync + std::fmt::Debug {
    /// Name in the [`registry()`].
    fn name(&self) -> &str;

    /// The decisions that this guide models. For any other decision `sample` leaves `u` as it is and
    /// both functions give q = 1.
    fn models(&self) -> &[Decision];

    /// Number of columns of decision [`Decision::Path`].
    fn dims(&self) -> usize;

    /// Turns uniform numbers into guided ones, in place.
    ///
    /// | name       | shape, layout      | range    | meaning                                                    |
    /// |------------|--------------------|----------|------------------------------------------------------------|
    /// | `contexts` | `n`, or empty      |          | what is known per row; empty where the guide looks at nothing |
    /// | `u`        | `(n, d)` row-major | `[0, 1)` | in: uniform numbers; out: numbers distributed as q          |
    /// | `q`        | `n`                | `≥ 0`    | density of the row returned                                 |
    ///
    /// A row whose sample falls outside [0, 1)^d keeps those numbers, and q is the density there: the
    /// caller gives it contribution 0 (f vanishes outside the cube, so this is unbiased).
    /// Rows are counted by `q`; numbers beyond `n · d` are left alone.
    fn sample(&self, decision: Decision, contexts: &[Context], u: &mut [f32], q: &mut [f32]);

    /// Density of given numbers, shapes as in [`Guide::sample`]. Equals the q that `sample` reports for
    /// the same row to about 1e-4 relative (f32 throughout).
    fn density(&self, decision: Decision, contexts: &[Context], u: &[f32], q: &mut [f32]);

    /// Share of 65,536 fixed samples that fell outside the cube (standard error at most 0.002).
    fn mass_outside(&self) -> f64;

    /// Number of trained parameters.
    fn parameters(&self) -> usize;

    /// Name, configuration and facts, for records and tables.
    fn describe(&self) -> serde_json::Value;

    /// Whether `sample` and `density` want a context a row for a decision that the guide models.
    fn looks_at_contexts(&self, decision: Decision) -> bool {
        decision != Decision::Path
    }

    /// Which of the guide's own places a context belongs to, for pictures: the density is the same throughout a cell.
    /// `None` where the guide has no cells, or none there.
    fn cell(&self, _decision: Decision, _context: &Context) -> Option<usize> {
        None
    }

    /// What a file of the guide holds; `None` for a guide of another make, which keeps its own files.
    fn contents(&self) -> Option<Contents> {
        None
    }

    /// Writes the guide; the file appears complete or not at all.
    ///
    /// # Errors
    /// [`GuideError::Io`] if the file cannot be written.
    fn save(&self, path: &Path, header: &Header) -> Result<(), GuideError> {
        match self.contents() {
            Some(contents) => file::write(path, header, &contents),
            None => Err(GuideError::Io {
                path: path.to_owned(),
                source: std::io::Error::other("this guide has no file of its own"),
            }),
        }
    }
}

/// Loss after an epoch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EpochLoss {
    /// Epoch, from 1.
    pub epoch: usize,
    /// Of a flow: mean of −ln q(u) over the training set, in nats; 0 is the uniform density. Of a net: the second moment of
    /// the mixture's estimate over that of the uniform one, so 1 is the uniform density.
    pub loss: f64,
}

/// What [`fit`] returns.
#[derive(Debug)]
pub struct Fit {
    /// The trained guide.
    pub guide: Box<dyn Guide>,
    /// One entry per epoch.
    pub history: Vec<EpochLoss>,
    /// Wall time of the fit.
    pub seconds: f64,
    /// Paths dropped because a number, a density or a radiance was not finite.
    pub dropped_nonfinite: usize,
    /// Paths dropped because they were brighter than the outlier quantile.
    pub outliers_removed: usize,
    /// Paths that the training set was drawn from.
    pub trained_on: usize,
    /// Rows of the training set.
    pub samples: usize,
}
