//! Light from a point into a cone about the local z axis, that fades towards the cone's rim.

use glam::Vec2;
use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::{check, check_all_finite, check_index};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};
use crate::scene::Scene;
use crate::shape::affine::Affine;
use crate::texture::TextureId;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    to_world: [f32; 16],
    intensity: [f32; 3],
    /// Multiplies the intensity across the cone.
    texture: Option<TextureId>,
    /// Degrees from the axis to where the light ends.
    cutoff_angle: f32,
    /// Degrees from the axis to where it begins to fade.
    beam_width: f32,
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `spot`
#[derive(Debug)]
pub struct Spot {
    map: Affine,
    intensity: Rgb,
    texture: Option<TextureId>,
    /// Radians.
    cutoff: f32,
    cos_cutoff: f32,
    cos_beam: f32,
    inverse_transition: f32,
    uv_factor: f32,
}

impl Spot {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let owner = format!("emitter {:?}", d.id);
        check_all_finite(&d.intensity, &owner, "intensity")?;
        check(
            d.cutoff_angle > 0.0 && d.cutoff_angle <= 180.0,
            &owner,
            "cutoff_angle",
            d.cutoff_angle,
            "above 0 and not above 180 degrees",
        )?;
        check(
            (0.0..=d.cutoff_angle).contains(&d.beam_width),
            &owner,
            "beam_width",
            d.beam_width,
            "between 0 and cutoff_angle",
        )?;
        if let Some(texture) = d.texture {
            check_index(texture, b.textures, &owner, "texture")?;
        }
        let (cutoff, beam) = (d.cutoff_angle.to_radians(), d.beam_width.to_radians());
        Ok(Self {
            map: Affine::new(&d.to_world, &owner)?,
            intensity: Rgb::from_array(d.intensity),
            texture: d.texture,
            cutoff,
            cos_cutoff: cutoff.cos(),
            cos_beam: beam.cos(),
            inverse_transition: 1.0 / (cutoff - beam),
            uv_factor: cutoff.tan(),
        })
    }

    fn falloff(&self, cos_theta: f32) -> f32 {
        if cos_theta <= self.cos_cutoff {
            0.0
        } else if cos_theta >= self.cos_beam {
            1.0
        } else {
            (self.cutoff - cos_theta.acos()) * self.inverse_transition
        }
    }
}

impl EmitterModel for Spot {
    fn sample_direction(
        &self,
        scene: &Scene,
        reference: Vec3,
        _u: [f32; 2],
    ) -> Option<EmitterSample> {
        let position = self.map.to_world.translation;
        let d = position - reference;
        let distance_2 = d.length_squared();
        if distance_2 <= 0.0 {
            return None;
        }
        let d = d / distance_2.sqrt();
        let local = self.map.to_object.transform_vector3a(-d);
        let falloff = self.falloff(local.normalize().z);
        if falloff <= 0.0 {
            return None;
        }
        let mut intensity = self.intensity;
        if let Some(texture) = self.texture {
            let slope = Vec2::new(local.x, local.y) / (local.z * self.uv_factor);
            intensity *= scene.materials().texture(texture).eval((0.5 + 0.5 * slope).into());
        }
        Some(EmitterSample {
            d,
            target: Some(position),
            radiance: intensity * (falloff / distance_2),
            pdf: 1.0,
            delta: true,
        })
    }

    fn can_be_hit(&self) -> bool {
        false
    }
}
