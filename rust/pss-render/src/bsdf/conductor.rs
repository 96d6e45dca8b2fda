//! Smooth metal: a mirror with the conductor's Fresnel term.

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
    eta: TextureId,
    k: TextureId,
    specular_reflectance: Option<TextureId>,
}

/// `conductor`
#[derive(Debug)]
pub struct Conductor {
    eta: TextureId,
    k: TextureId,
    specular_reflectance: Option<TextureId>,
}

impl Conductor {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        Ok(Self {
            eta: b.texture(d.eta)?,
            k: b.texture(d.k)?,
            specular_reflectance: b.optional(d.specular_reflectance)?,
        })
    }
}

impl BsdfModel for Conductor {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        self.sample_delta(at, wi, u[0])
    }

    fn eval_pdf(&self, _: ShadingPoint<'_>, _: Vec3, _: Vec3) -> (Rgb, f32) {
        (Rgb::ZERO, 0.0)
    }

    fn delta_probability(&self, _: ShadingPoint<'_>, _: Vec3) -> f32 {
        1.0
    }

    fn sample_delta(&self, at: ShadingPoint<'_>, wi: Vec3, _: f32) -> Option<BsdfSample> {
        if wi.z <= 0.0 {
            return None;
        }
        let f = fresnel::conductor(wi.z, at.rgb(self.eta), at.rgb(self.k));
        let weight = self.specular_reflectance.map_or(f, |t| f * at.rgb(t));
        delta_lobe(Vec3::new(-wi.x, -wi.y, wi.z), weight, 1.0)
    }

    fn smooth(&self, _: &Materials) -> bool {
        false
    }

    fn delta(&self, _: &Materials) -> bool {
        true
    }
}
