//! Ideal diffuse reflection: f = ρ/π on the front side.

use serde::Deserialize;

use super::{BsdfModel, BsdfSample, Builder, ShadingPoint};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};
use crate::texture::TextureId;
use crate::warp::{INV_PI, cosine_hemisphere_pdf, square_to_cosine_hemisphere};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    reflectance: TextureId,
}

/// `diffuse`
#[derive(Debug)]
pub struct Diffuse {
    reflectance: TextureId,
}

impl Diffuse {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        Ok(Self {
            reflectance: b.texture(d.reflectance)?,
        })
    }
}

impl BsdfModel for Diffuse {
    #[inline]
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        if wi.z <= 0.0 {
            return None;
        }
        let wo = square_to_cosine_hemisphere(u);
        let pdf = cosine_hemisphere_pdf(wo.z);
        (pdf > 0.0).then(|| BsdfSample {
            wo,
            weight: at.rgb(self.reflectance),
            pdf,
            delta: false,
        })
    }

    #[inline]
    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        if wi.z <= 0.0 || wo.z <= 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let pdf = wo.z * INV_PI;
        (at.rgb(self.reflectance) * pdf, pdf)
    }
}
