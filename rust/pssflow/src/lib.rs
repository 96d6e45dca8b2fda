//! The estimator: pilot → fit → render.
//!
//! I ≈ Σ over passes and samples of f(u) ÷ m(u), u ~ m, m = a + (1 − a)·q: random paths first (the pilot),
//! from which a guide q is learned, then paths from the mixture of the guide and uniform numbers. The pilot
//! stays in the image, with weights fixed before sampling. Start reading at [`render`].
//!
//! This crate joins the tracer (`pss-render`, which knows no guides) and the guides (`pss-guide`, which know
//! no rays). It knows no Python.

mod auto;
mod choice;
mod combine;
mod diagnostics;
mod error;
mod estimator;
mod learning;
mod lengths;
mod mixture;
mod numbers;
mod options;
pub mod output;
mod pass;
mod progress;
mod records;
mod schedule;
mod snapshots;
mod statistics;
mod strategy;
mod tail;
mod trace;

pub use auto::{Auto, Named};
pub use choice::{Chooser, Chosen, GuideChoice, Learned, Learner, Left};
pub use diagnostics::{Diagnostics, Means, Measured, SecondMoment};
pub use error::RenderError;
pub use estimator::{Outcome, Seconds, render};
pub use lengths::{Length, allot, last_probed, probe_lengths};
pub use mixture::{Mixture, Terms};
pub use options::{Budget, Combine, Options, PassKind, PassPlan};
pub use progress::{Phase, Progress, Silent};
pub use snapshots::Snapshot;
pub use statistics::{Counts, Moments, Statistics};
pub use strategy::{AutoStrategy, auto_strategy};
pub use tail::{Pareto, Tail};
pub use trace::{RayTiming, drawn_blocks, rays_alone, trace_blocks, uniform_paths};

pub use pss_guide;
pub use pss_render;
