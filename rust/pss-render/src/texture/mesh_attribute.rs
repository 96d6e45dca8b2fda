//! Values that a mesh holds at its vertices or faces (Mitsuba's `mesh_attribute`).

use serde::Deserialize;

use super::{TextureModel, TexturePoint};
use crate::arrays::{Arrays, check};
use crate::error::SceneError;
use crate::math::Rgb;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    id: String,
    /// Of the attribute, as the meshes call it.
    name: String,
    scale: f32,
}

/// An attribute by its name: each mesh that wears the texture holds values of its own.
#[derive(Debug)]
pub struct MeshAttribute {
    name: String,
    scale: f32,
}

impl MeshAttribute {
    pub(crate) fn build(d: Description, _arrays: &mut Arrays) -> Result<Self, SceneError> {
        let owner = format!("texture {:?}", d.id);
        check(d.scale.is_finite(), &owner, "scale", d.scale, "finite")?;
        Ok(Self { name: d.name, scale: d.scale })
    }

    /// The value and its number of channels; zero where there is none, as in Mitsuba.
    fn value(&self, at: TexturePoint<'_>) -> (Rgb, usize) {
        at.mesh
            .and_then(|(place, attributes)| attributes.get(place.shape, &self.name)?.at(place))
            .map_or((Rgb::ZERO, 0), |(value, channels)| (value * self.scale, channels))
    }
}

impl TextureModel for MeshAttribute {
    fn eval(&self, at: TexturePoint<'_>) -> Rgb {
        self.value(at).0
    }

    /// Zero for three channels, as in Mitsuba, which takes a scalar from none but one.
    fn eval_scalar(&self, at: TexturePoint<'_>) -> f32 {
        match self.value(at) {
            (value, 1) => value.x,
            _ => 0.0,
        }
    }
}
