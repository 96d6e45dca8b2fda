//! Maps from the unit square, and their densities. The same maps as Mitsuba's `warp.h`, so that equal
//! numbers give equal points.

use std::f32::consts::{FRAC_PI_4, PI, TAU};

use glam::Vec2;

use crate::math::{Vec3, safe_sqrt};

/// 1/π.
pub(crate) const INV_PI: f32 = std::f32::consts::FRAC_1_PI;

/// Shirley and Chiu's concentric map to the unit disk (1997).
#[inline]
pub(crate) fn square_to_uniform_disk_concentric(u: [f32; 2]) -> Vec2 {
    let (x, y) = (2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0);
    if x == 0.0 && y == 0.0 {
        return Vec2::ZERO;
    }
    let (r, phi) = if x.abs() < y.abs() {
        (y, 2.0 * FRAC_PI_4 - FRAC_PI_4 * x / y)
    } else {
        (x, FRAC_PI_4 * y / x)
    };
    let (sin, cos) = phi.sin_cos();
    Vec2::new(r * cos, r * sin)
}

/// Density cos θ/π on the upper hemisphere (Malley's method).
#[inline]
pub(crate) fn square_to_cosine_hemisphere(u: [f32; 2]) -> Vec3 {
    let p = square_to_uniform_disk_concentric(u);
    Vec3::new(p.x, p.y, safe_sqrt(1.0 - p.length_squared()))
}

/// Uniform on the sphere, density 1/4π; the first number gives the azimuth's ring, as in Mitsuba.
#[inline]
pub(crate) fn square_to_uniform_sphere(u: [f32; 2]) -> Vec3 {
    let z = 1.0 - 2.0 * u[1];
    let r = safe_sqrt(1.0 - z * z);
    let (sin, cos) = (TAU * u[0]).sin_cos();
    Vec3::new(r * cos, r * sin, z)
}

/// Uniform on the upper hemisphere, density 1/2π (concentric, so without the pole's distortion).
#[inline]
pub(crate) fn square_to_uniform_hemisphere(u: [f32; 2]) -> Vec3 {
    let p = square_to_uniform_disk_concentric(u);
    let z = 1.0 - p.length_squared();
    let p = p * (z + 1.0).sqrt();
    Vec3::new(p.x, p.y, z)
}

/// Barycentric coordinates (b₁, b₂), uniform on a triangle.
#[inline]
pub(crate) fn square_to_uniform_triangle(u: [f32; 2]) -> [f32; 2] {
    let t = safe_sqrt(1.0 - u[0]);
    [1.0 - t, t * u[1]]
}

/// Three uniform numbers from two: a pair to go on with, and one that is taken from the first number's
/// last digits. For choices that depend on the pair itself.
///
/// The first number gives a stratum of 4,096 and what is left inside it; the second number's own digits
/// below 1/4,096 refine both. Nothing smooth depends on those, so the three are as good as independent.
#[inline]
pub(crate) fn three_from_two(u: [f32; 2]) -> ([f32; 2], f32) {
    const STRATA: f32 = 4096.0;
    let (a, b) = (u[0] * STRATA, u[1] * STRATA);
    let fine = b - b.floor();
    let third = (a - a.floor()) + fine / STRATA;
    let below_one = 1.0 - f32::EPSILON / 2.0;
    (
        [((a.floor() + fine) / STRATA).min(below_one), u[1]],
        (third - third.floor()).min(below_one),
    )
}

/// Density of [`square_to_cosine_hemisphere`].
#[inline]
pub(crate) fn cosine_hemisphere_pdf(cos_theta: f32) -> f32 {
    cos_theta * INV_PI
}

/// Density of directions uniform in a cone of half-angle θ, `depth` = 1 − cos θ.
#[inline]
pub(crate) fn uniform_cone_pdf(depth: f32) -> f32 {
    1.0 / (TAU * depth)
}

/// Density of [`square_to_uniform_sphere`].
pub(crate) const UNIFORM_SPHERE_PDF: f32 = 1.0 / (4.0 * PI);

/// Density of [`square_to_uniform_hemisphere`].
pub(crate) const UNIFORM_HEMISPHERE_PDF: f32 = 1.0 / TAU;
