//! Object → world maps of the exact shapes.

use glam::{Affine3A, Mat3A};

use crate::arrays::check_all_finite;
use crate::error::SceneError;
use crate::math::Vec3;

/// An affine map with its inverse.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Affine {
    pub(crate) to_world: Affine3A,
    pub(crate) to_object: Affine3A,
}

impl Affine {
    /// From 16 numbers, row-major.
    pub(crate) fn new(m: &[f32; 16], owner: &str) -> Result<Self, SceneError> {
        check_all_finite(m, owner, "to_world")?;
        let to_world = Affine3A::from_mat3_translation(
            glam::Mat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]),
            glam::Vec3::new(m[3], m[7], m[11]),
        );
        let to_object = to_world.inverse();
        let finite = to_object.is_finite() && to_world.matrix3.determinant() != 0.0;
        crate::arrays::check(
            finite,
            owner,
            "to_world",
            to_world.matrix3.determinant(),
            "invertible (its determinant must not be 0)",
        )?;
        Ok(Self {
            to_world,
            to_object,
        })
    }

    /// 3×4, row-major, for Embree.
    pub(crate) fn rows(&self) -> [f32; 12] {
        let m: Mat3A = self.to_world.matrix3;
        let t = self.to_world.translation;
        let (x, y, z) = (m.x_axis, m.y_axis, m.z_axis);
        [x.x, y.x, z.x, t.x, x.y, y.y, z.y, t.y, x.z, y.z, z.z, t.z]
    }

    pub(crate) fn point(&self, p: Vec3) -> Vec3 {
        self.to_world.transform_point3a(p)
    }

    pub(crate) fn vector(&self, v: Vec3) -> Vec3 {
        self.to_world.transform_vector3a(v)
    }

    /// A normal: by the inverse transpose, then unit length.
    pub(crate) fn normal(&self, n: Vec3) -> Vec3 {
        (self.to_object.matrix3.transpose() * n).normalize()
    }

    pub(crate) fn inverse_point(&self, p: Vec3) -> Vec3 {
        self.to_object.transform_point3a(p)
    }
}
