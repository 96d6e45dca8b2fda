//! Two textures in the squares of a board (Mitsuba's `checkerboard`).

use glam::Vec2;
use serde::Deserialize;

use super::{Texture, TextureModel, TexturePoint};
use crate::arrays::{Arrays, check_all_finite};
use crate::error::SceneError;
use crate::math::Rgb;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    id: String,
    color0: Box<super::Description>,
    color1: Box<super::Description>,
    to_uv: [f32; 9],
}

/// A board of 2 × 2 squares in each unit of uv.
#[derive(Debug)]
pub struct Checkerboard {
    colors: [Box<Texture>; 2],
    /// First two rows of the 3×3 map uv → board.
    to_uv: [[f32; 3]; 2],
}

impl Checkerboard {
    pub(crate) fn build(d: Description, arrays: &mut Arrays) -> Result<Self, SceneError> {
        check_all_finite(&d.to_uv, &format!("texture {:?}", d.id), "to_uv")?;
        let m = d.to_uv;
        Ok(Self {
            colors: [
                Box::new(Texture::build(*d.color0, arrays)?),
                Box::new(Texture::build(*d.color1, arrays)?),
            ],
            to_uv: [[m[0], m[1], m[2]], [m[3], m[4], m[5]]],
        })
    }

    /// Whether `uv` lies on a square of the first colour.
    fn first(&self, uv: Vec2) -> bool {
        let upper = |m: [f32; 3]| {
            let x = m[0] * uv.x + m[1] * uv.y + m[2];
            x - x.floor() > 0.5
        };
        upper(self.to_uv[0]) == upper(self.to_uv[1])
    }
}

impl TextureModel for Checkerboard {
    fn memory(&self) -> usize {
        self.colors.iter().map(|c| c.memory()).sum()
    }

    fn eval(&self, at: TexturePoint<'_>) -> Rgb {
        self.colors[usize::from(!self.first(at.uv))].eval(at)
    }

    fn eval_scalar(&self, at: TexturePoint<'_>) -> f32 {
        // Mitsuba 3.9 swaps the two colours where it reads a scalar.
        self.colors[usize::from(self.first(at.uv))].eval_scalar(at)
    }
}
