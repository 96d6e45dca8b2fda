//! Mitsuba's `instance`: a transformed view of a group of shapes, which is held once however often it is seen.

use embree4::{GeomId, Hit, Ray, SceneBuilder};
use glam::Vec2;
use serde::Deserialize;

use super::{ShapeModel, Tangents};
use super::affine::Affine;
use crate::arrays::Arrays;
use crate::bsdf::BsdfId;
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::Vec3;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    /// Index of the group.
    group: usize,
    to_world: [f32; 16],
    /// The shapes of the group have BSDFs of their own.
    #[serde(skip)]
    pub(super) bsdf: BsdfId,
    #[serde(skip)]
    pub(super) emitter: Option<usize>,
}

/// `instance`
#[derive(Debug)]
pub struct Instance {
    id: String,
    group: usize,
    map: Affine,
}

impl Instance {
    pub(super) fn build(d: Description, _arrays: &mut Arrays) -> Result<Self, SceneError> {
        Ok(Self {
            map: Affine::new(&d.to_world, &format!("shape {:?}", d.id))?,
            id: d.id,
            group: d.group,
        })
    }

    /// Index of the group that it shows.
    pub(crate) fn group(&self) -> usize {
        self.group
    }

    /// A ray in the group's space. Its direction keeps its length there, so that distances along it are
    /// those along the ray.
    #[inline]
    pub(crate) fn to_group(&self, ray: &Ray) -> Ray {
        let origin = self.map.inverse_point(Vec3::from_array(ray.origin));
        let dir = self
            .map
            .to_object
            .transform_vector3a(Vec3::from_array(ray.dir));
        Ray {
            origin: origin.to_array(),
            dir: dir.to_array(),
            ..*ray
        }
    }

    /// A surface of the group, where this instance shows it.
    #[inline]
    pub(crate) fn place(&self, si: &mut Interaction) {
        si.p = self.map.point(si.p);
        si.n = self.map.normal(si.n);
        si.shading_normal = self.map.normal(si.shading_normal);
        si.dp_du = self.map.vector(si.dp_du);
        si.dp_dv = self.map.vector(si.dp_dv);
    }
}

impl ShapeModel for Instance {
    fn attach(
        &self,
        builder: &mut SceneBuilder,
        groups: &[embree4::Scene],
    ) -> Result<GeomId, SceneError> {
        let group = groups
            .get(self.group)
            .ok_or_else(|| SceneError::Reference {
                owner: format!("shape {:?}", self.id),
                what: "group",
                index: self.group,
                count: groups.len(),
            })?;
        Ok(builder.instance(group, &self.map.rows())?)
    }

    /// What a ray meets is a shape of the group, never the instance itself.
    fn interaction(&self, _ray: &Ray, _hit: &Hit, _tangents: Tangents) -> Interaction {
        Interaction::default()
    }

    fn area(&self) -> f32 {
        0.0
    }

    fn sample_position(&self, _u: [f32; 2]) -> (Vec3, Vec3, Vec2) {
        (Vec3::ZERO, Vec3::Z, Vec2::ZERO)
    }
}
