//! A diffuse base under a rough dielectric coat, with the light that the interface traps accounted for
//! (Mitsuba's `roughplastic`; Weidlich and Wilkie 2007 for the layering).

use serde::Deserialize;

use super::microfacet::{Distribution, Kind};
use super::{BsdfModel, BsdfSample, Builder, ShadingPoint, fresnel};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3, reflect};
use crate::texture::TextureId;
use crate::warp::{INV_PI, cosine_hemisphere_pdf, square_to_cosine_hemisphere};

/// Nodes of the transmittance table over cos θ.
const RESOLUTION: usize = 64;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    distribution: Kind,
    alpha: f32,
    sample_visible: bool,
    nonlinear: bool,
    int_ior_over_ext_ior: f32,
    diffuse_reflectance: TextureId,
    specular_reflectance: Option<TextureId>,
    specular_sampling_weight: f32,
}

/// `roughplastic`
#[derive(Debug)]
pub struct RoughPlastic {
    distribution: Distribution,
    eta: f32,
    nonlinear: bool,
    diffuse_reflectance: TextureId,
    specular_reflectance: Option<TextureId>,
    specular_sampling_weight: f32,
    /// Share of light let in through the rough interface, over cos θ in equal steps.
    external_transmittance: Vec<f32>,
    /// Share of diffuse light inside that the interface throws back.
    internal_reflectance: f32,
}

impl RoughPlastic {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let eta = d.int_ior_over_ext_ior;
        b.check(d.alpha.is_finite() && d.alpha >= 0.0, "alpha", d.alpha, "finite and not negative")?;
        b.check(
            eta.is_finite() && eta > 0.0 && eta != 1.0,
            "int_ior / ext_ior",
            eta,
            "positive, finite and not 1",
        )?;
        let weight = d.specular_sampling_weight;
        b.check((0.0..=1.0).contains(&weight), "specular_sampling_weight", weight, "in [0, 1]")?;
        // The tables need visible normals, whatever the BSDF itself samples.
        let tabulated = Distribution::new(d.distribution, d.alpha, d.alpha, true);
        let nodes: [f32; RESOLUTION] =
            std::array::from_fn(|i| (i as f32 / (RESOLUTION - 1) as f32).max(1e-6));
        let internal = tabulated.reflectance(&nodes, 1.0 / eta);
        let internal: f32 = internal.iter().zip(nodes).map(|(r, mu)| r * mu).sum();
        Ok(Self {
            distribution: Distribution::new(d.distribution, d.alpha, d.alpha, d.sample_visible),
            eta,
            nonlinear: d.nonlinear,
            diffuse_reflectance: b.texture(d.diffuse_reflectance)?,
            specular_reflectance: b.optional(d.specular_reflectance)?,
            specular_sampling_weight: weight,
            external_transmittance: tabulated.transmittance(&nodes, eta),
            internal_reflectance: internal / RESOLUTION as f32 * 2.0,
        })
    }

    fn transmittance(&self, cos_theta: f32) -> f32 {
        let x = cos_theta * (RESOLUTION - 1) as f32;
        let i = (x as usize).min(RESOLUTION - 2);
        let (a, b) = (self.external_transmittance[i], self.external_transmittance[i + 1]);
        a + (b - a) * (x - i as f32)
    }

    fn specular_probability(&self, t_i: f32) -> f32 {
        let specular = (1.0 - t_i) * self.specular_sampling_weight;
        let diffuse = t_i * (1.0 - self.specular_sampling_weight);
        let total = specular + diffuse;
        if total > 0.0 { specular / total } else { 1.0 }
    }
}

impl BsdfModel for RoughPlastic {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        if wi.z <= 0.0 {
            return None;
        }
        let p = self.specular_probability(self.transmittance(wi.z));
        let below_one = 1.0 - f32::EPSILON / 2.0;
        let wo = if u[0] < p {
            let u = [(u[0] / p).min(below_one), u[1]];
            reflect(wi, self.distribution.sample(wi, u))
        } else {
            let u = [((u[0] - p) / (1.0 - p)).min(below_one), u[1]];
            square_to_cosine_hemisphere(u)
        };
        let (value, pdf) = self.eval_pdf(at, wi, wo);
        (pdf > 0.0).then(|| BsdfSample {
            wo,
            weight: value / pdf,
            pdf,
            delta: false,
        })
    }

    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        if wi.z <= 0.0 || wo.z <= 0.0 {
            return (Rgb::ZERO, 0.0);
        }
        let m = (wi + wo).normalize();
        let t_i = self.transmittance(wi.z);

        // Specular coat
        let d = self.distribution.eval(m);
        let f = fresnel::dielectric(wi.dot(m), self.eta).reflectance;
        let specular = f * d * self.distribution.g(wi, wo, m) / (4.0 * wi.z);
        let tint = self.specular_reflectance.map_or(Rgb::ONE, |t| at.rgb(t));

        // Diffuse base: let in, scattered, let out, and thrown back any number of times
        let rho = at.rgb(self.diffuse_reflectance);
        let trapped = if self.nonlinear {
            rho * self.internal_reflectance
        } else {
            Rgb::splat(self.internal_reflectance)
        };
        let scale = INV_PI * wo.z * t_i * self.transmittance(wo.z) / (self.eta * self.eta);
        let diffuse = rho / (Rgb::ONE - trapped) * scale;

        let p = self.specular_probability(t_i);
        let pdf = p * self.distribution.reflected_pdf(wi, wo, m)
            + (1.0 - p) * cosine_hemisphere_pdf(wo.z);
        (tint * specular + diffuse, pdf)
    }
}
