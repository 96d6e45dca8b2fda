//! Light from infinity in one direction, the same everywhere.

use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::{check, check_all_finite};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};
use crate::scene::Scene;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    /// The way that the light travels.
    direction: [f32; 3],
    irradiance: [f32; 3],
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `directional`
#[derive(Debug)]
pub struct Directional {
    towards: Vec3,
    irradiance: Rgb,
}

impl Directional {
    pub(super) fn build(d: Description, _b: Builder<'_>) -> Result<Self, SceneError> {
        let owner = format!("emitter {:?}", d.id);
        check_all_finite(&d.direction, &owner, "direction")?;
        check_all_finite(&d.irradiance, &owner, "irradiance")?;
        let direction = Vec3::from_array(d.direction);
        let length = direction.length();
        check(length > 0.0, &owner, "direction", length, "longer than 0")?;
        Ok(Self {
            towards: -direction / length,
            irradiance: Rgb::from_array(d.irradiance),
        })
    }
}

impl EmitterModel for Directional {
    fn sample_direction(
        &self,
        _scene: &Scene,
        _reference: Vec3,
        _u: [f32; 2],
    ) -> Option<EmitterSample> {
        Some(EmitterSample {
            d: self.towards,
            target: None,
            radiance: self.irradiance,
            pdf: 1.0,
            delta: true,
        })
    }

    fn can_be_hit(&self) -> bool {
        false
    }
}
