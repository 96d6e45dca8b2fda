//! The estimator as a whole. One binary: linking takes longer than all of the tests.
#![allow(clippy::unwrap_used)]

mod common;
mod learning;
mod passes;
