//! BSDFs: formulas from the papers, values as Mitsuba's. A new one is a file here and a line in the
//! registry below; the shared invariant tests then cover it.
//!
//! Directions are in the local frame (z = shading normal). `wi` points back along the path (to the
//! camera), `wo` onwards (to the light): Mitsuba's convention for paths from the camera.

use glam::Vec2;
use serde::Deserialize;

use crate::error::SceneError;
use crate::interaction::{Interaction, MeshPoint};
use crate::math::{Frame, Rgb, Vec3};
use crate::shape::attribute::Attributes;
use crate::texture::{Texture, TextureId, TexturePoint};

mod disney;
mod fresnel;
mod microfacet;
mod perturbed;

/// Index into the scene's BSDFs.
pub type BsdfId = usize;

/// A direction drawn from a BSDF.
#[derive(Clone, Copy, Debug)]
pub struct BsdfSample {
    /// Local direction onwards.
    pub wo: Vec3,
    /// f·|cos θ_o| ÷ pdf.
    pub weight: Rgb,
    /// Density in solid angle; the lobe's probability where `delta` is set.
    pub pdf: f32,
    /// A mirror or a straight passage: NEE cannot join it, and no hemisphere can carry it.
    pub delta: bool,
}

/// The tables that nested BSDFs and their textures are looked up in.
#[derive(Debug, Default)]
pub struct Materials {
    pub(crate) bsdfs: Vec<Bsdf>,
    pub(crate) textures: Vec<Texture>,
    pub(crate) attributes: Attributes,
}

impl Materials {
    /// A BSDF of the scene.
    #[inline]
    pub fn bsdf(&self, id: BsdfId) -> &Bsdf {
        &self.bsdfs[id]
    }

    /// Number of BSDFs, nested ones included.
    pub fn bsdfs(&self) -> usize {
        self.bsdfs.len()
    }

    /// Number of textures.
    pub fn textures(&self) -> usize {
        self.textures.len()
    }

    /// Attributes of the meshes.
    pub fn attributes(&self) -> &Attributes {
        &self.attributes
    }

    /// A texture of the scene.
    #[inline]
    pub fn texture(&self, id: TextureId) -> &Texture {
        &self.textures[id]
    }
}

/// Where a BSDF is evaluated.
#[derive(Clone, Copy, Debug)]
pub struct ShadingPoint<'a> {
    /// Texture coordinates.
    pub uv: Vec2,
    /// The place on its triangle, for attributes of meshes.
    pub mesh: MeshPoint,
    /// Textures and nested BSDFs.
    pub materials: &'a Materials,
    /// The surface and the frame of the local directions, for bump maps; flat where there is none.
    pub surface: Option<(&'a Interaction, &'a Frame)>,
}

impl ShadingPoint<'_> {
    #[inline]
    fn texture_point(&self) -> TexturePoint<'_> {
        TexturePoint {
            uv: self.uv,
            mesh: Some((self.mesh, &self.materials.attributes)),
        }
    }

    #[inline]
    pub(crate) fn rgb(&self, texture: TextureId) -> Rgb {
        self.materials.textures[texture].eval(self.texture_point())
    }

    #[inline]
    pub(crate) fn scalar(&self, texture: TextureId) -> f32 {
        self.materials.textures[texture].eval_scalar(self.texture_point())
    }
}

/// A number that chose the part [from, from + width) of [0, 1), stretched over [0, 1) to be used again.
#[inline]
pub(crate) fn reuse(u: f32, from: f32, width: f32) -> f32 {
    ((u - from) / width).clamp(0.0, 1.0 - f32::EPSILON / 2.0)
}

/// A delta lobe; `None` where its weight or probability is zero.
#[inline]
fn delta_lobe(wo: Vec3, weight: Rgb, probability: f32) -> Option<BsdfSample> {
    (probability > 0.0).then_some(BsdfSample {
        wo,
        weight,
        pdf: probability,
        delta: true,
    })
}

/// Whether a roughness along u and one along v may differ, so that the azimuth matters.
fn alphas_differ(m: &Materials, alpha_u: TextureId, alpha_v: TextureId) -> bool {
    match (m.texture(alpha_u), m.texture(alpha_v)) {
        _ if alpha_u == alpha_v => false,
        (u @ Texture::Constant(_), v @ Texture::Constant(_)) => {
            u.eval_scalar(Vec2::ZERO.into()) != v.eval_scalar(Vec2::ZERO.into())
        }
        _ => true,
    }
}

/// What each BSDF file provides.
pub(crate) trait BsdfModel {
    /// Draws `wo`; the lobe is chosen from `u[0]`, which is then rescaled and reused. `None`: the
    /// light path ends here (no such direction, or its weight is zero).
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample>;

    /// f·|cos θ_o| and the density of [`BsdfModel::sample`] in solid angle, delta lobes left out.
    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32);

    /// Probability that [`BsdfModel::sample`] takes a delta lobe.
    fn delta_probability(&self, _at: ShadingPoint<'_>, _wi: Vec3) -> f32 {
        0.0
    }

    /// Draws among the delta lobes alone, in proportion to their probabilities, from one number in [0, 1).
    /// Weight and probability are those of [`BsdfModel::sample`].
    fn sample_delta(&self, _at: ShadingPoint<'_>, _wi: Vec3, _u: f32) -> Option<BsdfSample> {
        None
    }

    /// Whether a smooth lobe carries light to the other side.
    fn transmits(&self, _materials: &Materials) -> bool {
        false
    }

    /// Whether anything happens for `wi` below the surface.
    fn two_sided(&self, _materials: &Materials) -> bool {
        false
    }

    /// Whether any lobe is smooth, so that NEE can join it.
    fn smooth(&self, _materials: &Materials) -> bool {
        true
    }

    /// Whether any lobe is a delta lobe, which NEE cannot join.
    fn delta(&self, _materials: &Materials) -> bool {
        false
    }

    /// Whether the azimuth matters, so that Mitsuba's uv frame must be kept.
    fn anisotropic(&self, _materials: &Materials) -> bool {
        false
    }
}

/// What a BSDF's parts refer to, checked while the scene is built.
pub(crate) struct Builder<'a> {
    pub(crate) materials: &'a Materials,
    pub(crate) id: String,
}

impl Builder<'_> {
    fn owner(&self) -> String {
        format!("bsdf {:?}", self.id)
    }

    pub(crate) fn texture(&self, id: TextureId) -> Result<TextureId, SceneError> {
        crate::arrays::check_index(id, self.materials.textures.len(), &self.owner(), "texture")?;
        Ok(id)
    }

    pub(crate) fn optional(&self, id: Option<TextureId>) -> Result<Option<TextureId>, SceneError> {
        id.map(|id| self.texture(id)).transpose()
    }

    /// A nested BSDF must have been built already, so no BSDF can contain itself.
    pub(crate) fn nested(&self, id: BsdfId) -> Result<BsdfId, SceneError> {
        if id < self.materials.bsdfs.len() {
            Ok(id)
        } else {
            Err(SceneError::Nested {
                id: self.id.clone(),
                nested: id,
            })
        }
    }

    pub(crate) fn check(
        &self,
        ok: bool,
        name: &'static str,
        value: f32,
        rule: &'static str,
    ) -> Result<(), SceneError> {
        crate::arrays::check(ok, &self.owner(), name, value, rule)
    }
}

macro_rules! registry {
    ($($name:literal => $variant:ident in $module:ident;)*) => {
        $(mod $module;)*

        /// Part of the scene description: one BSDF.
        #[derive(Debug, Deserialize)]
        #[serde(tag = "type")]
        pub(crate) enum Description {
            $(#[serde(rename = $name)] $variant($module::Description),)*
        }

        impl Description {
            fn id(&self) -> &str {
                match self { $(Self::$variant(d) => &d.id,)* }
            }
        }

        /// A BSDF of the scene.
        #[derive(Debug)]
        pub enum Bsdf {
            $(#[doc = concat!("`", $name, "`")] $variant($module::$variant),)*
        }

        impl Bsdf {
            pub(crate) fn build(
                description: Description,
                materials: &Materials,
            ) -> Result<Self, SceneError> {
                let builder = Builder { materials, id: description.id().to_owned() };
                Ok(match description {
                    $(Description::$variant(d) => Self::$variant($module::$variant::build(d, builder)?),)*
                })
            }

            /// Draws a direction onwards from two numbers; `None` ends the path.
            #[inline]
            pub fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
                match self { $(Self::$variant(b) => b.sample(at, wi, u),)* }
            }

            /// f·|cos θ_o| and the density of [`Bsdf::sample`] in solid angle, delta lobes left out.
            #[inline]
            pub fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
                match self { $(Self::$variant(b) => b.eval_pdf(at, wi, wo),)* }
            }

            /// Probability that [`Bsdf::sample`] takes a delta lobe.
            #[inline]
            pub fn delta_probability(&self, at: ShadingPoint<'_>, wi: Vec3) -> f32 {
                match self { $(Self::$variant(b) => b.delta_probability(at, wi),)* }
            }

            /// Draws among the delta lobes alone from one number; weight and probability are those of
            /// [`Bsdf::sample`]. `None` ends the path.
            #[inline]
            pub fn sample_delta(&self, at: ShadingPoint<'_>, wi: Vec3, u: f32) -> Option<BsdfSample> {
                match self { $(Self::$variant(b) => b.sample_delta(at, wi, u),)* }
            }

            /// Whether a smooth lobe carries light to the other side.
            pub fn transmits(&self, materials: &Materials) -> bool {
                match self { $(Self::$variant(b) => b.transmits(materials),)* }
            }

            /// Whether anything happens for `wi` below the surface.
            pub fn two_sided(&self, materials: &Materials) -> bool {
                match self { $(Self::$variant(b) => b.two_sided(materials),)* }
            }

            /// Whether any lobe is smooth, so that NEE can join it.
            pub fn smooth(&self, materials: &Materials) -> bool {
                match self { $(Self::$variant(b) => b.smooth(materials),)* }
            }

            /// Whether any lobe is a delta lobe, which NEE cannot join.
            pub fn delta(&self, materials: &Materials) -> bool {
                match self { $(Self::$variant(b) => b.delta(materials),)* }
            }

            /// Whether the azimuth matters, so that Mitsuba's uv frame is kept.
            pub fn anisotropic(&self, materials: &Materials) -> bool {
                match self { $(Self::$variant(b) => b.anisotropic(materials),)* }
            }

            /// The plugin's name.
            pub fn name(&self) -> &'static str {
                match self { $(Self::$variant(_) => $name,)* }
            }
        }

        /// The names of all BSDFs.
        pub const NAMES: &[&str] = &[$($name),*];
    };
}

registry! {
    "blendbsdf" => BlendBsdf in blendbsdf;
    "bumpmap" => BumpMap in bumpmap;
    "conductor" => Conductor in conductor;
    "dielectric" => Dielectric in dielectric;
    "diffuse" => Diffuse in diffuse;
    "mask" => Mask in mask;
    "normalmap" => NormalMap in normalmap;
    "null" => Null in null;
    "plastic" => Plastic in plastic;
    "principled" => Principled in principled;
    "principledthin" => PrincipledThin in principledthin;
    "roughconductor" => RoughConductor in roughconductor;
    "roughdielectric" => RoughDielectric in roughdielectric;
    "roughplastic" => RoughPlastic in roughplastic;
    "thindielectric" => ThinDielectric in thindielectric;
    "twosided" => TwoSided in twosided;
}
