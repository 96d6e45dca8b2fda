//! Light from a surface, on the side that its normal points to.

use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::check_index;
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::{Rgb, Vec3};
use crate::scene::Scene;
use crate::texture::TextureId;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    shape: usize,
    radiance: TextureId,
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `area`
#[derive(Debug)]
pub struct Area {
    shape: usize,
    radiance: TextureId,
}

impl Area {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let owner = format!("emitter {:?}", d.id);
        check_index(d.shape, b.shapes, &owner, "shape")?;
        check_index(d.radiance, b.textures, &owner, "texture")?;
        Ok(Self {
            shape: d.shape,
            radiance: d.radiance,
        })
    }
}

impl EmitterModel for Area {
    fn sample_direction(&self, scene: &Scene, reference: Vec3, u: [f32; 2]) -> Option<EmitterSample> {
        let s = scene.shape(self.shape).model().sample_direction(reference, u);
        let d = (s.p - reference).normalize_or_zero();
        if s.pdf <= 0.0 || d.dot(s.n) >= 0.0 {
            return None;
        }
        Some(EmitterSample {
            d,
            target: Some(s.p),
            radiance: scene.materials().texture(self.radiance).eval(s.uv.into()),
            pdf: s.pdf,
            delta: false,
        })
    }

    fn pdf_direction(&self, scene: &Scene, reference: Vec3, d: Vec3, surface: Option<&Interaction>) -> f32 {
        match surface {
            Some(si) if d.dot(si.shading_normal) < 0.0 => scene
                .shape(self.shape)
                .model()
                .pdf_direction(reference, si.p, si.shading_normal),
            _ => 0.0,
        }
    }

    fn eval(&self, scene: &Scene, d: Vec3, surface: Option<&Interaction>) -> Rgb {
        match surface {
            Some(si) if d.dot(si.shading_normal) < 0.0 => {
                scene.materials().texture(self.radiance).eval(si.uv.into())
            }
            _ => Rgb::ZERO,
        }
    }

    fn shape(&self) -> Option<usize> {
        Some(self.shape)
    }
}
