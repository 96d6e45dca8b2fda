//! Path tracer in primary sample space: f(u) for a Mitsuba scene.
//!
//! A path of k bounces is a function of its primary numbers u; this crate evaluates it, in blocks, for a
//! scene that came from Mitsuba through [`Scene::new`]. Start reading at [`path`], which is the main loop;
//! [`columns`] says what each number decides.
//!
//! Deliberately absent: learning (a guide is seen only as a [`NumberSource`]), Python, files, random
//! numbers, and the division by a density.

mod arrays;
pub mod bsdf;
pub mod columns;
mod description;
mod distribution;
mod emission;
pub mod emitter;
mod error;
pub mod film;
mod hierarchical;
mod interaction;
pub mod math;
pub mod numbers;
mod packet;
pub mod path;
pub mod paths;
mod scene;
mod sensor;
pub mod shape;
pub mod steps;
pub mod texture;
mod warp;

pub use arrays::Array;
pub use columns::{Columns, Decision, EmitterStrategy};
pub use description::SCHEMA;
pub use distribution::Discrete;
pub use error::{SceneError, TraceError};
pub use film::{Accumulator, Developed, Film, Tile};
pub use interaction::{Interaction, MeshPoint};
pub use numbers::{NumberSource, Uniform, VertexContext};
pub use path::{Parametrisation, Tracer};
pub use paths::Paths;
pub use scene::{Scene, Summary};
pub use sensor::Sensor;
