//! A slide projector: the inverse of a pinhole camera.

use std::f32::consts::PI;

use glam::Vec2;
use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::{check, check_index};
use crate::error::SceneError;
use crate::math::Vec3;
use crate::scene::Scene;
use crate::shape::affine::Affine;
use crate::texture::TextureId;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    to_world: [f32; 16],
    irradiance: TextureId,
    scale: f32,
    /// The image covers slopes x/z and y/z within ± these.
    half_size: [f32; 2],
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `projector`
#[derive(Debug)]
pub struct Projector {
    map: Affine,
    /// Image of the local z axis, the way that the light travels.
    axis: Vec3,
    irradiance: TextureId,
    scale: f32,
    half_size: Vec2,
}

impl Projector {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let owner = format!("emitter {:?}", d.id);
        check_index(d.irradiance, b.textures, &owner, "texture")?;
        check(d.scale.is_finite(), &owner, "scale", d.scale, "finite")?;
        for half in d.half_size {
            check(
                half.is_finite() && half > 0.0,
                &owner,
                "half_size",
                half,
                "positive",
            )?;
        }
        let map = Affine::new(&d.to_world, &owner)?;
        Ok(Self {
            axis: map.vector(Vec3::Z),
            map,
            irradiance: d.irradiance,
            scale: d.scale,
            half_size: Vec2::from_array(d.half_size),
        })
    }
}

impl EmitterModel for Projector {
    fn sample_direction(
        &self,
        scene: &Scene,
        reference: Vec3,
        _u: [f32; 2],
    ) -> Option<EmitterSample> {
        let local = self.map.inverse_point(reference);
        if local.z <= 0.0 {
            return None;
        }
        let uv = 0.5 - 0.5 * Vec2::new(local.x, local.y) / (local.z * self.half_size);
        if !(0.0..=1.0).contains(&uv.x) || !(0.0..=1.0).contains(&uv.y) {
            return None;
        }
        let position = self.map.to_world.translation;
        let d = (position - reference).normalize_or_zero();
        let irradiance = scene.materials().texture(self.irradiance).eval(uv.into());
        // Mitsuba's units: π × the image's value is the irradiance of a plane at z = 1, cosine left out.
        let scale = PI * self.scale / (local.z * local.z * -self.axis.dot(d));
        Some(EmitterSample {
            d,
            target: Some(position),
            radiance: irradiance * scale,
            pdf: 1.0,
            delta: true,
        })
    }

    fn can_be_hit(&self) -> bool {
        false
    }
}
