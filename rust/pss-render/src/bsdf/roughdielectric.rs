//! Rough glass: microfacet reflection and refraction (Walter et al. 2007). Radiance is scaled by η⁻² on its
//! way through, since the same light fills another solid angle.

use serde::Deserialize;

use super::microfacet::{Distribution, Kind};
use super::{BsdfModel, BsdfSample, Builder, Materials, ShadingPoint, alphas_differ, fresnel};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3, reflect};
use crate::texture::TextureId;
use crate::warp::three_from_two;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    distribution: Kind,
    sample_visible: bool,
    alpha_u: TextureId,
    alpha_v: TextureId,
    int_ior_over_ext_ior: f32,
    specular_reflectance: Option<TextureId>,
    specular_transmittance: Option<TextureId>,
}

/// `roughdielectric`
#[derive(Debug)]
pub struct RoughDielectric {
    distribution: Kind,
    sample_visible: bool,
    alpha_u: TextureId,
    alpha_v: TextureId,
    eta: f32,
    specular_reflectance: Option<TextureId>,
    specular_transmittance: Option<TextureId>,
}

impl RoughDielectric {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let eta = d.int_ior_over_ext_ior;
        b.check(
            eta.is_finite() && eta > 0.0 && eta != 1.0,
            "int_ior / ext_ior",
            eta,
            "positive, finite and not 1",
        )?;
        Ok(Self {
            distribution: d.distribution,
            sample_visible: d.sample_visible,
            alpha_u: b.texture(d.alpha_u)?,
            alpha_v: b.texture(d.alpha_v)?,
            eta,
            specular_reflectance: b.optional(d.specular_reflectance)?,
            specular_transmittance: b.optional(d.specular_transmittance)?,
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

    fn tint(&self, at: ShadingPoint<'_>, reflects: bool) -> Rgb {
        let texture = if reflects {
            self.specular_reflectance
        } else {
            self.specular_transmittance
        };
        texture.map_or(Rgb::ONE, |t| at.rgb(t))
    }
}

/// |∂m/∂ωo|: of the half vector for reflection, of the generalised one of relative index `eta` for refraction.
fn jacobian(reflects: bool, eta: f32, wi_m: f32, wo_m: f32) -> f32 {
    if reflects {
        0.25 / wo_m.abs()
    } else {
        eta * eta * wo_m.abs() / (wi_m + eta * wo_m).powi(2)
    }
}

impl BsdfModel for RoughDielectric {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        if wi.z == 0.0 {
            return None;
        }
        // Which lobe depends on the normal, which takes two numbers: the third is made of their last digits.
        let (u, choice) = three_from_two(u);
        let distribution = self.distribution(at);
        let drawn = distribution.for_sampling(wi.z);
        let above = wi * 1f32.copysign(wi.z);
        let m = drawn.sample(above, u);
        let wi_m = wi.dot(m);
        let f = fresnel::dielectric(wi_m, self.eta);
        let reflects = choice < f.reflectance;
        let (wo, share, scale) = if reflects {
            (reflect(wi, m), f.reflectance, 1.0)
        } else {
            let wo = fresnel::refract(wi, m, f);
            (wo, 1.0 - f.reflectance, f.eta_ti * f.eta_ti)
        };
        if (wi.z * wo.z > 0.0) != reflects || wi_m * wi.z <= 0.0 {
            return None;
        }
        let wo_m = wo.dot(m);
        let pdf = drawn.pdf(above, m) * share * jacobian(reflects, f.eta_it, wi_m, wo_m);
        let masking = if self.sample_visible {
            distribution.smith_g1(wo, m)
        } else {
            let ratio = distribution.eval(m) / drawn.eval(m);
            distribution.g(wi, wo, m) * ratio * (wi_m / (wi.z * m.z)).abs()
        };
        (pdf > 0.0 && pdf.is_finite()).then(|| BsdfSample {
            wo,
            weight: self.tint(at, reflects) * (masking * scale),
            pdf,
            delta: false,
        })
    }

    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        if wi.z == 0.0 || wo.z == 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let reflects = wi.z * wo.z > 0.0;
        let eta = if wi.z > 0.0 { self.eta } else { 1.0 / self.eta };
        let m = (wi + wo * if reflects { 1.0 } else { eta }).normalize();
        let m = m * 1f32.copysign(m.z);
        let (wi_m, wo_m) = (wi.dot(m), wo.dot(m));
        if wi_m * wi.z <= 0.0 || wo_m * wo.z <= 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let distribution = self.distribution(at);
        let f = fresnel::dielectric(wi_m, self.eta).reflectance;
        let dg = distribution.eval(m) * distribution.g(wi, wo, m);
        let jacobian = jacobian(reflects, eta, wi_m, wo_m);
        let (share, value) = if reflects {
            (f, f * dg / (4.0 * wi.z.abs()))
        } else {
            let value = (1.0 - f) * dg * jacobian * wi_m.abs() / (eta * eta * wi.z.abs());
            (1.0 - f, value)
        };
        let above = wi * 1f32.copysign(wi.z);
        let pdf = distribution.for_sampling(wi.z).pdf(above, m) * share * jacobian;
        (self.tint(at, reflects) * value, pdf)
    }

    fn transmits(&self, _: &Materials) -> bool {
        true
    }

    fn two_sided(&self, _: &Materials) -> bool {
        true
    }

    fn anisotropic(&self, m: &Materials) -> bool {
        alphas_differ(m, self.alpha_u, self.alpha_v)
    }
}
