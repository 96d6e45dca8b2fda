//! Light from a single point, the same in all directions.

use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::check_all_finite;
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};
use crate::scene::Scene;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    position: [f32; 3],
    intensity: [f32; 3],
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `point`
#[derive(Debug)]
pub struct Point {
    position: Vec3,
    intensity: Rgb,
}

impl Point {
    pub(super) fn build(d: Description, _b: Builder<'_>) -> Result<Self, SceneError> {
        let owner = format!("emitter {:?}", d.id);
        check_all_finite(&d.position, &owner, "position")?;
        check_all_finite(&d.intensity, &owner, "intensity")?;
        Ok(Self {
            position: Vec3::from_array(d.position),
            intensity: Rgb::from_array(d.intensity),
        })
    }
}

impl EmitterModel for Point {
    fn sample_direction(&self, _scene: &Scene, reference: Vec3, _u: [f32; 2]) -> Option<EmitterSample> {
        let d = self.position - reference;
        let distance_2 = d.length_squared();
        (distance_2 > 0.0).then(|| EmitterSample {
            d: d / distance_2.sqrt(),
            target: Some(self.position),
            radiance: self.intensity / distance_2,
            pdf: 1.0,
            delta: true,
        })
    }

    fn can_be_hit(&self) -> bool {
        false
    }
}
