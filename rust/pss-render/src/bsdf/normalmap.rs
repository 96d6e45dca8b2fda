//! A BSDF about the normals of a texture, in the surface's uv frame, with the soft terminator of Estevez,
//! Lecocq and Stein (2019) if asked for.

use serde::Deserialize;

use super::perturbed::Perturbed;
use super::{BsdfId, BsdfModel, BsdfSample, Builder, Materials, ShadingPoint};
use crate::error::SceneError;
use crate::math::{Frame, Rgb, Vec3};
use crate::texture::TextureId;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    nested: BsdfId,
    normalmap: TextureId,
    flip_invalid_normals: bool,
    use_shadowing_function: bool,
}

/// `normalmap`
#[derive(Debug)]
pub struct NormalMap {
    nested: BsdfId,
    normalmap: TextureId,
    flip_invalid_normals: bool,
    use_shadowing_function: bool,
}

impl NormalMap {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        Ok(Self {
            nested: b.nested(d.nested)?,
            normalmap: b.texture(d.normalmap)?,
            flip_invalid_normals: d.flip_invalid_normals,
            use_shadowing_function: d.use_shadowing_function,
        })
    }

    fn perturbed<'a>(&self, at: ShadingPoint<'a>, wi: Vec3) -> Perturbed<'a> {
        let mut n = at.rgb(self.normalmap) * 2.0 - Vec3::ONE;
        // Normals that face away from wi are turned about the surface's own.
        if self.flip_invalid_normals && wi.z * wi.dot(n) <= 0.0 {
            n = Vec3::new(-n.x, -n.y, n.z);
        }
        Perturbed {
            bsdf: at.materials.bsdf(self.nested),
            at: ShadingPoint {
                surface: None, // another frame; the export refuses bump maps in here
                ..at
            },
            frame: Frame::from_tangent(n.normalize_or(Vec3::Z), Vec3::X),
            soften: self.use_shadowing_function,
        }
    }
}

impl BsdfModel for NormalMap {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        self.perturbed(at, wi).sample(wi, u)
    }

    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        self.perturbed(at, wi).eval_pdf(wi, wo)
    }

    fn delta_probability(&self, at: ShadingPoint<'_>, wi: Vec3) -> f32 {
        self.perturbed(at, wi).delta_probability(wi)
    }

    fn sample_delta(&self, at: ShadingPoint<'_>, wi: Vec3, u: f32) -> Option<BsdfSample> {
        self.perturbed(at, wi).sample_delta(wi, u)
    }

    fn transmits(&self, m: &Materials) -> bool {
        // A normal may face away from wi; what is lit from below then reflects to the other side.
        m.bsdf(self.nested).transmits(m) || m.bsdf(self.nested).two_sided(m)
    }

    fn two_sided(&self, m: &Materials) -> bool {
        m.bsdf(self.nested).two_sided(m)
    }

    fn smooth(&self, m: &Materials) -> bool {
        m.bsdf(self.nested).smooth(m)
    }

    fn anisotropic(&self, _: &Materials) -> bool {
        true
    }

    fn delta(&self, m: &Materials) -> bool {
        m.bsdf(self.nested).delta(m)
    }
}
