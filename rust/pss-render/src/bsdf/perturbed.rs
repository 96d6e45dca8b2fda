//! A nested BSDF in a frame of its own, as `normalmap` and `bumpmap` use it.

use super::{Bsdf, BsdfSample, ShadingPoint};
use crate::math::{Frame, Rgb, Vec3};

/// A BSDF in a perturbed frame.
pub(super) struct Perturbed<'a> {
    pub(super) bsdf: &'a Bsdf,
    pub(super) at: ShadingPoint<'a>,
    /// In the surface's local coordinates.
    pub(super) frame: Frame,
    /// Whether the terminator is softened.
    pub(super) soften: bool,
}

impl Perturbed<'_> {
    /// Shadowing of the microsurface that the perturbed normal stands for (Estevez, Lecocq and Stein 2019).
    fn shadowing(&self, wo: Vec3) -> f32 {
        if !self.soften {
            return 1.0;
        }
        let tan_2 = |v: Vec3| (1.0 - v.z * v.z).max(0.0) / (v.z * v.z);
        let alpha_2 = (0.125 * tan_2(self.frame.n)).min(1.0);
        2.0 / (1.0 + (1.0 + alpha_2 * tan_2(wo)).sqrt())
    }

    /// Back to the surface's coordinates; `None` where the two normals see `wo` on different sides.
    fn unperturb(&self, mut s: BsdfSample) -> Option<BsdfSample> {
        let wo = self.frame.to_world(s.wo);
        if s.wo.z * wo.z <= 0.0 {
            return None;
        }
        s.weight *= self.shadowing(wo);
        s.wo = wo;
        Some(s)
    }

    pub(super) fn sample(&self, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        let s = self.bsdf.sample(self.at, self.frame.to_local(wi), u)?;
        self.unperturb(s)
    }

    pub(super) fn eval_pdf(&self, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        let local = self.frame.to_local(wo);
        if wo.z * local.z <= 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let (value, pdf) = self.bsdf.eval_pdf(self.at, self.frame.to_local(wi), local);
        (value * self.shadowing(wo), pdf)
    }

    pub(super) fn delta_probability(&self, wi: Vec3) -> f32 {
        self.bsdf
            .delta_probability(self.at, self.frame.to_local(wi))
    }

    pub(super) fn sample_delta(&self, wi: Vec3, u: f32) -> Option<BsdfSample> {
        let s = self
            .bsdf
            .sample_delta(self.at, self.frame.to_local(wi), u)?;
        self.unperturb(s)
    }
}
