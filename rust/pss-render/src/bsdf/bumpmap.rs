//! A BSDF about the normals of a displaced surface (Blinn 1978), whose heights are a texture, with the soft
//! terminator of Estevez, Lecocq and Stein (2019) if asked for.

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
    height: TextureId,
    scale: f32,
    flip_invalid_normals: bool,
    use_shadowing_function: bool,
}

/// `bumpmap`
#[derive(Debug)]
pub struct BumpMap {
    nested: BsdfId,
    height: TextureId,
    scale: f32,
    flip_invalid_normals: bool,
    use_shadowing_function: bool,
}

impl BumpMap {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        b.check(d.scale.is_finite(), "scale", d.scale, "finite")?;
        Ok(Self {
            nested: b.nested(d.nested)?,
            height: b.texture(d.height)?,
            scale: d.scale,
            flip_invalid_normals: d.flip_invalid_normals,
            use_shadowing_function: d.use_shadowing_function,
        })
    }

    fn perturbed<'a>(&self, at: ShadingPoint<'a>, wi: Vec3) -> Perturbed<'a> {
        let frame = at.surface.map_or_else(
            || Frame::from_tangent(Vec3::Z, Vec3::X),
            |(si, frame)| {
                let slope = at.materials.texture(self.height).gradient(at.uv) * self.scale;
                let n = si.shading_normal;
                let dp_du = si.dp_du + n * (slope.x - n.dot(si.dp_du));
                let dp_dv = si.dp_dv + n * (slope.y - n.dot(si.dp_dv));
                let bumped = dp_du.cross(dp_dv).normalize_or(n);
                let bumped = bumped * 1f32.copysign(si.n.dot(bumped));
                let mut n = frame.to_local(bumped);
                // Normals that face away from wi are turned about the surface's own.
                if self.flip_invalid_normals && wi.z * wi.dot(n) <= 0.0 {
                    n = Vec3::new(-n.x, -n.y, n.z);
                }
                // As Mitsuba: ∂p/∂u in world space against a local normal. It turns the azimuth alone.
                Frame::from_tangent(n, si.dp_du)
            },
        );
        Perturbed {
            bsdf: at.materials.bsdf(self.nested),
            at,
            frame,
            soften: self.use_shadowing_function,
        }
    }
}

impl BsdfModel for BumpMap {
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
