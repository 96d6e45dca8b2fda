//! A point on a surface, with all that shading needs.

use glam::Vec2;

use crate::math::{Frame, RAY_EPSILON, SHADOW_EPSILON, Vec3};

/// A place on a triangle of a mesh, for attributes of its vertices and faces.
#[derive(Clone, Copy, Debug)]
pub struct MeshPoint {
    /// Index of the shape.
    pub shape: u32,
    /// Index of the triangle.
    pub prim: u32,
    /// Weights of its second and third vertex.
    pub barycentrics: Vec2,
}

impl MeshPoint {
    /// A place on no mesh.
    pub const NOWHERE: Self = Self {
        shape: u32::MAX,
        prim: 0,
        barycentrics: Vec2::ZERO,
    };
}

/// Where a ray met a surface.
#[derive(Clone, Copy, Debug, Default)]
pub struct Interaction {
    /// Point, world space.
    pub p: Vec3,
    /// Geometric normal, unit length, oriented by the shape (not by the ray).
    pub n: Vec3,
    /// Shading normal, unit length.
    pub shading_normal: Vec3,
    /// Texture coordinates.
    pub uv: Vec2,
    /// ∂p/∂u, for anisotropic BSDFs.
    pub dp_du: Vec3,
    /// ∂p/∂v, for bump maps.
    pub dp_dv: Vec3,
    /// Index of the shape.
    pub shape: u32,
    /// Index of the triangle; 0 on exact shapes.
    pub prim: u32,
    /// Weights of the triangle's second and third vertex.
    pub barycentrics: Vec2,
}

impl Interaction {
    /// Where on which triangle it is.
    #[inline]
    pub fn mesh_point(&self) -> MeshPoint {
        MeshPoint {
            shape: self.shape,
            prim: self.prim,
            barycentrics: self.barycentrics,
        }
    }

    /// Mitsuba's shading frame, measured along ∂p/∂u.
    pub fn uv_frame(&self) -> Frame {
        Frame::from_tangent(self.shading_normal, self.dp_du)
    }

    /// The point moved off the surface to `d`'s side, as Mitsuba does it.
    #[inline]
    pub fn offset(&self, d: Vec3) -> Vec3 {
        let size = (1.0 + self.p.abs().max_element()) * RAY_EPSILON;
        self.p + self.n * size.copysign(self.n.dot(d))
    }

    /// A ray from here on.
    #[inline]
    pub fn spawn_ray(&self, d: Vec3) -> embree4::Ray {
        embree4::Ray::new(self.offset(d).to_array(), d.to_array())
    }

    /// A ray from here that ends just before `target`.
    #[inline]
    pub fn spawn_ray_to(&self, target: Vec3) -> embree4::Ray {
        let origin = self.offset(target - self.p);
        let d = target - origin;
        let distance = d.length();
        embree4::Ray::new(origin.to_array(), (d / distance).to_array())
            .until(distance * (1.0 - SHADOW_EPSILON))
    }
}
