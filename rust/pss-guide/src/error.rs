//! What can go wrong with a guide: one line each, naming the offender, its value, the rule and the remedy.

use std::path::PathBuf;

/// Failure of fitting, saving or loading a guide.
#[derive(Debug, thiserror::Error)]
pub enum GuideError {
    /// No registry line has this name.
    #[error("no guide is named {name:?} (known: {known})")]
    UnknownGuide {
        /// The name asked for.
        name: String,
        /// All names, joined by commas.
        known: String,
    },
    /// Two factors of a composite model the same numbers.
    #[error(
        "guide {name:?}: {first} and {second} model the same numbers; join guides of different decisions"
    )]
    Overlap {
        /// The composite.
        name: String,
        /// One factor.
        first: &'static str,
        /// The other.
        second: &'static str,
    },
    /// The guide has no option of this name.
    #[error("guide {guide:?} has no option {option:?} (known: {known})")]
    UnknownOption {
        /// The guide.
        guide: String,
        /// The option given.
        option: String,
        /// All options, joined by commas.
        known: String,
    },
    /// An option's value has the wrong type or lies outside its range.
    #[error("guide {guide:?}: option {option} = {value} is not accepted: {rule}")]
    Option {
        /// The guide.
        guide: String,
        /// The option.
        option: String,
        /// Its value as JSON.
        value: String,
        /// What is accepted.
        rule: String,
    },
    /// Arrays of one record set disagree in length.
    #[error(
        "records: `{array}` holds {found} values, but {expected} belong to {rows} paths of {dims} numbers"
    )]
    Shape {
        /// The array.
        array: &'static str,
        /// Its length.
        found: usize,
        /// The length it must have.
        expected: usize,
        /// Number of paths.
        rows: usize,
        /// Numbers per path.
        dims: usize,
    },
    /// There is nothing to learn from.
    #[error(
        "{usable} usable non-zero paths among {given} given ({nonfinite} not finite, {zeros} zeros): a guide needs at least 2. \
         Give the pilot more samples, or render with guide `none`"
    )]
    TooFewPaths {
        /// Paths left after cleaning.
        usable: usize,
        /// Paths given.
        given: usize,
        /// Paths dropped because a number was not finite.
        nonfinite: usize,
        /// Paths without light, which were only counted.
        zeros: u64,
    },
    /// The training loss stopped being a number.
    #[error(
        "guide {guide:?}: training diverged in epoch {epoch}, batch {batch} (loss {loss}). \
         Lower `learning_rate`, or remove more outliers with `outlier_quantile`"
    )]
    Diverged {
        /// The guide.
        guide: String,
        /// Epoch, from 1.
        epoch: usize,
        /// Batch of the epoch, from 1.
        batch: usize,
        /// The loss, NaN or infinite.
        loss: f64,
    },
    /// The caller's progress function asked to stop.
    #[error("training was cancelled")]
    Cancelled,
    /// The tensor library or its thread failed.
    #[error("guide {guide:?}: the tensor library failed: {message}")]
    Tensor {
        /// The guide.
        guide: String,
        /// The library's message.
        message: String,
    },
    /// The file cannot be read or written.
    #[error("guide file {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The bytes are not those of a guide.
    #[error("guide file {}: {what}. The file is truncated, corrupt or not a guide: fit and save it again", path.display())]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// Another version wrote the file.
    #[error("guide file {}: format version {found}, but this build reads version {expected}. Fit and save the guide again", path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// Version in the file.
        found: String,
        /// Version of this build.
        expected: u32,
    },
    /// The guide belongs to another scene or to other columns of u.
    #[error("guide file {}: it was fitted for {what} {found}, but this render has {expected}. Fit the guide for this render", path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
        /// `columns` or `scene`.
        what: &'static str,
        /// Hash in the file.
        found: String,
        /// Hash expected.
        expected: String,
    },
}
