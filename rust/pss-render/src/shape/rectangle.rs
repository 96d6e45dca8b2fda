//! Mitsuba's rectangle: the square [−1, 1]² in the plane z = 0 of its own space. Two triangles for rays,
//! but sampled as a square.

use embree4::{GeomId, Hit, Ray, SceneBuilder};
use glam::Vec2;
use serde::Deserialize;

use super::{ShapeModel, Tangents};
use super::affine::Affine;
use super::mesh::Mesh;
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

/// `rectangle`
#[derive(Debug)]
pub struct Rectangle {
    map: Affine,
    normal: Vec3,
    mesh: Mesh,
}

impl Rectangle {
    pub(super) fn build(d: Description, _arrays: &mut Arrays) -> Result<Self, SceneError> {
        let map = Affine::new(&d.to_world, &format!("shape {:?}", d.id))?;
        let sign = if d.flip_normals { -1.0 } else { 1.0 };
        // The shading normal is the image of +z, whatever the map does to the triangles' winding.
        let normal = map.normal(Vec3::Z);
        let corners = [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]];
        let flat = |f: &dyn Fn([f32; 2]) -> Vec3| -> Vec<f32> {
            corners.iter().flat_map(|&c| f(c).to_array()).collect()
        };
        let positions = flat(&|[x, y]| map.point(Vec3::new(x, y, 0.0)));
        let normals = flat(&|_| normal);
        let texcoords = corners.iter().flatten().map(|x| 0.5 * (x + 1.0)).collect();
        Ok(Self {
            map,
            normal: normal * sign,
            mesh: Mesh::new(
                positions,
                vec![1, 2, 0, 1, 3, 2],
                Some(normals),
                Some(texcoords),
                d.flip_normals,
                false,
                Vec::new(),
            ),
        })
    }
}

impl ShapeModel for Rectangle {
    fn attach(&self, builder: &mut SceneBuilder, groups: &[embree4::Scene]) -> Result<GeomId, SceneError> {
        self.mesh.attach(builder, groups)
    }

    #[inline]
    fn interaction(&self, ray: &Ray, hit: &Hit, tangents: Tangents) -> Interaction {
        self.mesh.interaction(ray, hit, tangents)
    }

    fn area(&self) -> f32 {
        self.mesh.area()
    }

    fn sample_position(&self, u: [f32; 2]) -> (Vec3, Vec3, Vec2) {
        let local = Vec3::new(2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0, 0.0);
        (self.map.point(local), self.normal, Vec2::from_array(u))
    }

    fn triangles(&self) -> usize {
        2
    }

    fn memory(&self) -> usize {
        self.mesh.memory()
    }
}
