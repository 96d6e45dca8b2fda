//! A diffuse base under a smooth dielectric coat: a mirror and a diffuse lobe, with the light that the
//! interface traps accounted for (Mitsuba's `plastic`).

use serde::Deserialize;

use super::{BsdfModel, BsdfSample, Materials, Builder, ShadingPoint, delta_lobe, fresnel, reuse};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};
use crate::texture::TextureId;
use crate::warp::{cosine_hemisphere_pdf, square_to_cosine_hemisphere};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    nonlinear: bool,
    int_ior_over_ext_ior: f32,
    diffuse_reflectance: TextureId,
    specular_reflectance: Option<TextureId>,
    specular_sampling_weight: f32,
}

/// `plastic`
#[derive(Debug)]
pub struct Plastic {
    eta: f32,
    nonlinear: bool,
    diffuse_reflectance: TextureId,
    specular_reflectance: Option<TextureId>,
    specular_sampling_weight: f32,
    /// Share of diffuse light inside that the interface throws back.
    internal_reflectance: f32,
}

impl Plastic {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let eta = d.int_ior_over_ext_ior;
        let ok = eta.is_finite() && eta > 0.0;
        b.check(ok, "int_ior / ext_ior", eta, "positive and finite")?;
        let weight = d.specular_sampling_weight;
        b.check(
            (0.0..=1.0).contains(&weight),
            "specular_sampling_weight",
            weight,
            "in [0, 1]",
        )?;
        Ok(Self {
            eta,
            nonlinear: d.nonlinear,
            diffuse_reflectance: b.texture(d.diffuse_reflectance)?,
            specular_reflectance: b.optional(d.specular_reflectance)?,
            specular_sampling_weight: weight,
            internal_reflectance: fresnel::diffuse_reflectance(1.0 / eta),
        })
    }

    /// The coat's reflectance, and the mirror's probability.
    #[inline]
    fn specular(&self, wi: Vec3) -> (f32, f32) {
        let f = fresnel::dielectric(wi.z, self.eta).reflectance;
        let specular = f * self.specular_sampling_weight;
        let diffuse = (1.0 - f) * (1.0 - self.specular_sampling_weight);
        let total = specular + diffuse;
        (f, if total > 0.0 { specular / total } else { 1.0 })
    }

    /// f·cos θ_o ÷ (cos θ_o/π) of the diffuse base.
    #[inline]
    fn base(&self, at: ShadingPoint<'_>, f_i: f32, wo: Vec3) -> Rgb {
        let rho = at.rgb(self.diffuse_reflectance);
        let trapped = if self.nonlinear {
            rho * self.internal_reflectance
        } else {
            Rgb::splat(self.internal_reflectance)
        };
        let f_o = fresnel::dielectric(wo.z, self.eta).reflectance;
        rho / (Rgb::ONE - trapped) * ((1.0 - f_i) * (1.0 - f_o) / (self.eta * self.eta))
    }
}

impl BsdfModel for Plastic {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        if wi.z <= 0.0 {
            return None;
        }
        let (f_i, p) = self.specular(wi);
        if u[0] < p {
            return self.sample_delta(at, wi, u[0]);
        }
        let wo = square_to_cosine_hemisphere([reuse(u[0], p, 1.0 - p), u[1]]);
        let pdf = (1.0 - p) * cosine_hemisphere_pdf(wo.z);
        (pdf > 0.0).then(|| BsdfSample {
            wo,
            weight: self.base(at, f_i, wo) / (1.0 - p),
            pdf,
            delta: false,
        })
    }

    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        if wi.z <= 0.0 || wo.z <= 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let (f_i, p) = self.specular(wi);
        let cosine = cosine_hemisphere_pdf(wo.z);
        (self.base(at, f_i, wo) * cosine, cosine * (1.0 - p))
    }

    fn delta_probability(&self, _: ShadingPoint<'_>, wi: Vec3) -> f32 {
        if wi.z > 0.0 { self.specular(wi).1 } else { 0.0 }
    }

    fn sample_delta(&self, at: ShadingPoint<'_>, wi: Vec3, _: f32) -> Option<BsdfSample> {
        if wi.z <= 0.0 {
            return None;
        }
        let (f_i, p) = self.specular(wi);
        let tint = self.specular_reflectance.map_or(Rgb::ONE, |t| at.rgb(t));
        delta_lobe(Vec3::new(-wi.x, -wi.y, wi.z), tint * (f_i / p), p)
    }

    fn delta(&self, _: &Materials) -> bool {
        true
    }
}
