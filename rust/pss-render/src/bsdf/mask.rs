//! A BSDF with holes: the nested one with probability `opacity`, else straight on. Passing a hole counts as
//! a bounce, and shadow rays see the mask as opaque, as in Mitsuba's `path`.

use serde::Deserialize;

use super::{BsdfId, BsdfModel, BsdfSample, Builder, Materials, ShadingPoint, delta_lobe, reuse};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};
use crate::texture::TextureId;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    opacity: TextureId,
    nested: BsdfId,
}

/// `mask`
#[derive(Debug)]
pub struct Mask {
    opacity: TextureId,
    nested: BsdfId,
}

impl Mask {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        Ok(Self {
            opacity: b.texture(d.opacity)?,
            nested: b.nested(d.nested)?,
        })
    }

    #[inline]
    fn opacity(&self, at: ShadingPoint<'_>) -> f32 {
        at.scalar(self.opacity).clamp(0.0, 1.0)
    }
}

impl BsdfModel for Mask {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        let opacity = self.opacity(at);
        if u[0] >= opacity {
            return delta_lobe(-wi, Rgb::ONE, 1.0 - opacity);
        }
        let u = [reuse(u[0], 0.0, opacity), u[1]];
        let mut s = at.materials.bsdf(self.nested).sample(at, wi, u)?;
        s.pdf *= opacity;
        Some(s)
    }

    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        let opacity = self.opacity(at);
        let (value, pdf) = at.materials.bsdf(self.nested).eval_pdf(at, wi, wo);
        (value * opacity, pdf * opacity)
    }

    fn delta_probability(&self, at: ShadingPoint<'_>, wi: Vec3) -> f32 {
        let opacity = self.opacity(at);
        let nested = at.materials.bsdf(self.nested);
        1.0 - opacity + opacity * nested.delta_probability(at, wi)
    }

    fn sample_delta(&self, at: ShadingPoint<'_>, wi: Vec3, u: f32) -> Option<BsdfSample> {
        let opacity = self.opacity(at);
        let nested = at.materials.bsdf(self.nested);
        let p_nested = opacity * nested.delta_probability(at, wi);
        let split = p_nested / (1.0 - opacity + p_nested);
        if u >= split {
            return delta_lobe(-wi, Rgb::ONE, 1.0 - opacity);
        }
        let mut s = nested.sample_delta(at, wi, reuse(u, 0.0, split))?;
        s.pdf *= opacity;
        Some(s)
    }

    fn transmits(&self, m: &Materials) -> bool {
        m.bsdf(self.nested).transmits(m)
    }

    fn two_sided(&self, _: &Materials) -> bool {
        true
    }

    fn smooth(&self, m: &Materials) -> bool {
        m.bsdf(self.nested).smooth(m)
    }

    fn anisotropic(&self, m: &Materials) -> bool {
        m.bsdf(self.nested).anisotropic(m)
    }

    fn delta(&self, _: &Materials) -> bool {
        true
    }
}
