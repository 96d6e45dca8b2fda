//! What holds for every guide of the registry: a new guide is covered by its registry line.
#![allow(clippy::unwrap_used)]

mod candle;
mod common;
mod density;
mod files;
mod input;
mod memory;
mod pixel;
mod places;
mod select;
#[path = "../../benches/support/mod.rs"]
mod support;
mod world;
