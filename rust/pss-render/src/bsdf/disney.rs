//! What `principled` and `principledthin` share: Burley's terms (*Physically Based Shading at Disney*, 2012;
//! *Extending the Disney BRDF to a BSDF with Integrated Subsurface Scattering*, 2015).

use std::f32::consts::{PI, TAU};

use super::microfacet::{Distribution, Kind};
use super::{Builder, ShadingPoint};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3, luminance, safe_sqrt};
use crate::texture::{Texture, TextureId};
use crate::warp::INV_PI;

/// A weight that is often zero: its texture, or nothing where it is zero everywhere.
pub(super) type Weight = Option<TextureId>;

pub(super) fn weight(b: &Builder<'_>, texture: TextureId) -> Result<Weight, SceneError> {
    let texture = b.texture(texture)?;
    let is_zero = match b.materials.texture(texture) {
        constant @ Texture::Constant(_) => constant.eval_scalar(glam::Vec2::ZERO.into()) == 0.0,
        _ => false,
    };
    Ok((!is_zero).then_some(texture))
}

#[inline]
pub(super) fn scalar(at: ShadingPoint<'_>, weight: Weight) -> f32 {
    weight.map_or(0.0, |t| at.scalar(t))
}

/// GGX of Burley's roughness, stretched along u.
pub(super) fn distribution(roughness: f32, anisotropic: f32) -> Distribution {
    let alpha = roughness * roughness;
    let aspect = safe_sqrt(1.0 - 0.9 * anisotropic);
    let (u, v) = ((alpha / aspect).max(1e-3), (alpha * aspect).max(1e-3));
    Distribution::new(Kind::Ggx, u, v, true)
}

/// (1 − cos θ)⁵.
pub(super) fn schlick_weight(cos_theta: f32) -> f32 {
    (1.0 - cos_theta).clamp(0.0, 1.0).powi(5)
}

/// Reflectance at normal incidence.
pub(super) fn schlick_r0(eta: f32) -> f32 {
    ((eta - 1.0) / (eta + 1.0)).powi(2)
}

/// Schlick's approximation, at the angle on the thinner side.
pub(super) fn schlick(r0: Rgb, cos_theta_i: f32, eta: f32) -> Rgb {
    let outside = cos_theta_i >= 0.0;
    let (eta_it, eta_ti) = if outside {
        (eta, 1.0 / eta)
    } else {
        (1.0 / eta, eta)
    };
    let weight = schlick_weight(if eta_it > 1.0 {
        cos_theta_i.abs()
    } else {
        safe_sqrt(1.0 - (1.0 - cos_theta_i * cos_theta_i) * eta_ti * eta_ti)
    });
    Rgb::splat(weight) + r0 * (1.0 - weight)
}

/// A colour without its brightness.
pub(super) fn tint(base_color: Rgb) -> Rgb {
    let y = luminance(base_color);
    if y > 0.0 { base_color / y } else { Rgb::ONE }
}

/// The diffuse base: diffuse and retro-reflection, flattened towards Hanrahan and Krueger's subsurface term.
/// Without albedo; with |cos θ_o|.
pub(super) fn diffuse(roughness: f32, flatness: f32, cos_i: f32, cos_o: f32, cos_d: f32) -> f32 {
    let (f_i, f_o) = (schlick_weight(cos_i), schlick_weight(cos_o));
    let r_r = 2.0 * roughness * cos_d * cos_d;
    let lambert = (1.0 - 0.5 * f_i) * (1.0 - 0.5 * f_o);
    let value = lambert + r_r * (f_o + f_i + f_o * f_i * (r_r - 1.0));
    let value = if flatness == 0.0 {
        value
    } else {
        let fss90 = 0.5 * r_r;
        let fss = (1.0 + (fss90 - 1.0) * f_o) * (1.0 + (fss90 - 1.0) * f_i);
        let subsurface = 1.25 * (fss * (1.0 / (cos_o + cos_i) - 0.5) + 0.5);
        value + (subsurface - value) * flatness
    };
    value * cos_o * INV_PI
}

/// The cloth-like rim, with |cos θ_o|.
pub(super) fn sheen(base_color: Rgb, sheen_tint: f32, cos_o: f32, cos_d: f32) -> Rgb {
    let colour = if sheen_tint == 0.0 {
        Rgb::ONE
    } else {
        Rgb::ONE.lerp(tint(base_color), sheen_tint)
    };
    colour * (schlick_weight(cos_d.abs()) * cos_o)
}

/// Normals of the clear coat: Burley's GTR with γ = 1, all normals drawn.
pub(super) struct Gtr1 {
    alpha_2: f32,
}

impl Gtr1 {
    pub(super) fn new(gloss: f32) -> Self {
        let alpha = 0.1 + (0.001 - 0.1) * gloss;
        Self {
            alpha_2: alpha * alpha,
        }
    }

    pub(super) fn eval(&self, m: Vec3) -> f32 {
        let a = self.alpha_2;
        let d = (a - 1.0) / (PI * a.ln() * (1.0 + (a - 1.0) * m.z * m.z));
        if d * m.z > 1e-20 { d } else { 0.0 }
    }

    pub(super) fn pdf(&self, m: Vec3) -> f32 {
        if m.z < 0.0 { 0.0 } else { m.z * self.eval(m) }
    }

    pub(super) fn sample(&self, u: [f32; 2]) -> Vec3 {
        let (sin_phi, cos_phi) = (TAU * u[0]).sin_cos();
        let cos_2 = (1.0 - self.alpha_2.powf(1.0 - u[1])) / (1.0 - self.alpha_2);
        let sin = safe_sqrt(1.0 - cos_2);
        Vec3::new(cos_phi * sin, sin_phi * sin, safe_sqrt(cos_2))
    }
}

/// Smith's G₁ of the clear coat, whose roughness for masking is fixed.
pub(super) fn clearcoat_g1(v: Vec3, m: Vec3) -> f32 {
    if v.dot(m) * v.z <= 0.0 {
        return 0.0;
    }
    let cos_2 = v.z * v.z;
    2.0 / (1.0 + (1.0 + 0.0625 * (1.0 - cos_2) / cos_2).sqrt())
}

/// Whether both directions see the microfacet `m` from the side that `wi` is on: for reflection `wo` from the
/// same one, for transmission from the other.
pub(super) fn facets_agree(m: Vec3, wi: Vec3, wo: Vec3, reflects: bool) -> bool {
    let m = m * 1f32.copysign(wi.z);
    wi.dot(m) > 0.0 && (wo.dot(m) > 0.0) == reflects && wo.dot(m) != 0.0
}
