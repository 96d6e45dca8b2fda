//! Why a render could not be done.

/// A render that cannot be done as asked.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// A request that the tracer refuses.
    #[error(transparent)]
    Trace(#[from] pss_render::TraceError),
    /// A guide that cannot be fitted, loaded or used.
    #[error(transparent)]
    Guide(#[from] pss_guide::GuideError),
    /// An option out of its range.
    #[error("{name} = {value}: must be {rule}")]
    Option {
        /// The option.
        name: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        rule: &'static str,
    },
    /// A guide for another number of columns.
    #[error(
        "guide {name:?} models {found} columns, but k = {k} bounces have {expected}. \
         Fit it for this k, or render with k = {guide_k}"
    )]
    Dimensions {
        /// The guide.
        name: String,
        /// Its columns.
        found: usize,
        /// Columns of this render.
        expected: usize,
        /// Bounces of this render.
        k: usize,
        /// Bounces that the guide is for.
        guide_k: usize,
    },
    /// Stopped by the user.
    #[error("interrupted")]
    Cancelled,
    /// The threads could not be started.
    #[error("cannot start {threads} threads: {reason}")]
    Threads {
        /// How many.
        threads: usize,
        /// Why not.
        reason: String,
    },
    /// A file that cannot be read.
    #[error("cannot read {path:?}: {reason}")]
    Read {
        /// The file.
        path: std::path::PathBuf,
        /// The system's or the format's reason.
        reason: String,
    },
    /// A file that cannot be written.
    #[error("cannot write {path:?}: {reason}")]
    Write {
        /// The file.
        path: std::path::PathBuf,
        /// The system's or the format's reason.
        reason: String,
    },
}
