//! Disney's principled BSDF for solids (Burley 2012 and 2015): diffuse base with sheen, a GGX lobe between
//! dielectric and metallic, transmission through it, and a clear coat.

use serde::Deserialize;

use super::disney::{self, Gtr1, Weight};
use super::microfacet::Distribution;
use super::{BsdfModel, BsdfSample, Builder, Materials, ShadingPoint, fresnel, reuse};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3, reflect};
use crate::texture::TextureId;
use crate::warp::{cosine_hemisphere_pdf, square_to_cosine_hemisphere, three_from_two};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    base_color: TextureId,
    roughness: TextureId,
    anisotropic: TextureId,
    metallic: TextureId,
    spec_trans: TextureId,
    eta: f32,
    spec_tint: TextureId,
    sheen: TextureId,
    sheen_tint: TextureId,
    flatness: TextureId,
    clearcoat: TextureId,
    clearcoat_gloss: TextureId,
    main_specular_sampling_rate: f32,
    clearcoat_sampling_rate: f32,
    diffuse_reflectance_sampling_rate: f32,
}

/// `principled`
#[derive(Debug)]
pub struct Principled {
    base_color: TextureId,
    roughness: TextureId,
    anisotropic: Weight,
    metallic: Weight,
    spec_trans: Weight,
    eta: f32,
    spec_tint: Weight,
    sheen: Weight,
    sheen_tint: Weight,
    flatness: Weight,
    clearcoat: Weight,
    clearcoat_gloss: TextureId,
    specular_rate: f32,
    clearcoat_rate: f32,
    diffuse_rate: f32,
}

/// The weights at one point, and from them the shares of the lobes.
struct Weights {
    roughness: f32,
    metallic: f32,
    clearcoat: f32,
    /// Of the opaque part.
    brdf: f32,
    /// Of the part that transmits.
    bsdf: f32,
    distribution: Distribution,
    /// Probabilities; the GGX lobe has the rest.
    p_diffuse: f32,
    p_clearcoat: f32,
}

impl Weights {
    /// Probability of the GGX lobe, both sides.
    fn p_specular(&self) -> f32 {
        1.0 - self.p_diffuse - self.p_clearcoat
    }

    /// Share of the GGX lobe's samples that are reflected, at a microfacet of Fresnel reflectance `f`.
    fn p_reflect(&self, front: bool, f: f32) -> f32 {
        if front {
            1.0 - self.bsdf * (1.0 - f)
        } else {
            f
        }
    }
}

impl Principled {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let ok = d.eta.is_finite() && d.eta > 0.0;
        b.check(ok, "eta", d.eta, "positive and finite")?;
        for (name, rate) in [
            ("main_specular_sampling_rate", d.main_specular_sampling_rate),
            ("clearcoat_sampling_rate", d.clearcoat_sampling_rate),
            (
                "diffuse_reflectance_sampling_rate",
                d.diffuse_reflectance_sampling_rate,
            ),
        ] {
            let ok = rate.is_finite() && rate >= 0.0;
            b.check(ok, name, rate, "finite and not negative")?;
        }
        Ok(Self {
            base_color: b.texture(d.base_color)?,
            roughness: b.texture(d.roughness)?,
            anisotropic: disney::weight(&b, d.anisotropic)?,
            metallic: disney::weight(&b, d.metallic)?,
            spec_trans: disney::weight(&b, d.spec_trans)?,
            eta: d.eta,
            spec_tint: disney::weight(&b, d.spec_tint)?,
            sheen: disney::weight(&b, d.sheen)?,
            sheen_tint: disney::weight(&b, d.sheen_tint)?,
            flatness: disney::weight(&b, d.flatness)?,
            clearcoat: disney::weight(&b, d.clearcoat)?,
            clearcoat_gloss: b.texture(d.clearcoat_gloss)?,
            specular_rate: d.main_specular_sampling_rate,
            clearcoat_rate: d.clearcoat_sampling_rate,
            diffuse_rate: d.diffuse_reflectance_sampling_rate,
        })
    }

    /// `None` where nothing happens: on the back of what does not transmit, or where no lobe is drawn.
    fn weights(&self, at: ShadingPoint<'_>, front: bool) -> Option<Weights> {
        let metallic = disney::scalar(at, self.metallic);
        let spec_trans = disney::scalar(at, self.spec_trans);
        let clearcoat = disney::scalar(at, self.clearcoat);
        let roughness = at.scalar(self.roughness);
        let brdf = (1.0 - metallic) * (1.0 - spec_trans);
        let bsdf = (1.0 - metallic) * spec_trans;
        let (p_diffuse, p_clearcoat) = if front {
            // The coat has a quarter of the main lobe's energy.
            let (diffuse, coat) = (
                brdf * self.diffuse_rate,
                0.25 * clearcoat * self.clearcoat_rate,
            );
            let total = self.specular_rate + diffuse + coat;
            (diffuse / total, coat / total)
        } else {
            (0.0, 0.0)
        };
        let any = p_diffuse.is_finite() && p_clearcoat.is_finite() && (front || bsdf > 0.0);
        any.then(|| Weights {
            roughness,
            metallic,
            clearcoat,
            brdf,
            bsdf,
            distribution: disney::distribution(roughness, disney::scalar(at, self.anisotropic)),
            p_diffuse,
            p_clearcoat,
        })
    }

    /// Fresnel term of the reflected GGX lobe: dielectric, tinted, and metallic by Schlick.
    fn fresnel(
        &self,
        at: ShadingPoint<'_>,
        w: &Weights,
        front: bool,
        wi_m: f32,
        dielectric: f32,
        base_color: Rgb,
    ) -> Rgb {
        if !front {
            return Rgb::splat(w.bsdf * dielectric);
        }
        let spec_tint = disney::scalar(at, self.spec_tint);
        let mut f = Rgb::splat((1.0 - w.metallic) * (1.0 - spec_tint) * dielectric);
        if w.metallic != 0.0 {
            f += disney::schlick(base_color, wi_m, self.eta) * w.metallic;
        }
        if spec_tint != 0.0 {
            let eta_it = if wi_m >= 0.0 {
                self.eta
            } else {
                1.0 / self.eta
            };
            let r0 = disney::tint(base_color) * disney::schlick_r0(eta_it);
            f += disney::schlick(r0, wi_m, self.eta) * ((1.0 - w.metallic) * spec_tint);
        }
        f
    }
}

impl BsdfModel for Principled {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        if wi.z == 0.0 {
            return None;
        }
        let front = wi.z > 0.0;
        let w = self.weights(at, front)?;
        let (wo, reflects) = if u[0] < w.p_diffuse {
            let u = [reuse(u[0], 0.0, w.p_diffuse), u[1]];
            (square_to_cosine_hemisphere(u), true)
        } else if u[0] < w.p_diffuse + w.p_clearcoat {
            let u = [reuse(u[0], w.p_diffuse, w.p_clearcoat), u[1]];
            let m = Gtr1::new(at.scalar(self.clearcoat_gloss)).sample(u);
            let wo = reflect(wi, m);
            if !disney::facets_agree(m, wi, wo, true) {
                return None;
            }
            (wo, true)
        } else {
            let u = [reuse(u[0], 1.0 - w.p_specular(), w.p_specular()), u[1]];
            // Which side depends on the normal, which takes two numbers.
            let (u, choice) = if w.bsdf > 0.0 {
                three_from_two(u)
            } else {
                (u, 0.0)
            };
            let m = w.distribution.sample(wi * 1f32.copysign(wi.z), u);
            let f = fresnel::dielectric(wi.dot(m), self.eta);
            let reflects = choice < w.p_reflect(front, f.reflectance);
            let wo = if reflects {
                reflect(wi, m)
            } else {
                fresnel::refract(wi, m, f)
            };
            // Another lobe may well have a density there, but this one has none.
            if !disney::facets_agree(m, wi, wo, reflects) {
                return None;
            }
            (wo, reflects)
        };
        if (wi.z * wo.z > 0.0) != reflects {
            return None;
        }
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
        let front = wi.z > 0.0;
        let reflects = wi.z * wo.z > 0.0;
        if !reflects && self.spec_trans.is_none() {
            return nothing;
        }
        let Some(w) = self.weights(at, front) else {
            return nothing;
        };
        let base_color = at.rgb(self.base_color);
        let eta = if front { self.eta } else { 1.0 / self.eta };
        let m = (wi + wo * if reflects { 1.0 } else { eta }).normalize();
        let m = m * 1f32.copysign(m.z);
        let (wi_m, wo_m) = (wi.dot(m), wo.dot(m));
        let (cos_i, cos_o) = (wi.z.abs(), wo.z.abs());
        let agree = disney::facets_agree(m, wi, wo, reflects);
        let f = fresnel::dielectric(wi_m, self.eta).reflectance;
        let p_reflect = w.p_specular() * w.p_reflect(front, f);
        let (mut value, mut pdf) = nothing;

        // ---------------- GGX lobe, reflected or transmitted ----------------
        if agree {
            let dg = w.distribution.eval(m) * w.distribution.g(wi, wo, m);
            let p_m = w.distribution.pdf(wi * 1f32.copysign(wi.z), m);
            if reflects {
                if f > 0.0 {
                    value +=
                        self.fresnel(at, &w, front, wi_m, f, base_color) * (dg / (4.0 * cos_i));
                }
                pdf += p_reflect * p_m / (4.0 * wo_m.abs());
            } else {
                let jacobian = wo_m.abs() / (wi_m + eta * wo_m).powi(2);
                if w.bsdf > 0.0 && f < 1.0 {
                    // Radiance is scaled by η⁻², which cancels the Jacobian's η².
                    let share = w.bsdf * (1.0 - f) * dg * jacobian * wi_m.abs() / cos_i;
                    value += base_color.map(f32::sqrt) * share;
                }
                pdf += (w.p_specular() - p_reflect) * p_m * jacobian * eta * eta;
            }
        }
        if !(front && reflects) {
            return (value, pdf);
        }

        // ---------------- Clear coat ----------------
        if agree && w.clearcoat > 0.0 {
            let coat = Gtr1::new(at.scalar(self.clearcoat_gloss));
            let f = disney::schlick(Rgb::splat(0.04), wi_m, self.eta);
            let g = disney::clearcoat_g1(wi, m) * disney::clearcoat_g1(wo, m);
            value += f * (0.25 * w.clearcoat * coat.eval(m) * g * cos_o);
            pdf += w.p_clearcoat * coat.pdf(m) / (4.0 * wo_m.abs());
        }

        // ---------------- Diffuse base and sheen ----------------
        if w.brdf > 0.0 {
            let flatness = disney::scalar(at, self.flatness);
            value +=
                base_color * (w.brdf * disney::diffuse(w.roughness, flatness, cos_i, cos_o, wo_m));
        }
        let sheen = disney::scalar(at, self.sheen) * (1.0 - w.metallic);
        if sheen > 0.0 {
            let sheen_tint = disney::scalar(at, self.sheen_tint);
            value += disney::sheen(base_color, sheen_tint, cos_o, wo_m) * sheen;
        }
        (value, pdf + w.p_diffuse * cosine_hemisphere_pdf(cos_o))
    }

    fn transmits(&self, _: &Materials) -> bool {
        self.spec_trans.is_some()
    }

    fn two_sided(&self, _: &Materials) -> bool {
        self.spec_trans.is_some()
    }

    fn anisotropic(&self, _: &Materials) -> bool {
        self.anisotropic.is_some()
    }
}
