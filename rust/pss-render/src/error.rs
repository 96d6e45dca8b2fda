//! What can be wrong with a scene or a request; each message is one line: offender, rule, remedy.

/// A scene that cannot be rendered as it is.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The description is not JSON of the expected shape.
    #[error("scene description: {0}. Export the scene again with this version of pssflow")]
    Description(#[from] serde_json::Error),
    /// The description was written by another version.
    #[error(
        "scene description has schema {found}, this version reads {expected}. Export the scene again"
    )]
    Schema {
        /// Schema of the description.
        found: u32,
        /// Schema that this version reads.
        expected: u32,
    },
    /// An index points past the end of its table.
    #[error("{owner}: {what} {index} does not exist (there are {count})")]
    Reference {
        /// Who refers.
        owner: String,
        /// To what.
        what: &'static str,
        /// With which index.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// An array has the wrong type or shape.
    #[error("{owner}: array `{name}` has {found}, expected {expected}")]
    Array {
        /// The shape or texture.
        owner: String,
        /// The array's name.
        name: &'static str,
        /// What was found.
        found: String,
        /// What is needed.
        expected: String,
    },
    /// A number is NaN, infinite or out of its range.
    #[error("{owner}: `{name}`{place} = {value}, but it must be {rule}")]
    Value {
        /// The shape, BSDF, emitter, sensor or texture.
        owner: String,
        /// The parameter or array.
        name: &'static str,
        /// Where in an array, or empty.
        place: String,
        /// The offending value.
        value: f64,
        /// What would be right.
        rule: &'static str,
    },
    /// A face refers to a vertex that does not exist.
    #[error(
        "shape {id:?}: face {face} refers to vertex {vertex}, but there are {vertices} vertices"
    )]
    FaceIndex {
        /// Shape.
        id: String,
        /// Face.
        face: usize,
        /// Offending index.
        vertex: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// A nested BSDF that does not exist, or that would contain its own parent.
    #[error(
        "bsdf {id:?}: nested bsdf {nested} must come before the one that uses it, and does not"
    )]
    Nested {
        /// The BSDF.
        id: String,
        /// Index of the nested one.
        nested: usize,
    },
    /// Nothing to hit.
    #[error("the scene has no shape; add one, or render it with Mitsuba's `path`")]
    Empty,
    /// A shape and an area emitter do not name each other.
    #[error(
        "shape {shape:?} and emitter {emitter:?}: only one of them names the other; \
         an area emitter and its shape must name each other. Export the scene again"
    )]
    Attachment {
        /// The shape's id.
        shape: String,
        /// The emitter's id.
        emitter: String,
    },
    /// Embree refused a shape.
    #[error("{owner}: {source}")]
    Geometry {
        /// The shape.
        owner: String,
        /// Embree's reason.
        source: embree4::EmbreeError,
    },
    /// Embree itself failed.
    #[error("{0}")]
    Embree(#[from] embree4::EmbreeError),
}

/// A request to the tracer that cannot be met.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum TraceError {
    /// `k` outside 1 … 32.
    #[error("k = {0} bounces: must be between 1 and 32")]
    Bounces(usize),
    /// `u` has the wrong number of columns.
    #[error(
        "u has {found} columns, but k = {k} with emitter strategy {strategy} needs {expected}: {columns}"
    )]
    Columns {
        /// Columns found.
        found: usize,
        /// Columns needed.
        expected: usize,
        /// Bounces.
        k: usize,
        /// Strategy's name.
        strategy: &'static str,
        /// The columns' names.
        columns: String,
    },
    /// A primary number outside [0, 1).
    #[error("u[{row}, {column}] = {value} lies outside [0, 1)")]
    Range {
        /// Row.
        row: usize,
        /// Column.
        column: usize,
        /// Value, NaN included.
        value: f32,
    },
    /// `pixels` does not match `u`.
    #[error("pixels has {found} rows, u has {expected}")]
    Rows {
        /// Rows of `pixels`.
        found: usize,
        /// Rows of `u`.
        expected: usize,
    },
}
