//! The sphere, exact; sampled by the cone that it subtends.

use std::f32::consts::{PI, TAU};

use embree4::{GeomId, Hit, Quadric, Ray, SceneBuilder};
use glam::Vec2;
use serde::Deserialize;

use super::affine::Affine;
use super::{ShapeModel, SurfaceSample, Tangents, solid_angle_pdf};
use crate::bsdf::BsdfId;
use crate::arrays::{Arrays, check};
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::{RAY_EPSILON, Vec3, safe_sqrt};
use crate::warp::{square_to_uniform_sphere, uniform_cone_pdf};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    center: [f32; 3],
    radius: f32,
    #[serde(default)]
    flip_normals: bool,
    to_world: [f32; 16],
    pub(super) bsdf: BsdfId,
    pub(super) emitter: Option<usize>,
}

/// `sphere`
#[derive(Debug)]
pub struct Sphere {
    center: Vec3,
    radius: f32,
    /// Turns texture coordinates with the shape.
    map: Affine,
    sign: f32,
}

impl Sphere {
    pub(super) fn build(d: Description, _arrays: &mut Arrays) -> Result<Self, SceneError> {
        let owner = format!("shape {:?}", d.id);
        check(
            d.radius.is_finite() && d.radius > 0.0,
            &owner,
            "radius",
            d.radius,
            "positive and finite",
        )?;
        crate::arrays::check_all_finite(&d.center, &owner, "center")?;
        Ok(Self {
            center: Vec3::from_array(d.center),
            radius: d.radius,
            map: Affine::new(&d.to_world, &owner)?,
            sign: if d.flip_normals { -1.0 } else { 1.0 },
        })
    }

    fn uv(local: Vec3) -> Vec2 {
        let local = local.normalize();
        let phi = local.y.atan2(local.x);
        let phi = if phi < 0.0 { phi + TAU } else { phi };
        // acos loses the poles; the half-chord does not.
        let theta = 2.0 * (0.5 * (local - Vec3::Z).length()).min(1.0).asin();
        Vec2::new(phi / TAU, theta / PI)
    }

    /// Whether a point at this squared distance from the centre samples the cone (or else the area).
    ///
    /// Points on the sphere itself count as being on the side that it shines to. Sampling and density must
    /// agree on this: Mitsuba's density decides by another rule, and its weights are off by up to 2 for light
    /// that goes from a sphere to itself.
    #[inline]
    fn is_outside(&self, distance_2: f32) -> bool {
        let limit = self.radius * (1.0 - self.sign * RAY_EPSILON);
        distance_2 > limit * limit
    }

    fn area_sample(&self, reference: Vec3, u: [f32; 2]) -> SurfaceSample {
        let d = square_to_uniform_sphere(u);
        let p = self.center + d * self.radius;
        SurfaceSample {
            p,
            n: d * self.sign,
            // Mitsuba leaves it zero, since it draws textured lights by their texels; we draw all by surface.
            uv: Self::uv(self.map.inverse_point(p)),
            pdf: solid_angle_pdf(1.0 / self.area(), p - reference, d),
        }
    }
}

impl ShapeModel for Sphere {
    fn attach(&self, builder: &mut SceneBuilder, _groups: &[embree4::Scene]) -> Result<GeomId, SceneError> {
        Ok(builder.quadric(Quadric::Sphere {
            center: self.center.to_array(),
            radius: self.radius,
        })?)
    }

    fn interaction(&self, ray: &Ray, hit: &Hit, _tangents: Tangents) -> Interaction {
        // Projected back onto the sphere: origin + t·d has the error of a distant origin.
        let q = Vec3::from_array(ray.origin) + Vec3::from_array(ray.dir) * hit.t;
        let out = (q - self.center).normalize();
        let p = self.center + out * self.radius;
        let local = self.map.inverse_point(p);
        let n = out * self.sign;
        let r = local.x.hypot(local.y);
        let dp_dv = if r > 0.0 {
            Vec3::new(local.z * local.x / r, local.z * local.y / r, -r)
        } else {
            Vec3::X
        };
        Interaction {
            p,
            n,
            shading_normal: n,
            uv: Self::uv(local),
            dp_du: self.map.vector(Vec3::new(-local.y, local.x, 0.0)) * TAU,
            dp_dv: self.map.vector(dp_dv) * PI,
            ..Interaction::default()
        }
    }

    fn area(&self) -> f32 {
        4.0 * PI * self.radius * self.radius
    }

    fn sample_position(&self, u: [f32; 2]) -> (Vec3, Vec3, Vec2) {
        let local = square_to_uniform_sphere(u);
        let p = self.map.point(local);
        (p, (p - self.center) / self.radius * self.sign, Self::uv(local))
    }

    fn sample_direction(&self, reference: Vec3, u: [f32; 2]) -> SurfaceSample {
        let to_center = self.center - reference;
        let distance_2 = to_center.length_squared();
        if !self.is_outside(distance_2) {
            return self.area_sample(reference, u);
        }
        let inverse_distance = 1.0 / distance_2.sqrt();
        let sin_max = self.radius * inverse_distance;
        let sin_max_2 = sin_max * sin_max;
        // 1 − cos θ is uniform on the cone's cap; kept as it is, it does not cancel for a small cone.
        let below_one = cone_depth(sin_max_2) * u[0];
        let sin_2 = below_one * (2.0 - below_one);
        let cos_theta = safe_sqrt(1.0 - sin_2);
        let cos_alpha =
            sin_2 / sin_max + cos_theta * safe_sqrt(1.0 - sin_2 / sin_max_2);
        let sin_alpha = safe_sqrt(1.0 - cos_alpha * cos_alpha);
        let (sin_phi, cos_phi) = (TAU * u[1]).sin_cos();
        let axis = to_center * -inverse_distance;
        let (s, t) = mitsuba_basis(axis);
        let d = s * (cos_phi * sin_alpha) + t * (sin_phi * sin_alpha) + axis * cos_alpha;
        let p = self.center + d * self.radius;
        SurfaceSample {
            p,
            n: d * self.sign,
            uv: Self::uv(self.map.inverse_point(p)),
            pdf: if p == reference {
                0.0
            } else {
                uniform_cone_pdf(cone_depth(sin_max_2))
            },
        }
    }

    fn pdf_direction(&self, reference: Vec3, p: Vec3, n: Vec3) -> f32 {
        let distance_2 = (self.center - reference).length_squared();
        if self.is_outside(distance_2) {
            uniform_cone_pdf(cone_depth(self.radius * self.radius / distance_2))
        } else {
            solid_angle_pdf(1.0 / self.area(), p - reference, n)
        }
    }
}

/// 1 − cos θ of the cone of half-angle θ, from sin² θ; Mitsuba subtracts, and so loses distant small lamps.
fn cone_depth(sin_2: f32) -> f32 {
    // From a point on the sphere rounding may find a sine above 1.
    let sin_2 = sin_2.min(1.0);
    sin_2 / (1.0 + safe_sqrt(1.0 - sin_2))
}

/// The basis about a unit vector that Mitsuba uses where no uv frame is at hand (Duff et al. 2017).
fn mitsuba_basis(n: Vec3) -> (Vec3, Vec3) {
    let sign = 1.0f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    (
        Vec3::new(sign * n.x * n.x * a + 1.0, sign * b, -sign * n.x),
        Vec3::new(b, n.y * n.y * a + sign, -n.y),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_distant_lamp_keeps_its_density() {
        for (radius, distance) in [(1.0f32, 2.0f32), (1.0, 50.0), (0.01, 100.0), (1e-3, 1e4)] {
            let lamp = Sphere {
                center: Vec3::new(0.0, 0.0, distance),
                radius,
                map: Affine {
                    to_world: glam::Affine3A::IDENTITY,
                    to_object: glam::Affine3A::IDENTITY,
                },
                sign: 1.0,
            };
            let sin_2 = (f64::from(radius) / f64::from(distance)).powi(2);
            let truth = 1.0 / (std::f64::consts::TAU * (1.0 - (1.0 - sin_2).sqrt()));
            // The difference of the two cosines cancels in the truth as well.
            let truth = if sin_2 < 1e-6 {
                1.0 / (std::f64::consts::PI * sin_2)
            } else {
                truth
            };
            for u in [[0.0, 0.0], [0.3, 0.7], [0.999, 0.5]] {
                let s = lamp.sample_direction(Vec3::ZERO, u);
                assert!(
                    (f64::from(s.pdf) / truth - 1.0).abs() < 1e-5,
                    "{radius} {distance}: {} ≠ {truth}",
                    s.pdf
                );
                let again = lamp.pdf_direction(Vec3::ZERO, s.p, s.n);
                assert!((s.pdf / again - 1.0).abs() < 1e-6, "{} ≠ {again}", s.pdf);
                // On the side that faces the reference point.
                assert!((s.p - lamp.center).z <= 0.0);
            }
        }
    }
}
