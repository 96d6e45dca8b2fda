//! A thin pane of glass: both interfaces at once, all inner reflections summed, and no bend.

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

/// `thindielectric`
#[derive(Debug)]
pub struct ThinDielectric {
    eta: f32,
    specular_reflectance: Option<TextureId>,
    specular_transmittance: Option<TextureId>,
}

impl ThinDielectric {
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

impl BsdfModel for ThinDielectric {
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
        // R + T²R + T²R³ + … of one interface.
        let r = fresnel::dielectric(wi.z.abs(), self.eta).reflectance;
        let r = 2.0 * r / (1.0 + r);
        if u < r {
            let tint = self.specular_reflectance.map_or(Rgb::ONE, |t| at.rgb(t));
            delta_lobe(Vec3::new(-wi.x, -wi.y, wi.z), tint, r)
        } else {
            let tint = self.specular_transmittance.map_or(Rgb::ONE, |t| at.rgb(t));
            delta_lobe(-wi, tint, 1.0 - r)
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
