//! The oracle for tests: the same scenes and the same answers as [`crate::Scene`], without Embree.
//!
//! Every ray meets every primitive, in double precision and with other formulas than the fast path:
//! triangles by Möller and Trumbore (*Fast, minimum storage ray/triangle intersection*, 1997), spheres and
//! cylinders by the plain quadratic equation in the shape's own space. Slow on purpose; nothing but tests
//! should use it. It answers on machines without Embree too.

use std::borrow::Borrow;

use crate::scene::check_mesh;
use crate::shapes::{Affine, Prepared, cross, dot};
use crate::{EmbreeError, GeomId, Hit, Quadric, Ray};

/// A list of geometry, traced as it stands.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    geometries: Vec<Geometry>,
}

#[derive(Clone, Debug)]
enum Geometry {
    Mesh(Vec<[[f64; 3]; 3]>),
    /// The unit sphere, disk or cylinder, seen through a map.
    Unit(Unit, Affine),
    Instance(Scene, Affine),
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Unit {
    Sphere,
    Disk,
    Cylinder,
}

/// A hit in double precision.
#[derive(Clone, Copy)]
struct Found {
    t: f64,
    uv: [f64; 2],
    ng: [f64; 3],
    geom: u32,
    prim: u32,
    inst: Option<u32>,
}

impl Scene {
    /// Nothing.
    pub fn new() -> Self {
        Self::default()
    }

    /// As [`crate::SceneBuilder::triangles`].
    ///
    /// # Errors
    /// As there.
    pub fn triangles(
        &mut self,
        positions: impl AsRef<[f32]>,
        faces: impl AsRef<[u32]>,
    ) -> Result<GeomId, EmbreeError> {
        let (positions, faces) = (positions.as_ref(), faces.as_ref());
        check_mesh(positions, faces)?;
        let vertex = |i: u32| [0, 1, 2].map(|axis| f64::from(positions[3 * i as usize + axis]));
        let corners = faces
            .chunks_exact(3)
            .map(|f| [vertex(f[0]), vertex(f[1]), vertex(f[2])]);
        Ok(self.push(Geometry::Mesh(corners.collect())))
    }

    /// As [`crate::SceneBuilder::quadric`].
    ///
    /// # Errors
    /// As there.
    pub fn quadric(&mut self, quadric: impl Borrow<Quadric>) -> Result<GeomId, EmbreeError> {
        // The checks are shared, the formulas aren't.
        let quadric = quadric.borrow();
        Prepared::new(quadric)?;
        let (unit, to_world) = match *quadric {
            Quadric::Sphere {
                center: [x, y, z],
                radius: r,
            } => (
                Unit::Sphere,
                [r, 0.0, 0.0, x, 0.0, r, 0.0, y, 0.0, 0.0, r, z],
            ),
            Quadric::Disk { to_world } => (Unit::Disk, to_world),
            Quadric::Cylinder { to_world } => (Unit::Cylinder, to_world),
        };
        let (_, to_object) = Affine::invertible("quadric", &to_world)?;
        Ok(self.push(Geometry::Unit(unit, to_object)))
    }

    /// As [`crate::SceneBuilder::instance`].
    ///
    /// # Errors
    /// As there.
    pub fn instance(&mut self, scene: &Self, to_world: &[f32; 12]) -> Result<GeomId, EmbreeError> {
        if scene
            .geometries
            .iter()
            .any(|g| matches!(g, Geometry::Instance(..)))
        {
            return Err(EmbreeError::NestedInstance);
        }
        let (_, to_instance) = Affine::invertible("instance", to_world)?;
        Ok(self.push(Geometry::Instance(scene.clone(), to_instance)))
    }

    fn push(&mut self, geometry: Geometry) -> GeomId {
        self.geometries.push(geometry);
        GeomId((self.geometries.len() - 1) as u32)
    }

    /// As [`crate::Scene::intersect`].
    pub fn intersect(&self, ray: &Ray) -> Option<Hit> {
        let (tnear, tfar) = (f64::from(ray.tnear).max(0.0), f64::from(ray.tfar));
        let found = self.nearest(
            ray.origin.map(f64::from),
            ray.dir.map(f64::from),
            tnear,
            tfar,
        )?;
        Some(Hit {
            t: found.t as f32,
            u: found.uv[0] as f32,
            v: found.uv[1] as f32,
            ng: found.ng.map(|x| x as f32),
            geom: found.geom,
            prim: found.prim,
            inst: found.inst,
        })
    }

    /// As [`crate::Scene::occluded`].
    pub fn occluded(&self, ray: &Ray) -> bool {
        self.intersect(ray).is_some()
    }

    fn nearest(&self, o: [f64; 3], d: [f64; 3], tnear: f64, tfar: f64) -> Option<Found> {
        let mut best: Option<Found> = None;
        for (geom, geometry) in (0..).zip(&self.geometries) {
            let limit = best.map_or(tfar, |found| found.t);
            let found = match geometry {
                Geometry::Mesh(triangles) => {
                    let hits = (0..).zip(triangles).filter_map(|(prim, corners)| {
                        triangle(corners, o, d, tnear, limit).map(|(t, uv, ng)| Found {
                            t,
                            uv,
                            ng,
                            geom,
                            prim,
                            inst: None,
                        })
                    });
                    hits.min_by(|a, b| a.t.total_cmp(&b.t))
                }
                Geometry::Unit(unit, to_object) => {
                    let (o, d) = (to_object.point(o), to_object.vector(d));
                    unit.hit(o, d, tnear, limit).map(|(t, n)| Found {
                        t,
                        uv: [0.0; 2],
                        ng: to_object.transposed_vector(n),
                        geom,
                        prim: 0,
                        inst: None,
                    })
                }
                Geometry::Instance(scene, to_instance) => scene
                    .nearest(to_instance.point(o), to_instance.vector(d), tnear, limit)
                    .map(|found| Found {
                        ng: to_instance.transposed_vector(found.ng),
                        inst: Some(geom),
                        ..found
                    }),
            };
            best = found.or(best);
        }
        best
    }
}

impl Unit {
    /// Nearest point of the unit shape with its normal, in the shape's space.
    fn hit(self, o: [f64; 3], d: [f64; 3], tnear: f64, tfar: f64) -> Option<(f64, [f64; 3])> {
        // Sphere: x² + y² + z² = 1. Cylinder: x² + y² = 1. The weight of z² is the only difference.
        let w = if self == Self::Sphere { 1.0 } else { 0.0 };
        let product = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + w * a[2] * b[2];
        let at = |t: f64| [o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]];
        let candidates = if self == Self::Disk {
            [-o[2] / d[2]; 2]
        } else {
            let (a, b, c) = (product(d, d), 2.0 * product(o, d), product(o, o) - 1.0);
            let root = (b * b - 4.0 * a * c).sqrt();
            [(-b - root) / (2.0 * a), (-b + root) / (2.0 * a)]
        };
        let t = candidates.into_iter().find(|&t| {
            let p = at(t);
            let on_shape = match self {
                Self::Sphere => true,
                Self::Disk => p[0] * p[0] + p[1] * p[1] <= 1.0,
                Self::Cylinder => (0.0..=1.0).contains(&p[2]),
            };
            t >= tnear && t <= tfar && on_shape
        })?;
        let p = at(t);
        let normal = match self {
            Self::Sphere => p,
            Self::Disk => [0.0, 0.0, 1.0],
            Self::Cylinder => [p[0], p[1], 0.0],
        };
        Some((t, normal))
    }
}

/// Distance, barycentric weights of the second and third corner, and (p1 − p0) × (p2 − p0).
fn triangle(
    [p0, p1, p2]: &[[f64; 3]; 3],
    o: [f64; 3],
    d: [f64; 3],
    tnear: f64,
    tfar: f64,
) -> Option<(f64, [f64; 2], [f64; 3])> {
    let sub = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    let (e1, e2, s) = (sub(*p1, *p0), sub(*p2, *p0), sub(o, *p0));
    let h = cross(d, e2);
    let det = dot(e1, h);
    // Edge-on rays and triangles without area.
    if det == 0.0 {
        return None;
    }
    let q = cross(s, e1);
    let (t, u, v) = (dot(e2, q) / det, dot(s, h) / det, dot(d, q) / det);
    let inside = u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t >= tnear && t <= tfar;
    inside.then(|| (t, [u, v], cross(e1, e2)))
}
