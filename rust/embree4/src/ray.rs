//! What goes into a query and what comes out: plain values, no handles.

/// A ray segment `origin + t·dir`, `t ∈ [tnear, tfar]`.
///
/// `dir` need not be normalised: distances are counted in multiples of it. A segment with `tfar < tnear`,
/// or with a NaN anywhere, hits nothing that matters (no undefined behaviour, but no promise either).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Start, world space.
    pub origin: [f32; 3],
    /// Direction, world space, any length but zero.
    pub dir: [f32; 3],
    /// Smallest `t` that counts; negative values count as 0.
    pub tnear: f32,
    /// Largest `t` that counts; may be infinite.
    pub tfar: f32,
}

impl Ray {
    /// The whole half-line: `t ∈ [0, ∞)`.
    #[inline]
    pub const fn new(origin: [f32; 3], dir: [f32; 3]) -> Self {
        Self {
            origin,
            dir,
            tnear: 0.0,
            tfar: f32::INFINITY,
        }
    }

    /// The same ray cut off at `tfar`, as a shadow ray is at the emitter.
    #[inline]
    pub const fn until(self, tfar: f32) -> Self {
        Self { tfar, ..self }
    }
}

/// The nearest surface point along a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance in multiples of the ray's direction.
    pub t: f32,
    /// Barycentric weight of a triangle's second vertex; 0 on a [`Quadric`](crate::Quadric).
    pub u: f32,
    /// Barycentric weight of a triangle's third vertex; 0 on a [`Quadric`](crate::Quadric).
    pub v: f32,
    /// Geometric normal in **world** space, of any length: `(p1 − p0) × (p2 − p0)` on a triangle, the
    /// outward gradient on a sphere or cylinder, the image of +z on a disk. Never flipped towards the ray.
    pub ng: [f32; 3],
    /// The [`GeomId`] of what was hit, within its instanced scene where `inst` is set.
    pub geom: u32,
    /// Triangle index within the mesh; 0 on a [`Quadric`](crate::Quadric).
    pub prim: u32,
    /// The [`GeomId`] of the instance that it was hit through, if any.
    pub inst: Option<u32>,
}

/// Number of a geometry within its scene: 0, 1, 2 … in the order in which they were added.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct GeomId(pub u32);

impl From<GeomId> for u32 {
    fn from(id: GeomId) -> Self {
        id.0
    }
}

/// An axis-aligned box, world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Lower corner.
    pub min: [f32; 3],
    /// Upper corner.
    pub max: [f32; 3],
}
