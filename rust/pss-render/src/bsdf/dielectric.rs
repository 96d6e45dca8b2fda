//! Smooth glass: reflection and refraction by Fresnel's equations. Radiance is scaled by η⁻² on its way
//! through, since the same light fills another solid angle.

use serde::Deserialize;

use super::{BsdfModel, BsdfSample, Builder, Materials, ShadingPoint, delta_lobe, fresnel};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};
use crate::texture::TextureId;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    int_ior_over_ext_ior: f32,
    specular_reflectance: Option<TextureId>,
    specular_transmittance: Option<TextureId>,
}

/// `dielectric`
#[derive(Debug)]
pub struct Dielectric {
    eta: f32,
    specular_reflectance: Option<TextureId>,
    specular_transmittance: Option<TextureId>,
}

impl Dielectric {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let eta = d.int_ior_over_ext_ior;
        let ok = eta.is_finite() && eta > 0.0;
        b.check(ok, "int_ior / ext_ior", eta, "positive and finite")?;
        Ok(Self {
            eta,
            specular_reflectance: b.optional(d.specular_reflectance)?,
            specular_transmittance: b.optional(d.specular_transmittance)?,
        })
    }
}

impl BsdfModel for Dielectric {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        self.sample_delta(at, wi, u[0])
    }

    fn eval_pdf(&self, _: ShadingPoint<'_>, _: Vec3, _: Vec3) -> (Rgb, f32) {
        (Rgb::ZERO, 0.0)
    }

    fn delta_probability(&self, _: ShadingPoint<'_>, _: Vec3) -> f32 {
        1.0
    }

    fn sample_delta(&self, at: ShadingPoint<'_>, wi: Vec3, u: f32) -> Option<BsdfSample> {
        let f = fresnel::dielectric(wi.z, self.eta);
        if u < f.reflectance {
            let tint = self.specular_reflectance.map_or(Rgb::ONE, |t| at.rgb(t));
            delta_lobe(Vec3::new(-wi.x, -wi.y, wi.z), tint, f.reflectance)
        } else {
            let tint = self.specular_transmittance.map_or(Rgb::ONE, |t| at.rgb(t));
            let wo = Vec3::new(-f.eta_ti * wi.x, -f.eta_ti * wi.y, f.cos_theta_t);
            delta_lobe(wo, tint * (f.eta_ti * f.eta_ti), 1.0 - f.reflectance)
        }
    }

    fn smooth(&self, _: &Materials) -> bool {
        false
    }

    fn two_sided(&self, _: &Materials) -> bool {
        true
    }

    fn delta(&self, _: &Materials) -> bool {
        true
    }
}
