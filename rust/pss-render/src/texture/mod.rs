//! Textures: colours and scalars over uv. A new one is a file here and a line in the registry below.

use glam::Vec2;
use serde::Deserialize;

use crate::arrays::Arrays;
use crate::error::SceneError;
use crate::interaction::MeshPoint;
use crate::math::Rgb;
use crate::shape::attribute::Attributes;

/// Index into the scene's textures.
pub type TextureId = usize;

/// Where a texture is looked up.
#[derive(Clone, Copy, Debug)]
pub struct TexturePoint<'a> {
    /// Texture coordinates.
    pub uv: Vec2,
    /// The place on its triangle, and the attributes of the scene's meshes; `None` where only uv are known.
    pub mesh: Option<(MeshPoint, &'a Attributes)>,
}

impl From<Vec2> for TexturePoint<'_> {
    fn from(uv: Vec2) -> Self {
        Self { uv, mesh: None }
    }
}

/// What each texture file provides.
pub(crate) trait TextureModel {
    /// The colour.
    fn eval(&self, at: TexturePoint<'_>) -> Rgb;
    /// The scalar: Mitsuba's `eval_1`.
    fn eval_scalar(&self, at: TexturePoint<'_>) -> f32;
    /// Bytes of its values.
    fn memory(&self) -> usize {
        0
    }
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

            /// The colour.
            #[inline]
            pub fn eval(&self, at: TexturePoint<'_>) -> Rgb {
                match self { $(Self::$variant(t) => t.eval(at),)* }
            }

            /// The scalar (Mitsuba's `eval_1`).
            #[inline]
            pub fn eval_scalar(&self, at: TexturePoint<'_>) -> f32 {
                match self { $(Self::$variant(t) => t.eval_scalar(at),)* }
            }

            /// Bytes of its values.
            pub fn memory(&self) -> usize {
                match self { $(Self::$variant(t) => t.memory(),)* }
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
    "mesh_attribute" => MeshAttribute in mesh_attribute;
}
