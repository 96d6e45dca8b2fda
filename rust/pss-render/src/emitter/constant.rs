//! The same radiance from every direction.

use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::check_all_finite;
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::{Rgb, Vec3};
use crate::scene::Scene;
use crate::warp::{UNIFORM_SPHERE_PDF, square_to_uniform_sphere};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    radiance: [f32; 3],
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `constant`
#[derive(Debug)]
pub struct Constant {
    radiance: Rgb,
}

impl Constant {
    pub(super) fn build(d: Description, _b: Builder<'_>) -> Result<Self, SceneError> {
        check_all_finite(&d.radiance, &format!("emitter {:?}", d.id), "radiance")?;
        Ok(Self {
            radiance: Rgb::from_array(d.radiance),
        })
    }
}

impl EmitterModel for Constant {
    fn sample_direction(&self, _scene: &Scene, _reference: Vec3, u: [f32; 2]) -> Option<EmitterSample> {
        Some(EmitterSample {
            d: square_to_uniform_sphere(u),
            target: None,
            radiance: self.radiance,
            pdf: UNIFORM_SPHERE_PDF,
            delta: false,
        })
    }

    fn pdf_direction(&self, _scene: &Scene, _reference: Vec3, _d: Vec3, _surface: Option<&Interaction>) -> f32 {
        UNIFORM_SPHERE_PDF
    }

    fn eval(&self, _scene: &Scene, _d: Vec3, _surface: Option<&Interaction>) -> Rgb {
        self.radiance
    }

    fn is_environment(&self) -> bool {
        true
    }
}
