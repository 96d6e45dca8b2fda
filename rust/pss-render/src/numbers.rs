//! Where the tracer gets its numbers from: contexts in, numbers and densities out, in blocks.
//!
//! This is all that the tracer knows of guides.

use std::ops::Range;

use crate::columns::Decision;

/// What a guide may look at when it decides the numbers at a vertex.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VertexContext {
    /// Vertex, world space.
    pub position: [f32; 3],
    /// Shading normal on the side that the path came from.
    pub normal: [f32; 3],
    /// Unit direction back to the previous vertex, world space.
    pub outgoing: [f32; 3],
    /// Film position, [0, 1)² over the crop.
    pub pixel: [f32; 2],
    /// Emitter chosen, where that is known already.
    pub emitter: u32,
    /// Which vertex: b of x_b.
    pub bounce: u32,
}

/// The paths that a stage's numbers are decided for.
#[derive(Debug)]
pub struct Lanes<'a> {
    /// Rows of `u` and `q` that are alive.
    pub active: &'a [u32],
    /// One context an active path, if [`NumberSource::looks_at`] this decision's; else empty.
    pub contexts: &'a [VertexContext],
    /// Primary numbers, `width` a path; uniform in this decision's columns until replaced.
    pub u: &'a mut [f32],
    /// Row length of `u`.
    pub width: usize,
    /// Columns of this decision.
    pub columns: Range<usize>,
    /// Per path: product of the densities of all decisions so far.
    pub q: &'a mut [f32],
}

/// Where the tracer gets its numbers from: contexts in, numbers and densities out, in blocks.
pub trait NumberSource {
    /// May replace the numbers of `lanes.columns` in the active rows of `u`, and multiplies their density
    /// (with respect to uniform numbers) into `lanes.q`. Numbers left alone have density 1.
    fn decide(&mut self, decision: Decision, lanes: Lanes<'_>);

    /// Whether contexts are wanted for a decision; those of the whole path know the pixel alone.
    fn looks_at(&self, _decision: Decision) -> bool {
        false
    }
}

/// Leaves every number as it is: random sampling.
#[derive(Clone, Copy, Debug, Default)]
pub struct Uniform;

impl NumberSource for Uniform {
    fn decide(&mut self, _decision: Decision, _lanes: Lanes<'_>) {}
}
