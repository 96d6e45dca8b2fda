//! A surface that shines along its normal alone, like a laser: no path from the camera can find that light,
//! neither by NEE nor by chance. As Mitsuba's `path`, which draws it and gets nothing.

use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::check_index;
use crate::error::SceneError;
use crate::math::Vec3;
use crate::scene::Scene;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    shape: usize,
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `directionalarea`
#[derive(Debug)]
pub struct DirectionalArea {
    shape: usize,
}

impl DirectionalArea {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        check_index(d.shape, b.shapes, &format!("emitter {:?}", d.id), "shape")?;
        Ok(Self { shape: d.shape })
    }
}

impl EmitterModel for DirectionalArea {
    fn sample_direction(
        &self,
        _scene: &Scene,
        _reference: Vec3,
        _u: [f32; 2],
    ) -> Option<EmitterSample> {
        None
    }

    fn can_be_hit(&self) -> bool {
        false
    }

    fn shape(&self) -> Option<usize> {
        Some(self.shape)
    }
}
