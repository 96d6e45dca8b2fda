//! Microfacet normals: Beckmann and GGX (Trowbridge–Reitz), isotropic and anisotropic.
//!
//! Distribution, Smith masking and the rational fit of Beckmann's: Walter et al. 2007. Visible normals:
//! Heitz and d'Eon 2014 (Beckmann by numerical inversion in the erf domain), Heitz 2018 (GGX).

use std::f32::consts::{FRAC_2_SQRT_PI, PI, TAU};

use serde::Deserialize;

use super::fresnel;
use crate::math::{Vec3, gauss_legendre, reflect, safe_sqrt};
use crate::warp::square_to_uniform_disk_concentric;

const INV_SQRT_PI: f32 = 0.5 * FRAC_2_SQRT_PI;

/// The distribution's name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Kind {
    /// Gaussian slopes.
    Beckmann,
    /// Trowbridge–Reitz.
    Ggx,
}

/// Density of microfacet normals m over a surface of roughness (α_u, α_v).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Distribution {
    kind: Kind,
    alpha_u: f32,
    alpha_v: f32,
    sample_visible: bool,
}

impl Distribution {
    pub(crate) fn new(kind: Kind, alpha_u: f32, alpha_v: f32, sample_visible: bool) -> Self {
        // The floor is Mitsuba's: below it single precision cannot carry the peak.
        Self {
            kind,
            alpha_u: alpha_u.max(1e-4),
            alpha_v: alpha_v.max(1e-4),
            sample_visible,
        }
    }

    /// The distribution that [`Distribution::sample`] should draw from where light also passes through: if
    /// all normals are drawn, a slightly rougher one, so that no weight is large (Walter et al. 2007, §5.3).
    pub(crate) fn for_sampling(mut self, cos_theta_i: f32) -> Self {
        if !self.sample_visible {
            let scale = 1.2 - 0.2 * cos_theta_i.abs().sqrt();
            self.alpha_u *= scale;
            self.alpha_v *= scale;
        }
        self
    }

    /// D(m).
    pub(crate) fn eval(&self, m: Vec3) -> f32 {
        let alpha_uv = self.alpha_u * self.alpha_v;
        let slope = (m.x / self.alpha_u).powi(2) + (m.y / self.alpha_v).powi(2);
        let cos_2 = m.z * m.z;
        let d = match self.kind {
            Kind::Beckmann => (-slope / cos_2).exp() / (PI * alpha_uv * cos_2 * cos_2),
            Kind::Ggx => 1.0 / (PI * alpha_uv * (slope + cos_2).powi(2)),
        };
        if d * m.z > 1e-20 { d } else { 0.0 }
    }

    /// Density of [`Distribution::sample`] at m, per solid angle of m.
    pub(crate) fn pdf(&self, wi: Vec3, m: Vec3) -> f32 {
        if self.sample_visible {
            self.eval(m) * self.smith_g1(wi, m) * wi.dot(m).abs() / wi.z
        } else {
            self.eval(m) * m.z
        }
    }

    /// Density of the reflected direction wo = reflect(wi, m), per solid angle of wo.
    pub(crate) fn reflected_pdf(&self, wi: Vec3, wo: Vec3, m: Vec3) -> f32 {
        if self.sample_visible {
            self.eval(m) * self.smith_g1(wi, m) / (4.0 * wi.z)
        } else {
            self.pdf(wi, m) / (4.0 * wo.dot(m))
        }
    }

    /// Smith's G₁(v, m).
    pub(crate) fn smith_g1(&self, v: Vec3, m: Vec3) -> f32 {
        if v.dot(m) * v.z <= 0.0 {
            return 0.0;
        }
        let xy_2 = (self.alpha_u * v.x).powi(2) + (self.alpha_v * v.y).powi(2);
        if xy_2 == 0.0 {
            return 1.0;
        }
        let tan_2 = xy_2 / (v.z * v.z);
        match self.kind {
            Kind::Beckmann => {
                let a = 1.0 / tan_2.sqrt();
                if a >= 1.6 {
                    1.0
                } else {
                    let a_2 = a * a;
                    (3.535 * a + 2.181 * a_2) / (1.0 + 2.276 * a + 2.577 * a_2)
                }
            }
            Kind::Ggx => 2.0 / (1.0 + (1.0 + tan_2).sqrt()),
        }
    }

    /// Separable masking and shadowing.
    pub(crate) fn g(&self, wi: Vec3, wo: Vec3, m: Vec3) -> f32 {
        self.smith_g1(wi, m) * self.smith_g1(wo, m)
    }

    /// Draws m.
    pub(crate) fn sample(&self, wi: Vec3, u: [f32; 2]) -> Vec3 {
        if !self.sample_visible {
            return self.sample_all(u);
        }
        let stretched = Vec3::new(self.alpha_u * wi.x, self.alpha_v * wi.y, wi.z).normalize();
        let length = stretched.x.hypot(stretched.y);
        let (cos_phi, sin_phi) = if length > 0.0 {
            (stretched.x / length, stretched.y / length)
        } else {
            (1.0, 0.0)
        };
        let [x, y] = self.sample_visible_11(stretched.z, u);
        let slope_x = (cos_phi * x - sin_phi * y) * self.alpha_u;
        let slope_y = (sin_phi * x + cos_phi * y) * self.alpha_v;
        Vec3::new(-slope_x, -slope_y, 1.0).normalize()
    }

    /// Draws m in proportion to D(m) cos θ, whether visible or not.
    fn sample_all(&self, u: [f32; 2]) -> Vec3 {
        let (sin_phi, cos_phi, alpha_2);
        if self.alpha_u == self.alpha_v {
            (sin_phi, cos_phi) = (TAU * u[1]).sin_cos();
            alpha_2 = self.alpha_u * self.alpha_u;
        } else {
            let t = self.alpha_v / self.alpha_u * (TAU * u[1]).tan();
            let c = 1.0 / (1.0 + t * t).sqrt();
            cos_phi = if (u[1] - 0.5).abs() < 0.25 { -c } else { c };
            sin_phi = cos_phi * t;
            alpha_2 = 1.0 / ((cos_phi / self.alpha_u).powi(2) + (sin_phi / self.alpha_v).powi(2));
        }
        let tan_2 = match self.kind {
            Kind::Beckmann => -alpha_2 * (1.0 - u[0]).ln(),
            Kind::Ggx => alpha_2 * u[0] / (1.0 - u[0]),
        };
        let cos_theta = 1.0 / (1.0 + tan_2).sqrt();
        let sin_theta = safe_sqrt(1.0 - cos_theta * cos_theta);
        Vec3::new(cos_phi * sin_theta, sin_phi * sin_theta, cos_theta)
    }

    /// Visible slopes for α = 1 and an incident direction in the xz plane.
    fn sample_visible_11(&self, cos_theta_i: f32, u: [f32; 2]) -> [f32; 2] {
        match self.kind {
            Kind::Beckmann => {
                let tan_i = safe_sqrt(1.0 - cos_theta_i * cos_theta_i) / cos_theta_i;
                let cot_i = 1.0 / tan_i;
                let max = libm::erff(cot_i);
                let u = u.map(|x| x.clamp(1e-6, 1.0 - 1e-6));
                // Starting value: the solution at grazing incidence, the least linear case.
                let mut x = max - (max + 1.0) * libm::erff((-u[0].ln()).sqrt());
                let target = u[0] * (1.0 + max + INV_SQRT_PI * tan_i * (-cot_i * cot_i).exp());
                for _ in 0..3 {
                    let slope = erf_inverse(x);
                    let value = 1.0 + x + INV_SQRT_PI * tan_i * (-slope * slope).exp() - target;
                    x -= value / (1.0 - slope * tan_i);
                }
                [erf_inverse(x), erf_inverse(2.0 * u[1] - 1.0)]
            }
            Kind::Ggx => {
                let p = square_to_uniform_disk_concentric(u);
                let s = 0.5 * (1.0 + cos_theta_i);
                let bound = safe_sqrt(1.0 - p.x * p.x);
                let y = bound + (p.y - bound) * s;
                let x = p.x;
                let z = safe_sqrt(1.0 - x * x - y * y);
                let sin_i = safe_sqrt(1.0 - cos_theta_i * cos_theta_i);
                let norm = 1.0 / (sin_i * y + cos_theta_i * z);
                [(cos_theta_i * y - sin_i * z) * norm, x * norm]
            }
        }
    }

    /// The share of light from direction cos θ = `mu` that the rough interface of relative index `eta`
    /// reflects, for each of `mu`: a tensor Gauss–Legendre rule over the visible normals.
    pub(crate) fn reflectance(&self, mu: &[f32], eta: f32) -> Vec<f32> {
        self.integrate(mu, eta, |wi, m| {
            let wo = reflect(wi, m);
            let f = fresnel::dielectric(wi.dot(m), eta).reflectance;
            if wo.z > 0.0 {
                self.smith_g1(wo, m) * f
            } else {
                0.0
            }
        })
    }

    /// The share that it lets through.
    pub(crate) fn transmittance(&self, mu: &[f32], eta: f32) -> Vec<f32> {
        self.integrate(mu, eta, |wi, m| {
            let f = fresnel::dielectric(wi.dot(m), eta);
            let wo = fresnel::refract(wi, m, f);
            if wo.z * wi.z < 0.0 {
                self.smith_g1(wo, m) * (1.0 - f.reflectance)
            } else {
                0.0
            }
        })
    }

    fn integrate(&self, mu: &[f32], eta: f32, value: impl Fn(Vec3, Vec3) -> f32) -> Vec<f32> {
        // Same number of nodes as Mitsuba, so that the tables agree to rounding.
        let rule = gauss_legendre(if eta > 1.0 { 32 } else { 128 });
        let over_normals = |&mu: &f32| {
            let wi = Vec3::new(safe_sqrt(1.0 - mu * mu), 0.0, mu);
            let mut sum = 0.0f64;
            for &(x, wx) in &rule {
                for &(y, wy) in &rule {
                    let m = self.sample(wi, [(0.5 * x + 0.5) as f32, (0.5 * y + 0.5) as f32]);
                    sum += f64::from(value(wi, m)) * wx * wy * 0.25;
                }
            }
            sum as f32
        };
        mu.iter().map(over_normals).collect()
    }
}

/// erf⁻¹ in single precision (Giles 2010, *Approximating the erfinv function*).
fn erf_inverse(x: f32) -> f32 {
    let w = -((1.0 - x) * (1.0 + x)).max(f32::MIN_POSITIVE).ln();
    let polynomial = |w: f32, c: [f32; 9]| c.iter().fold(0.0, |p, &c| p * w + c);
    let p = if w < 5.0 {
        polynomial(
            w - 2.5,
            [
                2.810_226_4e-8,
                3.432_739_4e-7,
                -3.523_387_7e-6,
                -4.391_506_5e-6,
                0.000_218_580_87,
                -0.001_253_725,
                -0.004_177_681_6,
                0.246_640_73,
                1.501_409_4,
            ],
        )
    } else {
        polynomial(
            w.sqrt() - 3.0,
            [
                -0.000_200_214_26,
                0.000_100_950_56,
                0.001_349_343_2,
                -0.003_673_428_4,
                0.005_739_507_7,
                -0.007_622_461_3,
                0.009_438_87,
                1.001_674,
                2.832_976_8,
            ],
        )
    };
    p * x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn erf_inverse_inverts_erf() {
        for i in -99..100 {
            let x = i as f32 / 100.0;
            assert!((libm::erff(erf_inverse(x)) - x).abs() < 3e-7, "{x}");
        }
    }

    #[test]
    fn projected_normals_integrate_to_one() {
        for kind in [Kind::Beckmann, Kind::Ggx] {
            let d = Distribution::new(kind, 0.3, 0.7, true);
            let rule = gauss_legendre(64);
            let mut sum = 0.0;
            for &(x, wx) in &rule {
                for &(y, wy) in &rule {
                    // z = cos θ over [0, 1], φ over [0, 2π].
                    let (z, phi) = ((0.5 * x + 0.5) as f32, (PI as f64 * (y + 1.0)) as f32);
                    let r = safe_sqrt(1.0 - z * z);
                    let m = Vec3::new(r * phi.cos(), r * phi.sin(), z);
                    sum += f64::from(d.eval(m) * z) * wx * wy * 0.5 * std::f64::consts::PI;
                }
            }
            assert!((sum - 1.0).abs() < 2e-3, "{kind:?}: {sum}");
        }
    }
}
