//! The disk, exact: x² + y² ≤ 1 in the plane z = 0 of its own space.

use std::f32::consts::{PI, TAU};

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
use crate::warp::square_to_uniform_disk_concentric;

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

/// `disk`
#[derive(Debug)]
pub struct Disk {
    map: Affine,
    normal: Vec3,
    area: f32,
}

impl Disk {
    pub(super) fn build(d: Description, _arrays: &mut Arrays) -> Result<Self, SceneError> {
        let map = Affine::new(&d.to_world, &format!("shape {:?}", d.id))?;
        let sign = if d.flip_normals { -1.0 } else { 1.0 };
        let (du, dv) = (map.vector(Vec3::X), map.vector(Vec3::Y));
        Ok(Self {
            map,
            normal: map.normal(Vec3::Z) * sign,
            area: PI * du.cross(dv).length(),
        })
    }

    fn uv(x: f32, y: f32) -> Vec2 {
        let v = y.atan2(x) / TAU;
        Vec2::new(x.hypot(y), if v < 0.0 { v + 1.0 } else { v })
    }
}

impl ShapeModel for Disk {
    fn attach(&self, builder: &mut SceneBuilder, _groups: &[embree4::Scene]) -> Result<GeomId, SceneError> {
        Ok(builder.quadric(Quadric::Disk { to_world: self.map.rows() })?)
    }

    fn interaction(&self, ray: &Ray, hit: &Hit, _tangents: Tangents) -> Interaction {
        let q = Vec3::from_array(ray.origin) + Vec3::from_array(ray.dir) * hit.t;
        // Back into the plane: q has the error of a distant origin.
        let center = self.map.to_world.translation;
        let p = q + self.normal * (center - q).dot(self.normal);
        let local = self.map.inverse_point(p);
        let r = local.x.hypot(local.y);
        let (cos_phi, sin_phi) = if r > 0.0 { (local.x / r, local.y / r) } else { (1.0, 0.0) };
        Interaction {
            p,
            n: self.normal,
            shading_normal: self.normal,
            uv: Self::uv(local.x, local.y),
            dp_du: self.map.vector(Vec3::new(cos_phi, sin_phi, 0.0)),
            dp_dv: self.map.vector(Vec3::new(-sin_phi, cos_phi, 0.0)) * (TAU * r),
            ..Interaction::default()
        }
    }

    fn area(&self) -> f32 {
        self.area
    }

    fn sample_position(&self, u: [f32; 2]) -> (Vec3, Vec3, Vec2) {
        let d = square_to_uniform_disk_concentric(u);
        let p = self.map.point(Vec3::new(d.x, d.y, 0.0));
        (p, self.normal, Self::uv(d.x, d.y))
    }
}
