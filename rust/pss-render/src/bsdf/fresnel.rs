//! Fresnel reflectance of dielectric and conducting interfaces.

use crate::math::{Rgb, Vec3, safe_sqrt};

/// Unpolarised reflectance of a dielectric, and how the ray goes on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Dielectric {
    /// Share of the light that is reflected.
    pub(crate) reflectance: f32,
    /// Cosine of the transmitted direction, of the sign opposite to the incident one's.
    pub(crate) cos_theta_t: f32,
    /// Relative index of the transmitted side ÷ the incident one's.
    pub(crate) eta_it: f32,
    /// Relative index on the way back, η_t⁻¹ in the incident ray's order.
    pub(crate) eta_ti: f32,
}

/// Fresnel equations for relative index `eta` (inside ÷ outside) and `cos_theta_i` of any sign.
pub(crate) fn dielectric(cos_theta_i: f32, eta: f32) -> Dielectric {
    let (eta_it, eta_ti) = if cos_theta_i >= 0.0 {
        (eta, 1.0 / eta)
    } else {
        (1.0 / eta, eta)
    };
    let cos_i = cos_theta_i.abs();
    let cos_t = safe_sqrt(1.0 - (1.0 - cos_i * cos_i) * eta_ti * eta_ti);
    let reflectance = if eta == 1.0 {
        0.0
    } else if cos_i == 0.0 {
        1.0
    } else {
        let s = (cos_i - eta_it * cos_t) / (cos_i + eta_it * cos_t);
        let p = (cos_t - eta_it * cos_i) / (cos_t + eta_it * cos_i);
        0.5 * (s * s + p * p)
    };
    Dielectric {
        reflectance,
        cos_theta_t: if cos_theta_i >= 0.0 { -cos_t } else { cos_t },
        eta_it,
        eta_ti,
    }
}

/// Refracts `wi` at the microfacet `m`.
pub(crate) fn refract(wi: Vec3, m: Vec3, f: Dielectric) -> Vec3 {
    m * (wi.dot(m) * f.eta_ti + f.cos_theta_t) - wi * f.eta_ti
}

/// Share of diffuse light that a dielectric interface of relative index `eta` reflects: the fits that
/// Mitsuba uses, by Egan and Hilgeman (1973) from the dense side and by d'Eon and Irving (2011) from the thin.
pub(crate) fn diffuse_reflectance(eta: f32) -> f32 {
    let x = 1.0 / eta;
    if eta < 1.0 {
        0.0636 * x + eta * (eta * -1.4399 + 0.7099) + 0.6681
    } else {
        const D_EON: [f32; 6] = [
            0.919_317, -3.479_3, 6.753_35, -7.809_89, 4.985_54, -1.368_81,
        ];
        D_EON.iter().rev().fold(0.0, |sum, c| sum * x + c)
    }
}

/// Unpolarised reflectance of a conductor of complex index η − ik, per channel.
pub(crate) fn conductor(cos_theta_i: f32, eta: Rgb, k: Rgb) -> Rgb {
    let cos_2 = cos_theta_i * cos_theta_i;
    let sin_2 = 1.0 - cos_2;
    let channel = |eta: f32, k: f32| {
        let t = eta * eta - k * k - sin_2;
        let a2_b2 = safe_sqrt(t * t + 4.0 * k * k * eta * eta);
        let a = safe_sqrt(0.5 * (a2_b2 + t));
        let sum = a2_b2 + cos_2;
        let cross = 2.0 * cos_theta_i * a;
        let s = (sum - cross) / (sum + cross);
        let sum = a2_b2 * cos_2 + sin_2 * sin_2;
        let cross = cross * sin_2;
        let p = s * (sum - cross) / (sum + cross);
        0.5 * (s + p)
    };
    Rgb::new(
        channel(eta.x, k.x),
        channel(eta.y, k.y),
        channel(eta.z, k.z),
    )
}
