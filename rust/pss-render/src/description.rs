//! What comes from Python: one JSON description and a list of arrays (schema 1).
//!
//! The description names arrays by their index in the list. Each plugin's part is described beside its
//! code (`bsdf/`, `texture/`, …); this file holds the frame around them.

use serde::Deserialize;

use crate::arrays::Array;
use crate::{bsdf, emitter, film, sensor, shape, texture};

/// The schema that this version reads.
pub const SCHEMA: u32 = 1;

/// Which schema a description has, whatever else is in it.
#[derive(Debug, Deserialize)]
pub(crate) struct Version {
    pub(crate) schema: u32,
}

/// The whole description.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SceneDescription {
    /// Read before the rest, as [`Version`].
    #[serde(rename = "schema")]
    _schema: u32,
    pub(crate) textures: Vec<texture::Description>,
    pub(crate) bsdfs: Vec<bsdf::Description>,
    pub(crate) shapes: Vec<shape::Description>,
    /// What instances show.
    #[serde(default)]
    pub(crate) groups: Vec<GroupDescription>,
    pub(crate) emitters: Vec<emitter::Description>,
    pub(crate) sensor: sensor::Description,
    pub(crate) film: film::Description,
    /// Camera rays pass through the surfaces of emitters, as with Mitsuba's option of that name.
    #[serde(default)]
    pub(crate) hide_emitters: bool,
}

/// Shapes in a space of their own.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct GroupDescription {
    #[serde(rename = "id")]
    _id: String,
    pub(crate) shapes: Vec<shape::Description>,
}

/// Hash of everything that decides the image (hex): the guide of one scene is refused by another.
pub(crate) fn scene_hash(description: &serde_json::Value, arrays: &[Array]) -> String {
    let mut hasher = blake3::Hasher::new();
    hasher.update(description.to_string().as_bytes());
    let mut words = Vec::new();
    for array in arrays {
        let (tag, shape) = match array {
            Array::F32 { shape, .. } => (0u8, shape),
            Array::U32 { shape, .. } => (1u8, shape),
            Array::U8 { shape, .. } => (2u8, shape),
        };
        hasher.update(&[tag]);
        for n in shape {
            hasher.update(&(*n as u64).to_le_bytes());
        }
        // In chunks: the whole array as bytes would double the memory.
        let count = match array {
            Array::F32 { data, .. } => data.len(),
            Array::U32 { data, .. } => data.len(),
            Array::U8 { data, .. } => data.len(),
        };
        for start in (0..count).step_by(1 << 16) {
            let end = (start + (1 << 16)).min(count);
            words.clear();
            match array {
                Array::F32 { data, .. } => {
                    words.extend(data[start..end].iter().flat_map(|x| x.to_le_bytes()));
                }
                Array::U32 { data, .. } => {
                    words.extend(data[start..end].iter().flat_map(|x| x.to_le_bytes()));
                }
                Array::U8 { data, .. } => words.extend_from_slice(&data[start..end]),
            }
            hasher.update(&words);
        }
    }
    hasher.finalize().to_hex()[..32].to_owned()
}
