//! Textures: colours and scalars over uv. A new one is a file here and a line in the registry below.

use glam::Vec2;
use serde::Deserialize;

use crate::arrays::Arrays;
use crate::error::SceneError;
use crate::math::Rgb;

/// Index into the scene's textures.
pub type TextureId = usize;

/// What each texture file provides.
pub(crate) trait TextureModel {
    /// The colour at `uv`.
    fn eval(&self, uv: Vec2) -> Rgb;
    /// The scalar at `uv`: Mitsuba's `eval_1`.
    fn eval_scalar(&self, uv: Vec2) -> f32;
    /// The scalar's gradient over uv: Mitsuba's `eval_1_grad`.
    fn gradient(&self, _uv: Vec2) -> Vec2 {
        Vec2::ZERO
    }
}

macro_rules! registry {
    ($($name:literal => $variant:ident in $module:ident;)*) => {
        $(mod $module;)*

        /// Part of the scene description: one texture.
        #[derive(Debug, Deserialize)]
        #[serde(tag = "type")]
        pub(crate) enum Description {
            $(#[serde(rename = $name)] $variant($module::Description),)*
        }

        /// A texture of the scene.
        #[derive(Debug)]
        pub enum Texture {
            $(#[doc = concat!("`", $name, "`")] $variant($module::$variant),)*
        }

        impl Texture {
            pub(crate) fn build(description: Description, arrays: &mut Arrays) -> Result<Self, SceneError> {
                Ok(match description {
                    $(Description::$variant(d) => Self::$variant($module::$variant::build(d, arrays)?),)*
                })
            }

            /// The colour at `uv`.
            #[inline]
            pub fn eval(&self, uv: Vec2) -> Rgb {
                match self { $(Self::$variant(t) => t.eval(uv),)* }
            }

            /// The scalar at `uv` (Mitsuba's `eval_1`).
            #[inline]
            pub fn eval_scalar(&self, uv: Vec2) -> f32 {
                match self { $(Self::$variant(t) => t.eval_scalar(uv),)* }
            }

            /// The scalar's gradient over uv (Mitsuba's `eval_1_grad`); zero where it has none.
            pub fn gradient(&self, uv: Vec2) -> Vec2 {
                match self { $(Self::$variant(t) => t.gradient(uv),)* }
            }
        }

        /// The names of all textures.
        pub const NAMES: &[&str] = &[$($name),*];
    };
}

registry! {
    "constant" => Constant in constant;
    "bitmap" => Bitmap in bitmap;
    "checkerboard" => Checkerboard in checkerboard;
}
