//! A scene whose truth is known.
#![allow(clippy::unwrap_used)]

use std::path::PathBuf;

use pssflow::pss_render::Scene;
use serde_json::json;

/// The inside of an emitting sphere of albedo ½, radiance 1: two bounces carry ¼ everywhere.
pub(crate) fn furnace(size: u32) -> Scene {
    let identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
    let description = json!({
        "schema": 1,
        "textures": [
            { "type": "constant", "id": "albedo", "value": [0.5, 0.5, 0.5] },
            { "type": "constant", "id": "emitted", "value": [1.0, 1.0, 1.0] },
        ],
        "bsdfs": [{ "type": "diffuse", "id": "wall", "reflectance": 0 }],
        "shapes": [{
            "type": "sphere", "id": "furnace", "center": [0, 0, 0], "radius": 1.0, "flip_normals": true,
            "to_world": identity, "bsdf": 0, "emitter": 0,
        }],
        "emitters": [{ "type": "area", "id": "light", "shape": 0, "radiance": 1 }],
        "sensor": {
            "type": "perspective", "to_world": identity, "x_fov": 60.0, "near_clip": 0.01, "far_clip": 1e4,
            "principal_point_offset": [0.0, 0.0],
        },
        "film": {
            "size": [size, size], "crop_offset": [0, 0], "crop_size": [size, size],
            "rfilter": { "type": "box", "radius": 0.5, "table": [] },
        },
    });
    // The Makefile sets PSSFLOW_EMBREE_DIRS; a plain `cargo test` finds the wheel in `.venv`.
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../.venv/lib");
    let python = std::fs::read_dir(root).into_iter().flatten().flatten();
    let sites: Vec<PathBuf> = python.map(|p| p.path().join("site-packages")).collect();
    embree4::add_search_dirs(&sites);
    let device = embree4::Device::new().unwrap();
    Scene::new(&description.to_string(), Vec::new(), &device).unwrap()
}
