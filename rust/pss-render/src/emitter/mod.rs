//! Emitters: what they radiate and how they are sampled from a point, as Mitsuba does it. A new one is a
//! file here and a line in the registry below.

use serde::Deserialize;

use crate::arrays::Arrays;
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::{Rgb, Vec3};
use crate::scene::Scene;

/// Light drawn from an emitter as seen from a reference point.
#[derive(Clone, Copy, Debug)]
pub struct EmitterSample {
    /// Unit direction from the reference point to the light.
    pub d: Vec3,
    /// The point that the shadow ray ends at; `None` for light from infinity.
    pub target: Option<Vec3>,
    /// Incident radiance (W·sr⁻¹·m⁻²); for `delta` light, irradiance across `d` (W·m⁻²).
    pub radiance: Rgb,
    /// Density of `d` in solid angle; 1 for `delta` light.
    pub pdf: f32,
    /// No BSDF-sampled ray can find this light.
    pub delta: bool,
}

/// What each emitter file provides.
pub(crate) trait EmitterModel {
    /// Draws light towards `reference`. `None`: none from here.
    fn sample_direction(
        &self,
        scene: &Scene,
        reference: Vec3,
        u: [f32; 2],
    ) -> Option<EmitterSample>;

    /// Density of [`EmitterModel::sample_direction`] for the unit direction `d`, that hit `surface` or
    /// escaped; 0 for light that no ray can find.
    fn pdf_direction(
        &self,
        _scene: &Scene,
        _reference: Vec3,
        _d: Vec3,
        _surface: Option<&Interaction>,
    ) -> f32 {
        0.0
    }

    /// Radiance that arrives along a ray of direction `d` that hit `surface` or escaped; none of light that
    /// no ray can find.
    fn eval(&self, _scene: &Scene, _d: Vec3, _surface: Option<&Interaction>) -> Rgb {
        Rgb::ZERO
    }

    /// Whether it surrounds the scene, so that escaping rays see it.
    fn is_environment(&self) -> bool {
        false
    }

    /// Whether a BSDF-sampled ray can find it.
    fn can_be_hit(&self) -> bool {
        true
    }

    /// Whether it is drawn wherever it shines, so that next-event estimation alone finds all of its light.
    fn drawn_everywhere(&self) -> bool {
        true
    }

    /// The shape that it sits on.
    fn shape(&self) -> Option<usize> {
        None
    }
}

/// What an emitter's parts refer to, checked while the scene is built.
pub(crate) struct Builder<'a> {
    pub(crate) textures: usize,
    pub(crate) shapes: usize,
    pub(crate) arrays: &'a mut Arrays,
}

macro_rules! registry {
    ($($name:literal => $variant:ident in $module:ident;)*) => {
        $(mod $module;)*

        /// Part of the scene description: one emitter.
        #[derive(Debug, Deserialize)]
        #[serde(tag = "type")]
        pub(crate) enum Description {
            $(#[serde(rename = $name)] $variant($module::Description),)*
        }

        impl Description {
            pub(crate) fn id(&self) -> &str {
                match self { $(Self::$variant(d) => &d.id,)* }
            }

            pub(crate) fn sampling_weight(&self) -> f32 {
                match self { $(Self::$variant(d) => d.sampling_weight,)* }
            }
        }

        /// An emitter of the scene.
        #[derive(Debug)]
        pub enum Emitter {
            $(#[doc = concat!("`", $name, "`")] $variant($module::$variant),)*
        }

        impl Emitter {
            pub(crate) fn build(description: Description, builder: Builder<'_>) -> Result<Self, SceneError> {
                Ok(match description {
                    $(Description::$variant(d) => Self::$variant($module::$variant::build(d, builder)?),)*
                })
            }

            pub(crate) fn model(&self) -> &dyn EmitterModel {
                match self { $(Self::$variant(e) => e,)* }
            }

            /// Whether a BSDF-sampled ray can find it.
            pub fn can_be_hit(&self) -> bool {
                self.model().can_be_hit()
            }

            /// The plugin's name.
            pub fn name(&self) -> &'static str {
                match self { $(Self::$variant(_) => $name,)* }
            }
        }

        /// The names of all emitters.
        pub const NAMES: &[&str] = &[$($name),*];
    };
}

fn one() -> f32 {
    1.0
}

registry! {
    "area" => Area in area;
    "constant" => Constant in constant;
    "directional" => Directional in directional;
    "directionalarea" => DirectionalArea in directionalarea;
    "envmap" => Envmap in envmap;
    "point" => Point in point;
    "projector" => Projector in projector;
    "spot" => Spot in spot;
    "sun" => Sun in sun;
}
