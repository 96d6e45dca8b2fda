//! Rough metal: microfacet reflection with the conductor's Fresnel term (Cook and Torrance 1982,
//! Walter et al. 2007).

use serde::Deserialize;

use super::microfacet::{Distribution, Kind};
use super::{BsdfModel, BsdfSample, Builder, Materials, ShadingPoint, alphas_differ, fresnel};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3, reflect};
use crate::texture::TextureId;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    distribution: Kind,
    sample_visible: bool,
    alpha_u: TextureId,
    alpha_v: TextureId,
    eta: TextureId,
    k: TextureId,
    specular_reflectance: Option<TextureId>,
}

/// `roughconductor`
#[derive(Debug)]
pub struct RoughConductor {
    distribution: Kind,
    sample_visible: bool,
    alpha_u: TextureId,
    alpha_v: TextureId,
    eta: TextureId,
    k: TextureId,
    specular_reflectance: Option<TextureId>,
}

impl RoughConductor {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        Ok(Self {
            distribution: d.distribution,
            sample_visible: d.sample_visible,
            alpha_u: b.texture(d.alpha_u)?,
            alpha_v: b.texture(d.alpha_v)?,
            eta: b.texture(d.eta)?,
            k: b.texture(d.k)?,
            specular_reflectance: b.optional(d.specular_reflectance)?,
        })
    }

    fn distribution(&self, at: ShadingPoint<'_>) -> Distribution {
        Distribution::new(
            self.distribution,
            at.scalar(self.alpha_u),
            at.scalar(self.alpha_v),
            self.sample_visible,
        )
    }

    fn reflectance(&self, at: ShadingPoint<'_>, cos_theta: f32) -> Rgb {
        let f = fresnel::conductor(cos_theta, at.rgb(self.eta), at.rgb(self.k));
        self.specular_reflectance.map_or(f, |t| f * at.rgb(t))
    }
}

impl BsdfModel for RoughConductor {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        if wi.z <= 0.0 {
            return None;
        }
        let distribution = self.distribution(at);
        let m = distribution.sample(wi, u);
        let wo = reflect(wi, m);
        if wo.z <= 0.0 || wi.dot(m) <= 0.0 {
            return None;
        }
        let pdf = distribution.reflected_pdf(wi, wo, m);
        // f·cos ÷ pdf in closed form: no division of two tiny numbers.
        let masking = if self.sample_visible {
            distribution.smith_g1(wo, m)
        } else {
            distribution.g(wi, wo, m) * wi.dot(m) / (wi.z * m.z)
        };
        (pdf > 0.0).then(|| BsdfSample {
            wo,
            weight: self.reflectance(at, wi.dot(m)) * masking,
            pdf,
            delta: false,
        })
    }

    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        if wi.z <= 0.0 || wo.z <= 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let m = (wi + wo).normalize();
        if wi.dot(m) <= 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let distribution = self.distribution(at);
        let d = distribution.eval(m);
        if d == 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let value = d * distribution.g(wi, wo, m) / (4.0 * wi.z);
        (
            self.reflectance(at, wi.dot(m)) * value,
            distribution.reflected_pdf(wi, wo, m),
        )
    }

    fn anisotropic(&self, m: &Materials) -> bool {
        alphas_differ(m, self.alpha_u, self.alpha_v)
    }
}
