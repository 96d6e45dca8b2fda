//! The open cylinder, exact: x² + y² = 1, 0 ≤ z ≤ 1 in its own space.

use std::f32::consts::TAU;

use embree4::{GeomId, Hit, Quadric, Ray, SceneBuilder};
use glam::Vec2;
use serde::Deserialize;

use super::{ShapeModel, Tangents};
use super::affine::Affine;
use crate::bsdf::BsdfId;
use crate::arrays::Arrays;
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::Vec3;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    to_world: [f32; 16],
    #[serde(default)]
    flip_normals: bool,
    pub(super) bsdf: BsdfId,
    pub(super) emitter: Option<usize>,
}

/// `cylinder`
#[derive(Debug)]
pub struct Cylinder {
    map: Affine,
    /// −1 where the normals point to the axis.
    sign: f32,
    area: f32,
}

impl Cylinder {
    pub(super) fn build(d: Description, _arrays: &mut Arrays) -> Result<Self, SceneError> {
        let map = Affine::new(&d.to_world, &format!("shape {:?}", d.id))?;
        let radius = map.vector(Vec3::X).length();
        let length = map.vector(Vec3::Z).length();
        Ok(Self {
            map,
            sign: if d.flip_normals { -1.0 } else { 1.0 },
            area: TAU * radius * length,
        })
    }

    fn uv(local: Vec3) -> Vec2 {
        let u = local.y.atan2(local.x) / TAU;
        Vec2::new(if u < 0.0 { u + 1.0 } else { u }, local.z)
    }
}

impl ShapeModel for Cylinder {
    fn attach(&self, builder: &mut SceneBuilder, _groups: &[embree4::Scene]) -> Result<GeomId, SceneError> {
        Ok(builder.quadric(Quadric::Cylinder { to_world: self.map.rows() })?)
    }

    fn interaction(&self, ray: &Ray, hit: &Hit, _tangents: Tangents) -> Interaction {
        let q = Vec3::from_array(ray.origin) + Vec3::from_array(ray.dir) * hit.t;
        let mut local = self.map.inverse_point(q);
        // Back onto the unit cylinder: q has the error of a distant origin.
        let r = local.x.hypot(local.y);
        local.x /= r;
        local.y /= r;
        let dp_du = self.map.vector(Vec3::new(-local.y, local.x, 0.0)) * TAU;
        // As Mitsuba: the orientation of (∂p/∂u, ∂p/∂v), which a mirroring map turns round.
        let n = dp_du.cross(self.map.vector(Vec3::Z)).normalize() * self.sign;
        Interaction {
            p: self.map.point(local),
            n,
            shading_normal: n,
            uv: Self::uv(local),
            dp_du,
            dp_dv: self.map.vector(Vec3::Z),
            ..Interaction::default()
        }
    }

    fn area(&self) -> f32 {
        self.area
    }

    fn sample_position(&self, u: [f32; 2]) -> (Vec3, Vec3, Vec2) {
        let (sin, cos) = (TAU * u[1]).sin_cos();
        let p = self.map.point(Vec3::new(cos, sin, u[0]));
        let n = self.map.normal(Vec3::new(cos, sin, 0.0)) * self.sign;
        (p, n, Vec2::new(u[1], u[0]))
    }
}
