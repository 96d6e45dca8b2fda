//! Triangle meshes.

use std::sync::Arc;

use embree4::{GeomId, Hit, Ray, SceneBuilder, Shared};
use glam::Vec2;
use serde::Deserialize;

use super::{ShapeModel, Tangents};
use super::attribute::{self, Attribute, Loose, Per};
use crate::bsdf::BsdfId;
use crate::arrays::{ArrayRef, Arrays};
use crate::distribution::Discrete;
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::{Vec3, coordinate_system};
use crate::warp::square_to_uniform_triangle;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    positions: ArrayRef,
    faces: ArrayRef,
    normals: Option<ArrayRef>,
    texcoords: Option<ArrayRef>,
    #[serde(default)]
    flip_normals: bool,
    #[serde(default)]
    attributes: Vec<attribute::Description>,
    pub(super) bsdf: BsdfId,
    pub(super) emitter: Option<usize>,
}

/// `mesh`: vertices in world space, with optional normals and texture coordinates.
#[derive(Debug)]
pub struct Mesh {
    /// Embree reads these two in place.
    positions: Shared<f32>,
    faces: Shared<u32>,
    normals: Option<Vec<f32>>,
    texcoords: Option<Vec<f32>>,
    /// Face areas, only where the mesh emits.
    by_area: Option<Discrete>,
    area: f32,
    /// −1 where the normals are flipped.
    sign: f32,
    degenerate: usize,
    attributes: Arc<[Attribute]>,
}

impl Mesh {
    pub(super) fn build(d: Description, arrays: &mut Arrays) -> Result<Self, SceneError> {
        let owner = format!("shape {:?}", d.id);
        let positions = arrays.take_f32(d.positions, &owner, "positions", 3)?;
        let faces = arrays.take_u32(d.faces, &owner, "faces", 3)?;
        let vertices = positions.len() / 3;
        if let Some(i) = faces.iter().position(|&v| v as usize >= vertices) {
            return Err(SceneError::FaceIndex {
                id: d.id,
                face: i / 3,
                vertex: faces[i],
                vertices,
            });
        }
        let per_vertex = |data: Vec<f32>, columns: usize, name: &'static str| {
            if data.len() == vertices * columns {
                Ok(data)
            } else {
                Err(SceneError::Array {
                    owner: owner.clone(),
                    name,
                    found: format!("{} rows", data.len() / columns),
                    expected: format!("one a vertex ({vertices})"),
                })
            }
        };
        let normals = d
            .normals
            .map(|a| per_vertex(arrays.take_f32(a, &owner, "normals", 3)?, 3, "normals"))
            .transpose()?;
        let texcoords = d
            .texcoords
            .map(|a| per_vertex(arrays.take_f32(a, &owner, "texcoords", 2)?, 2, "texcoords"))
            .transpose()?;
        let attributes = d
            .attributes
            .into_iter()
            .map(|a| {
                let rows = if a.per == Per::Vertex { vertices } else { faces.len() / 3 };
                Loose::build(a, arrays, &owner, rows)
            })
            .collect::<Result<Vec<_>, _>>()?;
        let emits = d.emitter.is_some();
        Ok(Self::new(positions, faces, normals, texcoords, d.flip_normals, emits, attributes))
    }

    pub(super) fn new(
        positions: Vec<f32>,
        mut faces: Vec<u32>,
        normals: Option<Vec<f32>>,
        texcoords: Option<Vec<f32>>,
        flip_normals: bool,
        emits: bool,
        mut attributes: Vec<Loose>,
    ) -> Self {
        let vertex = |i: u32| Vec3::from_slice(&positions[3 * i as usize..][..3]);
        let area = |f: &[u32]| {
            let (p0, p1, p2) = (vertex(f[0]), vertex(f[1]), vertex(f[2]));
            0.5 * (p1 - p0).cross(p2 - p0).length()
        };
        // A triangle without area can be neither hit nor sampled, but its normal would be NaN.
        let before = faces.len() / 3;
        let mut kept = 0;
        for i in 0..before {
            let face = [faces[3 * i], faces[3 * i + 1], faces[3 * i + 2]];
            if area(&face) > 0.0 {
                faces[3 * kept..3 * kept + 3].copy_from_slice(&face);
                for a in attributes.iter_mut().filter(|a| a.per == Per::Face) {
                    a.data.copy_within(i * a.channels..(i + 1) * a.channels, kept * a.channels);
                }
                kept += 1;
            }
        }
        faces.truncate(3 * kept);
        let areas = || faces.chunks_exact(3).map(area);
        let total: f64 = areas().map(f64::from).sum();
        let by_area = emits.then(|| Discrete::new(areas()));
        let faces = Shared::from(faces);
        Self {
            area: total as f32,
            by_area,
            positions: positions.into(),
            attributes: attributes.into_iter().map(|a| a.on(faces.clone())).collect(),
            faces,
            normals,
            texcoords,
            sign: if flip_normals { -1.0 } else { 1.0 },
            degenerate: before - kept,
        }
    }

    #[inline]
    fn face(&self, prim: usize) -> [usize; 3] {
        let f = &self.faces[3 * prim..3 * prim + 3];
        [f[0] as usize, f[1] as usize, f[2] as usize]
    }

    #[inline]
    fn position(&self, i: usize) -> Vec3 {
        Vec3::from_slice(&self.positions[3 * i..3 * i + 3])
    }

    /// ∂p/∂u and ∂p/∂v of a triangle with two edges, texture coordinates and a normal.
    fn tangents(&self, e1: Vec3, e2: Vec3, [t0, t1, t2]: [Vec2; 3], n: Vec3) -> (Vec3, Vec3) {
        let (d1, d2) = (t1 - t0, t2 - t0);
        let det = d1.perp_dot(d2);
        if det == 0.0 {
            // Coordinates that are all the same, say: Mitsuba takes arbitrary tangents, of the normal before it is
            // flipped. These are the same, so that bumps and anisotropic lobes are.
            coordinate_system(n * self.sign)
        } else {
            ((e1 * d2.y - e2 * d1.y) / det, (e2 * d1.x - e1 * d2.x) / det)
        }
    }

    /// Interpolated vertex normal, not normalised.
    #[inline]
    fn normal(normals: &[f32], face: [usize; 3], b: [f32; 3]) -> Vec3 {
        let n = |i: usize| Vec3::from_slice(&normals[3 * i..3 * i + 3]);
        n(face[0]) * b[0] + n(face[1]) * b[1] + n(face[2]) * b[2]
    }
}

#[inline]
fn texcoord(texcoords: &[f32], i: usize) -> Vec2 {
    Vec2::new(texcoords[2 * i], texcoords[2 * i + 1])
}

impl ShapeModel for Mesh {
    fn attach(&self, builder: &mut SceneBuilder, _groups: &[embree4::Scene]) -> Result<GeomId, SceneError> {
        Ok(builder.shared_triangles(&self.positions, &self.faces)?)
    }

    #[inline]
    fn interaction(&self, _ray: &Ray, hit: &Hit, tangents: Tangents) -> Interaction {
        let face = self.face(hit.prim as usize);
        let [p0, p1, p2] = face.map(|i| self.position(i));
        let b = [1.0 - hit.u - hit.v, hit.u, hit.v];
        let (e1, e2) = (p1 - p0, p2 - p0);
        let n = e1.cross(e2).normalize() * self.sign;
        let shading_normal = match &self.normals {
            Some(normals) => {
                let s = Self::normal(normals, face, b).normalize_or_zero() * self.sign;
                if s == Vec3::ZERO { n } else { s }
            }
            None => n,
        };
        let (uv, dp_du, dp_dv) = match &self.texcoords {
            Some(texcoords) => {
                let t = face.map(|i| texcoord(texcoords, i));
                let (dp_du, dp_dv) = match tangents {
                    Tangents::Wanted => self.tangents(e1, e2, t, n),
                    Tangents::Unused => (Vec3::ZERO, Vec3::ZERO),
                };
                (t[0] * b[0] + t[1] * b[1] + t[2] * b[2], dp_du, dp_dv)
            }
            None => (Vec2::new(b[1], b[2]), e1, e2),
        };
        Interaction {
            p: p0 * b[0] + p1 * b[1] + p2 * b[2],
            n,
            shading_normal,
            uv,
            dp_du,
            dp_dv,
            shape: 0,
            prim: hit.prim,
            barycentrics: Vec2::new(hit.u, hit.v),
        }
    }

    fn area(&self) -> f32 {
        self.area
    }

    fn sample_position(&self, u: [f32; 2]) -> (Vec3, Vec3, Vec2) {
        // Mitsuba chooses the triangle from the second number.
        let Some((prim, _, u1)) = self.by_area.as_ref().and_then(|d| d.sample_reuse(u[1])) else {
            return (Vec3::ZERO, Vec3::Z, Vec2::ZERO);
        };
        let face = self.face(prim);
        let [p0, p1, p2] = face.map(|i| self.position(i));
        let [b1, b2] = square_to_uniform_triangle([u[0], u1]);
        let b = [1.0 - b1 - b2, b1, b2];
        let uv = match &self.texcoords {
            Some(t) => {
                let [t0, t1, t2] = face.map(|i| texcoord(t, i));
                t0 * b[0] + t1 * b[1] + t2 * b[2]
            }
            None => Vec2::new(b1, b2),
        };
        let n = match &self.normals {
            Some(normals) => Self::normal(normals, face, b),
            None => (p1 - p0).cross(p2 - p0),
        };
        let p = p0 * b[0] + p1 * b[1] + p2 * b[2];
        (p, n.normalize_or_zero() * self.sign, uv)
    }

    fn triangles(&self) -> usize {
        self.faces.len() / 3
    }

    fn degenerate(&self) -> usize {
        self.degenerate
    }

    fn attributes(&self) -> Arc<[Attribute]> {
        Arc::clone(&self.attributes)
    }

    fn memory(&self) -> usize {
        let optional = |a: &Option<Vec<f32>>| a.as_ref().map_or(0, Vec::len);
        4 * (self.positions.len()
            + self.faces.len()
            + optional(&self.normals)
            + optional(&self.texcoords))
            + self.attributes.iter().map(Attribute::memory).sum::<usize>()
    }
}
