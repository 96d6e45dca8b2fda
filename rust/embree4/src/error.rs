//! Every way in which this crate says no. One line each: what, which value, which rule, what to do.

/// Why no Embree device could be made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LoadError {
    /// No candidate could be loaded as Embree 4; `looked` lists each with its reason.
    #[error(
        "no usable Embree 4 library found. Looked at: {looked}. Install one with `pip install embreex` or \
         `apt install libembree4-4`, or set EMBREE4_LIBRARY to the file"
    )]
    NotFound {
        /// `path (reason)`, joined by semicolons, in the order tried.
        looked: String,
    },
    /// `PSSFLOW_ISA` holds something else than the names below.
    #[error(
        "PSSFLOW_ISA = {value:?} is not an instruction set (known: avx512, avx2, sse4.2). \
         Unset it to let Embree choose"
    )]
    UnknownIsa {
        /// What the variable held.
        value: String,
    },
    /// The processor lacks the instruction set asked for; running it would end in SIGILL.
    #[error(
        "instruction set {isa} was asked for, but this processor lacks it. Unset PSSFLOW_ISA to let Embree choose"
    )]
    UnsupportedIsa {
        /// The name asked for.
        isa: &'static str,
    },
    /// The library is Embree 4, but it would not make a device.
    #[error("{library}: Embree made no device for the configuration {config:?}: {message}")]
    Device {
        /// The file in use.
        library: String,
        /// The configuration string passed.
        config: String,
        /// Embree's own words.
        message: String,
    },
}

/// Why a scene could not be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EmbreeError {
    /// An array that must hold triples does not.
    #[error("`{array}` holds {len} numbers, but must hold a multiple of 3 ({rule})")]
    Length {
        /// `positions` or `faces`.
        array: &'static str,
        /// Its length.
        len: usize,
        /// What a triple is.
        rule: &'static str,
    },
    /// More vertices or triangles than a 32-bit number can name.
    #[error("`{array}` describes {count} items, but Embree numbers them with 32 bits (at most {}). Split the mesh", u32::MAX - 1)]
    TooMany {
        /// `positions` or `faces`.
        array: &'static str,
        /// How many vertices or triangles.
        count: usize,
    },
    /// A triangle names a vertex that does not exist.
    #[error(
        "faces[{face}] names vertex {index}, but the mesh has {vertices} vertices (numbered from 0)"
    )]
    Index {
        /// Row of `faces`.
        face: usize,
        /// The number found.
        index: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// A coordinate is NaN, infinite, or too large for Embree's single-precision arithmetic.
    #[error(
        "positions[{vertex}] = {value:?} must be finite and within ±1e18 (Embree drops such triangles silently). \
         Repair or rescale the mesh"
    )]
    Vertex {
        /// Row of `positions`.
        vertex: usize,
        /// The vertex found.
        value: [f32; 3],
    },
    /// A sphere's centre or radius makes no sphere.
    #[error(
        "sphere with centre {center:?} and radius {radius}: the centre must be finite and the radius finite and > 0"
    )]
    Sphere {
        /// Centre found.
        center: [f32; 3],
        /// Radius found.
        radius: f32,
    },
    /// A transform is not finite or flattens space.
    #[error(
        "to_world of the {shape} = {matrix:?} must be finite, within ±1e18 and invertible (row-major 3×4)"
    )]
    Transform {
        /// `disk`, `cylinder` or `instance`.
        shape: &'static str,
        /// The matrix found.
        matrix: [f32; 12],
    },
    /// An instance of a scene that itself holds instances.
    #[error(
        "the scene to be instanced holds instances itself, and one level is supported. Flatten the inner scene"
    )]
    NestedInstance,
    /// An instance of a scene that belongs to another device.
    #[error(
        "the scene to be instanced was built on another Embree device. Build both scenes on clones of one `Device`"
    )]
    OtherDevice,
    /// The library itself refused; this is out of memory or a defect of this crate.
    #[error("Embree failed in {call}: {message}")]
    Library {
        /// The C function.
        call: &'static str,
        /// Embree's own words.
        message: String,
    },
}
