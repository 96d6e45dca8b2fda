#![doc = include_str!("../README.md")]
// The workspace denies `unsafe`: calling a C library is the one place that needs it, and this crate is
// that place. Every block carries its own SAFETY line (`undocumented_unsafe_blocks` is denied).
#![allow(unsafe_code)]

pub mod brute;
mod device;
mod error;
mod ffi;
mod load;
mod query;
mod ray;
mod scene;
mod shapes;
mod shared;

#[cfg(test)]
mod guard_tests;

pub use device::{Device, DeviceOptions, Isa};
pub use error::{EmbreeError, LoadError};
pub use load::add_search_dirs;
pub use ray::{Bounds, GeomId, Hit, Ray};
pub use scene::{PACKET_WIDTH, Scene, SceneBuilder};
pub use shapes::Quadric;
pub use shared::Shared;
