//! Disney's principled BSDF for thin sheets (Burley 2015): both sides alike, diffuse and specular lobes each
//! reflected and transmitted, no bend.

use serde::Deserialize;

use super::disney::{self, Weight};
use super::microfacet::Distribution;
use super::{BsdfModel, BsdfSample, Builder, Materials, ShadingPoint, fresnel, reuse};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3, reflect};
use crate::texture::TextureId;
use crate::warp::{INV_PI, cosine_hemisphere_pdf, square_to_cosine_hemisphere};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    base_color: TextureId,
    roughness: TextureId,
    anisotropic: TextureId,
    spec_trans: TextureId,
    eta: TextureId,
    spec_tint: TextureId,
    sheen: TextureId,
    sheen_tint: TextureId,
    flatness: TextureId,
    diff_trans: TextureId,
    specular_reflectance_sampling_rate: f32,
    specular_transmittance_sampling_rate: f32,
    diffuse_reflectance_sampling_rate: f32,
    diffuse_transmittance_sampling_rate: f32,
}

/// `principledthin`
#[derive(Debug)]
pub struct PrincipledThin {
    base_color: TextureId,
    roughness: TextureId,
    anisotropic: Weight,
    spec_trans: Weight,
    eta: TextureId,
    spec_tint: Weight,
    sheen: Weight,
    sheen_tint: Weight,
    flatness: Weight,
    diff_trans: Weight,
    /// Specular reflection and transmission, diffuse reflection and transmission.
    rates: [f32; 4],
}

/// The weights at one point.
struct Weights {
    roughness: f32,
    anisotropic: f32,
    spec_trans: f32,
    /// In [0, 1], half of the parameter.
    diff_trans: f32,
    eta: f32,
    /// Probabilities, in the order of [`PrincipledThin::rates`].
    p: [f32; 4],
}

impl Weights {
    fn reflected(&self) -> Distribution {
        disney::distribution(self.roughness, self.anisotropic)
    }

    /// Two interfaces roughen what passes, the more the higher their index (Burley 2015, fig. 15).
    fn transmitted(&self) -> Distribution {
        let scale = 0.65 * self.eta - 0.35;
        disney::distribution(scale * self.roughness, self.anisotropic)
    }
}

const FLIP: Vec3 = Vec3::new(1.0, 1.0, -1.0);

impl PrincipledThin {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let rates = [
            (
                "specular_reflectance_sampling_rate",
                d.specular_reflectance_sampling_rate,
            ),
            (
                "specular_transmittance_sampling_rate",
                d.specular_transmittance_sampling_rate,
            ),
            (
                "diffuse_reflectance_sampling_rate",
                d.diffuse_reflectance_sampling_rate,
            ),
            (
                "diffuse_transmittance_sampling_rate",
                d.diffuse_transmittance_sampling_rate,
            ),
        ];
        for (name, rate) in rates {
            let ok = rate.is_finite() && rate >= 0.0;
            b.check(ok, name, rate, "finite and not negative")?;
        }
        Ok(Self {
            base_color: b.texture(d.base_color)?,
            roughness: b.texture(d.roughness)?,
            anisotropic: disney::weight(&b, d.anisotropic)?,
            spec_trans: disney::weight(&b, d.spec_trans)?,
            eta: b.texture(d.eta)?,
            spec_tint: disney::weight(&b, d.spec_tint)?,
            sheen: disney::weight(&b, d.sheen)?,
            sheen_tint: disney::weight(&b, d.sheen_tint)?,
            flatness: disney::weight(&b, d.flatness)?,
            diff_trans: disney::weight(&b, d.diff_trans)?,
            rates: rates.map(|(_, rate)| rate),
        })
    }

    /// `None` where no lobe is drawn.
    fn weights(&self, at: ShadingPoint<'_>) -> Option<Weights> {
        let spec_trans = disney::scalar(at, self.spec_trans);
        let diff_trans = 0.5 * disney::scalar(at, self.diff_trans);
        let rough = 1.0 - spec_trans;
        let shares = [
            0.5 * spec_trans,
            0.5 * spec_trans,
            rough * (1.0 - diff_trans),
            rough * diff_trans,
        ];
        let p: [f32; 4] = std::array::from_fn(|i| shares[i] * self.rates[i]);
        let total: f32 = p.iter().sum();
        (total > 0.0).then(|| Weights {
            roughness: at.scalar(self.roughness),
            anisotropic: disney::scalar(at, self.anisotropic),
            spec_trans,
            diff_trans,
            eta: at.scalar(self.eta),
            p: p.map(|p| p / total),
        })
    }
}

impl BsdfModel for PrincipledThin {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        if wi.z == 0.0 {
            return None;
        }
        let w = self.weights(at)?;
        let side = 1f32.copysign(wi.z);
        let above = wi * side;
        let (mut lobe, mut start) = (0, 0.0);
        while lobe < 3 && u[0] >= start + w.p[lobe] {
            start += w.p[lobe];
            lobe += 1;
        }
        let u = [reuse(u[0], start, w.p[lobe]), u[1]];
        let specular = |distribution: Distribution, flip: Vec3| {
            let m = distribution.sample(above, u);
            let wo = reflect(above, m) * flip;
            // Another lobe may well have a density there, but this one has none.
            disney::facets_agree(m, above, wo, lobe == 0).then_some(wo)
        };
        let wo = match lobe {
            0 => specular(w.reflected(), Vec3::ONE)?,
            1 => specular(w.transmitted(), FLIP)?,
            2 => square_to_cosine_hemisphere(u),
            _ => -square_to_cosine_hemisphere(u),
        };
        if (wo.z > 0.0) != (lobe % 2 == 0) {
            return None;
        }
        let wo = wo * side;
        let (value, pdf) = self.eval_pdf(at, wi, wo);
        (pdf > 0.0 && pdf.is_finite()).then(|| BsdfSample {
            wo,
            weight: value / pdf,
            pdf,
            delta: false,
        })
    }

    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        let nothing = (Rgb::ZERO, 0.0);
        if wi.z == 0.0 || wo.z == 0.0 {
            return nothing;
        }
        let Some(w) = self.weights(at) else {
            return nothing;
        };
        // As seen from the front: the sheet is the same from both sides.
        let side = 1f32.copysign(wi.z);
        let (wi, wo) = (wi * side, wo * side);
        let reflects = wo.z > 0.0;
        let (cos_i, cos_o) = (wi.z, wo.z.abs());
        let m = (wi + if reflects { wo } else { wo * FLIP }).normalize();
        let wi_m = wi.dot(m);
        let base_color = at.rgb(self.base_color);
        let (mut value, mut pdf) = nothing;

        // ---------------- Specular lobes ----------------
        if w.spec_trans > 0.0 && disney::facets_agree(m, wi, wo, reflects) {
            let f = fresnel::dielectric(wi_m, w.eta).reflectance;
            let (distribution, colour) = if reflects {
                let spec_tint = disney::scalar(at, self.spec_tint);
                let mut colour = Rgb::splat(f);
                if spec_tint != 0.0 {
                    let r0 = disney::tint(base_color) * disney::schlick_r0(w.eta);
                    colour = colour.lerp(disney::schlick(r0, wi_m, w.eta), spec_tint);
                }
                (w.reflected(), colour)
            } else {
                (w.transmitted(), base_color * (1.0 - f))
            };
            let dg = distribution.eval(m) * distribution.g(wi, wo, m);
            value += colour * (w.spec_trans * dg / (4.0 * cos_i));
            let p = if reflects { w.p[0] } else { w.p[1] };
            // The Jacobian is that of the reflected direction, which the transmitted one mirrors.
            pdf += p * distribution.pdf(wi, m) / (4.0 * wi_m);
        }

        // ---------------- Diffuse lobes ----------------
        let rough = 1.0 - w.spec_trans;
        let cosine = cosine_hemisphere_pdf(cos_o);
        if reflects {
            let share = rough * (1.0 - w.diff_trans);
            let wo_m = wo.dot(m);
            if share > 0.0 {
                let flatness = disney::scalar(at, self.flatness);
                let base = disney::diffuse(w.roughness, flatness, cos_i, cos_o, wo_m);
                value += base_color * (share * base);
                let sheen = disney::scalar(at, self.sheen);
                if sheen > 0.0 {
                    let sheen_tint = disney::scalar(at, self.sheen_tint);
                    value += disney::sheen(base_color, sheen_tint, cos_o, wo_m) * (share * sheen);
                }
            }
            pdf += w.p[2] * cosine;
        } else {
            value += base_color * (rough * w.diff_trans * cos_o * INV_PI);
            pdf += w.p[3] * cosine;
        }
        (value, pdf)
    }

    fn transmits(&self, _: &Materials) -> bool {
        self.spec_trans.is_some() || self.diff_trans.is_some()
    }

    fn two_sided(&self, _: &Materials) -> bool {
        true
    }

    fn anisotropic(&self, _: &Materials) -> bool {
        self.anisotropic.is_some()
    }
}
