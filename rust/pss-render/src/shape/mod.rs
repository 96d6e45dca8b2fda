//! Shapes: geometry for Embree, shading points, and sampling of their surfaces as Mitsuba does it.
//! A new one is a file here and a line in the registry below.

use std::sync::Arc;

use embree4::{GeomId, Hit, Ray, SceneBuilder};
use glam::Vec2;
use serde::Deserialize;

use crate::arrays::Arrays;
use crate::bsdf::BsdfId;
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::Vec3;
use attribute::Attribute;

pub(crate) mod affine;
pub(crate) mod attribute;

/// A point drawn on a shape as seen from a reference point.
#[derive(Clone, Copy, Debug)]
pub struct SurfaceSample {
    /// Point.
    pub p: Vec3,
    /// Shading normal there.
    pub n: Vec3,
    /// Texture coordinates.
    pub uv: Vec2,
    /// Density in solid angle at the reference point.
    pub pdf: f32,
}

/// Whether ∂p/∂u and ∂p/∂v are of interest; only few BSDFs look at them, and on a mesh they take a third of the work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Tangents {
    /// They must be right.
    Wanted,
    /// They may be anything.
    Unused,
}

/// What each shape file provides.
pub(crate) trait ShapeModel {
    /// Hands the geometry to Embree. `groups`: what instances are views of.
    fn attach(
        &self,
        builder: &mut SceneBuilder,
        groups: &[embree4::Scene],
    ) -> Result<GeomId, SceneError>;

    /// The surface at a hit; `shape` is filled in by the caller.
    fn interaction(&self, ray: &Ray, hit: &Hit, tangents: Tangents) -> Interaction;

    /// Surface area, world space.
    fn area(&self) -> f32;

    /// Draws a point by area: (p, n, uv), density 1/area. The numbers mean what they mean in Mitsuba's
    /// `sample_position` of the same shape.
    fn sample_position(&self, u: [f32; 2]) -> (Vec3, Vec3, Vec2);

    /// Draws a point as seen from `reference`; by area unless the shape knows better.
    fn sample_direction(&self, reference: Vec3, u: [f32; 2]) -> SurfaceSample {
        let (p, n, uv) = self.sample_position(u);
        let d = p - reference;
        let pdf = solid_angle_pdf(1.0 / self.area(), d, n);
        SurfaceSample { p, n, uv, pdf }
    }

    /// Density of [`ShapeModel::sample_direction`] at a surface point `p` with normal `n`.
    fn pdf_direction(&self, reference: Vec3, p: Vec3, n: Vec3) -> f32 {
        solid_angle_pdf(1.0 / self.area(), p - reference, n)
    }

    /// Number of triangles; 0 for exact shapes.
    fn triangles(&self) -> usize {
        0
    }

    /// Triangles of no area, left out.
    fn degenerate(&self) -> usize {
        0
    }

    /// Attributes of its vertices and faces.
    fn attributes(&self) -> Arc<[Attribute]> {
        Arc::default()
    }

    /// Bytes held by its arrays.
    fn memory(&self) -> usize {
        0
    }
}

/// Area density → solid angle, for the vector `d` from the reference point; 0 where it is not finite.
#[inline]
pub(crate) fn solid_angle_pdf(area_pdf: f32, d: Vec3, n: Vec3) -> f32 {
    let distance_2 = d.length_squared();
    let pdf = area_pdf * distance_2 * distance_2.sqrt() / d.dot(n).abs();
    if pdf.is_finite() { pdf } else { 0.0 }
}

/// What all shapes share.
#[derive(Debug)]
pub struct Common {
    /// Mitsuba's id, or a stable key made by the export.
    pub id: String,
    /// BSDF.
    pub bsdf: BsdfId,
    /// Area emitter on it.
    pub emitter: Option<usize>,
}

macro_rules! registry {
    ($($name:literal => $variant:ident in $module:ident;)*) => {
        $(mod $module;)*

        /// Part of the scene description: one shape.
        #[derive(Debug, Deserialize)]
        #[serde(tag = "type")]
        pub(crate) enum Description {
            $(#[serde(rename = $name)] $variant($module::Description),)*
        }

        /// The geometry of a shape.
        #[derive(Debug)]
        pub enum Shape {
            $(#[doc = concat!("`", $name, "`")] $variant($module::$variant),)*
        }

        impl Shape {
            pub(crate) fn build(
                description: Description,
                arrays: &mut Arrays,
            ) -> Result<(Common, Self), SceneError> {
                Ok(match description {
                    $(Description::$variant(d) => {
                        let common = Common { id: d.id.clone(), bsdf: d.bsdf, emitter: d.emitter };
                        (common, Self::$variant($module::$variant::build(d, arrays)?))
                    })*
                })
            }

            pub(crate) fn model(&self) -> &dyn ShapeModel {
                match self { $(Self::$variant(s) => s,)* }
            }

            /// The surface at a hit.
            #[inline]
            pub(crate) fn interaction(&self, ray: &Ray, hit: &Hit, tangents: Tangents) -> Interaction {
                match self { $(Self::$variant(s) => s.interaction(ray, hit, tangents),)* }
            }

            /// The plugin's name.
            pub fn name(&self) -> &'static str {
                match self { $(Self::$variant(_) => $name,)* }
            }
        }

        /// The names of all shapes.
        pub const NAMES: &[&str] = &[$($name),*];
    };
}

registry! {
    "cylinder" => Cylinder in cylinder;
    "disk" => Disk in disk;
    "instance" => Instance in instance;
    "mesh" => Mesh in mesh;
    "rectangle" => Rectangle in rectangle;
    "sphere" => Sphere in sphere;
}
