//! What the decisions of paths came to, for who builds the same paths anew: a differentiable renderer evaluates BSDFs,
//! emitters and textures at the same vertices and divides by the same densities.

use crate::bsdf::BsdfSample;
use crate::math::Vec3;

/// A direction that was drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Step {
    /// Direction, world space; zero where the path had ended.
    pub d: [f32; 3],
    /// f_s·|cos θ| ÷ pdf.
    pub weight: [f32; 3],
    /// Baseline density in solid angle; 0 for a delta lobe.
    pub pdf: f32,
}

impl Step {
    pub(crate) fn new(d: Vec3, sample: &BsdfSample) -> Self {
        Self {
            d: d.to_array(),
            weight: sample.weight.to_array(),
            pdf: if sample.delta { 0.0 } else { sample.pdf },
        }
    }
}

/// A light that was joined by a shadow ray that nothing blocks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Join {
    /// Direction to it, world space.
    pub d: [f32; 3],
    /// w_nee ÷ p_nee, the factor on f_s·|cos θ|·L_e; 0 where no light was found.
    pub scale: f32,
}

/// The steps of a block of paths of k bounces.
#[derive(Clone, Debug, Default)]
pub struct Steps {
    /// k a path: the directions at x₁ … x_{k−1}, then, with `mis`, that of the BSDF-sampled ray at x_k.
    pub scattered: Vec<Step>,
    /// One a path: the emitter sample at x_k.
    pub joins: Vec<Join>,
    /// One a path: w_bsdf of the ray at x_k; 0 where it met no light.
    pub mis: Vec<f32>,
}

impl Steps {
    pub(crate) fn reset(&mut self, paths: usize, k: usize) {
        self.scattered.clear();
        self.scattered.resize(paths * k, Step::default());
        self.joins.clear();
        self.joins.resize(paths, Join::default());
        self.mis.clear();
        self.mis.resize(paths, 0.0);
    }
}
