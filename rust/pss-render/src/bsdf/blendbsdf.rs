//! A weighted sum of two BSDFs: f = (1 − w)·f₀ + w·f₁, w a texture clamped to [0, 1].

use serde::Deserialize;

use super::{BsdfId, BsdfModel, BsdfSample, Builder, Materials, ShadingPoint, reuse};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};
use crate::texture::TextureId;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    weight: TextureId,
    first: BsdfId,
    second: BsdfId,
}

/// `blendbsdf`
#[derive(Debug)]
pub struct BlendBsdf {
    weight: TextureId,
    nested: [BsdfId; 2],
}

impl BlendBsdf {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        Ok(Self {
            weight: b.texture(d.weight)?,
            nested: [b.nested(d.first)?, b.nested(d.second)?],
        })
    }

    /// Probability of each nested BSDF's delta lobes.
    fn delta_shares(&self, at: ShadingPoint<'_>, wi: Vec3) -> [f32; 2] {
        let w = at.scalar(self.weight).clamp(0.0, 1.0);
        let [first, second] = self.nested.map(|b| at.materials.bsdf(b));
        [
            (1.0 - w) * first.delta_probability(at, wi),
            w * second.delta_probability(at, wi),
        ]
    }
}

impl BsdfModel for BlendBsdf {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        let w = at.scalar(self.weight).clamp(0.0, 1.0);
        // As Mitsuba: a number above w goes to the first BSDF, one up to w to the second.
        let (chosen, share, u0) = if u[0] > w {
            (0, 1.0 - w, (u[0] - w) / (1.0 - w))
        } else {
            (1, w, u[0] / w)
        };
        if share <= 0.0 {
            return None;
        }
        let u = [u0.min(1.0 - f32::EPSILON / 2.0), u[1]];
        let m = at.materials;
        let mut s = m.bsdf(self.nested[chosen]).sample(at, wi, u)?;
        if s.delta {
            // The other BSDF has no density in this direction alone.
            s.pdf *= share;
            return Some(s);
        }
        let (other_value, other_pdf) = m.bsdf(self.nested[1 - chosen]).eval_pdf(at, wi, s.wo);
        let pdf = share * s.pdf + (1.0 - share) * other_pdf;
        s.weight = (s.weight * (share * s.pdf) + other_value * (1.0 - share)) / pdf;
        s.pdf = pdf;
        (pdf > 0.0).then_some(s)
    }

    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        let w = at.scalar(self.weight).clamp(0.0, 1.0);
        let m = at.materials;
        let (f0, p0) = m.bsdf(self.nested[0]).eval_pdf(at, wi, wo);
        let (f1, p1) = m.bsdf(self.nested[1]).eval_pdf(at, wi, wo);
        (f0 * (1.0 - w) + f1 * w, p0 * (1.0 - w) + p1 * w)
    }

    fn delta_probability(&self, at: ShadingPoint<'_>, wi: Vec3) -> f32 {
        let shares = self.delta_shares(at, wi);
        shares[0] + shares[1]
    }

    fn sample_delta(&self, at: ShadingPoint<'_>, wi: Vec3, u: f32) -> Option<BsdfSample> {
        let shares = self.delta_shares(at, wi);
        let split = shares[0] / (shares[0] + shares[1]);
        let (chosen, u) = if u < split {
            (0, reuse(u, 0.0, split))
        } else {
            (1, reuse(u, split, 1.0 - split))
        };
        let w = at.scalar(self.weight).clamp(0.0, 1.0);
        let m = at.materials;
        let mut s = m.bsdf(self.nested[chosen]).sample_delta(at, wi, u)?;
        s.pdf *= [1.0 - w, w][chosen];
        Some(s)
    }

    fn two_sided(&self, m: &Materials) -> bool {
        self.nested.iter().any(|&b| m.bsdf(b).two_sided(m))
    }

    fn transmits(&self, m: &Materials) -> bool {
        self.nested.iter().any(|&b| m.bsdf(b).transmits(m))
    }

    fn smooth(&self, m: &Materials) -> bool {
        self.nested.iter().any(|&b| m.bsdf(b).smooth(m))
    }

    fn anisotropic(&self, m: &Materials) -> bool {
        self.nested.iter().any(|&b| m.bsdf(b).anisotropic(m))
    }

    fn delta(&self, m: &Materials) -> bool {
        self.nested.iter().any(|&b| m.bsdf(b).delta(m))
    }
}
