//! Named values at the vertices or faces of a mesh, for the texture `mesh_attribute`.

use std::sync::Arc;

use embree4::Shared;
use serde::Deserialize;

use crate::arrays::{ArrayRef, Arrays};
use crate::error::SceneError;
use crate::interaction::MeshPoint;
use crate::math::Rgb;

/// What the values belong to.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub(super) enum Per {
    Vertex,
    Face,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Description {
    name: String,
    pub(super) per: Per,
    data: ArrayRef,
    /// Numbers of each value: 1 or 3.
    channels: usize,
}

/// One attribute of one mesh.
#[derive(Debug)]
pub(crate) struct Attribute {
    name: String,
    per: Per,
    channels: usize,
    data: Vec<f32>,
    faces: Shared<u32>,
}

/// A value as it was read, before the mesh is known in full.
pub(super) struct Loose {
    pub(super) per: Per,
    pub(super) channels: usize,
    pub(super) data: Vec<f32>,
    name: String,
}

impl Loose {
    /// Takes the values of one attribute; `rows` is the number of vertices or faces.
    pub(super) fn build(
        d: Description,
        arrays: &mut Arrays,
        owner: &str,
        rows: usize,
    ) -> Result<Self, SceneError> {
        if d.channels != 1 && d.channels != 3 {
            return Err(SceneError::Array {
                owner: owner.to_owned(),
                name: "attribute",
                found: format!("{:?} of {} channels", d.name, d.channels),
                expected: "1 or 3".to_owned(),
            });
        }
        let data = arrays.take_f32(d.data, owner, "attribute", d.channels)?;
        if data.len() != rows * d.channels {
            return Err(SceneError::Array {
                owner: owner.to_owned(),
                name: "attribute",
                found: format!("{:?} of {} rows", d.name, data.len() / d.channels),
                expected: format!("one a vertex or face ({rows})"),
            });
        }
        Ok(Self {
            per: d.per,
            channels: d.channels,
            data,
            name: d.name,
        })
    }

    /// The attribute of a mesh with these faces.
    pub(super) fn on(self, faces: Shared<u32>) -> Attribute {
        Attribute {
            name: self.name,
            per: self.per,
            channels: self.channels,
            data: self.data,
            faces,
        }
    }
}

impl Attribute {
    /// The value at a place on the mesh, and its number of channels.
    pub(crate) fn at(&self, place: MeshPoint) -> Option<(Rgb, usize)> {
        let value = |i: usize| {
            let v = self.data.get(i * self.channels..(i + 1) * self.channels)?;
            Some(if self.channels == 3 {
                Rgb::from_slice(v)
            } else {
                Rgb::splat(v[0])
            })
        };
        let prim = place.prim as usize;
        let blended = match self.per {
            Per::Face => value(prim)?,
            Per::Vertex => {
                let face = self.faces.get(3 * prim..3 * prim + 3)?;
                let [u, v] = place.barycentrics.to_array();
                value(face[0] as usize)? * (1.0 - u - v)
                    + value(face[1] as usize)? * u
                    + value(face[2] as usize)? * v
            }
        };
        Some((blended, self.channels))
    }

    /// Bytes of its values.
    pub(super) fn memory(&self) -> usize {
        4 * self.data.len()
    }
}

/// The attributes of all meshes, by shape; without any it is empty.
#[derive(Debug, Default)]
pub struct Attributes(Vec<Arc<[Attribute]>>);

impl Attributes {
    /// Those of each shape in order.
    pub(crate) fn new(by_shape: Vec<Arc<[Attribute]>>) -> Self {
        if by_shape.iter().all(|a| a.is_empty()) {
            return Self::default();
        }
        Self(by_shape)
    }

    /// A shape's attribute of this name.
    pub(crate) fn get(&self, shape: u32, name: &str) -> Option<&Attribute> {
        self.0.get(shape as usize)?.iter().find(|a| a.name == name)
    }
}
