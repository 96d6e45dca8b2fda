//! One colour everywhere (Mitsuba's `srgb`, `uniform` and plain values).

use serde::Deserialize;

use super::{TextureModel, TexturePoint};
use crate::arrays::{Arrays, check_all_finite};
use crate::error::SceneError;
use crate::math::Rgb;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    id: String,
    value: [f32; 3],
}

/// A constant colour; a scalar is three equal channels.
#[derive(Debug)]
pub struct Constant {
    value: Rgb,
    scalar: f32,
}

impl Constant {
    pub(crate) fn build(d: Description, _arrays: &mut Arrays) -> Result<Self, SceneError> {
        check_all_finite(&d.value, &format!("texture {:?}", d.id), "value")?;
        Ok(Self {
            value: Rgb::from_array(d.value),
            // As Mitsuba: the channels' average for one colour, but the luminance for a bitmap's.
            scalar: d.value.iter().sum::<f32>() / 3.0,
        })
    }
}

impl TextureModel for Constant {
    #[inline]
    fn eval(&self, _at: TexturePoint<'_>) -> Rgb {
        self.value
    }

    #[inline]
    fn eval_scalar(&self, _at: TexturePoint<'_>) -> f32 {
        self.scalar
    }
}
