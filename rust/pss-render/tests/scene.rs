//! Scenes with a known answer, and scenes that must be refused.
#![allow(clippy::unwrap_used)]

use std::path::PathBuf;

use pss_render::math::luminance;
use pss_render::{
    Array, EmitterStrategy, Parametrisation, Paths, Scene, SceneError, TraceError, Tracer, Uniform,
};
use pss_rng::{Purpose, Stream};
use serde_json::{Value, json};

fn device() -> embree4::Device {
    // The Makefile sets PSSFLOW_EMBREE_DIRS; a plain `cargo test` finds the wheel in `.venv`.
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../.venv/lib");
    let python = std::fs::read_dir(root).into_iter().flatten().flatten();
    let sites: Vec<PathBuf> = python.map(|p| p.path().join("site-packages")).collect();
    embree4::add_search_dirs(&sites);
    embree4::Device::new().unwrap()
}

const IDENTITY: [f32; 16] = [
    1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.,
];

/// Everything but shapes, BSDFs and emitters: a camera at the origin that looks along +z.
fn frame() -> Value {
    json!({
        "schema": 1,
        "textures": [],
        "bsdfs": [],
        "shapes": [],
        "emitters": [],
        "sensor": {
            "type": "perspective", "to_world": IDENTITY, "x_fov": 60.0, "near_clip": 0.01,
            "far_clip": 1e4, "principal_point_offset": [0.0, 0.0],
        },
        "film": {
            "size": [8, 8], "crop_offset": [0, 0], "crop_size": [8, 8],
            "rfilter": { "type": "box", "radius": 0.5, "table": [] },
        },
    })
}

/// The inside of a sphere of albedo `albedo` that emits `emitted`: its k-bounce radiance is
/// emitted · albedoᵏ in every direction.
fn furnace(albedo: f32, emitted: f32) -> Value {
    let mut d = frame();
    d["textures"] = json!([
        { "type": "constant", "id": "albedo", "value": [albedo, albedo, albedo] },
        { "type": "constant", "id": "emitted", "value": [emitted, emitted, emitted] },
    ]);
    d["bsdfs"] = json!([{ "type": "diffuse", "id": "wall", "reflectance": 0 }]);
    d["shapes"] = json!([{
        "type": "sphere", "id": "furnace", "center": [0.1, -0.2, 0.3], "radius": 2.0,
        "flip_normals": true, "to_world": IDENTITY, "bsdf": 0, "emitter": 0,
    }]);
    d["emitters"] = json!([{ "type": "area", "id": "furnace.emitter", "shape": 0, "radiance": 1 }]);
    d
}

fn build(d: &Value, arrays: Vec<Array>) -> Result<Scene, SceneError> {
    Scene::new(&d.to_string(), arrays, &device())
}

/// Uniform paths, traced: luminances of f.
fn trace(scene: &Scene, k: usize, p: Parametrisation, s: EmitterStrategy, n: usize) -> Vec<f32> {
    let tracer = Tracer::new(scene, k, p, s).unwrap();
    let mut paths = Paths::new(tracer.columns());
    let mut numbers = Stream::new(1, Purpose::Test).sequence(0, 0);
    for _ in 0..n {
        paths
            .film
            .push([numbers.next_f32() * 8.0, numbers.next_f32() * 8.0]);
        paths
            .u
            .extend((0..tracer.columns().width()).map(|_| numbers.next_f32()));
    }
    tracer.trace(&mut paths, &mut Uniform);
    assert_eq!(paths.non_finite, 0);
    (0..n).map(|i| luminance(paths.f(i))).collect()
}

#[test]
fn a_furnace_has_its_closed_form_radiance() {
    let scene = build(&furnace(0.5, 3.0), Vec::new()).unwrap();
    for k in 1..=4 {
        let truth = 3.0 * 0.5f64.powi(k as i32);
        for p in [
            Parametrisation::Bsdf,
            Parametrisation::Cosine,
            Parametrisation::Uniform,
        ] {
            for s in [EmitterStrategy::Mis, EmitterStrategy::Nee] {
                let f = trace(&scene, k, p, s, 20_000);
                let n = f.len() as f64;
                let mean = f.iter().map(|&x| f64::from(x)).sum::<f64>() / n;
                let square = f
                    .iter()
                    .map(|&x| (f64::from(x) - mean).powi(2))
                    .sum::<f64>()
                    / n;
                // Five standard errors, and single precision where there is no variance at all.
                let tolerance = 5.0 * (square / n).sqrt() + 2e-4 * truth;
                assert!(
                    (mean - truth).abs() < tolerance,
                    "k {k} {p:?} {s:?}: {mean} ≠ {truth}"
                );
            }
        }
    }
}

#[test]
fn inside_a_sphere_next_event_estimation_has_no_variance() {
    // cos θ · cos θ′ ÷ d² is constant on a sphere, so f is the same number for every u.
    let scene = build(&furnace(0.8, 1.0), Vec::new()).unwrap();
    for f in trace(&scene, 2, Parametrisation::Bsdf, EmitterStrategy::Nee, 1000) {
        assert!((f - 0.64).abs() < 2e-3, "{f}");
    }
}

#[test]
fn blocks_do_not_know_of_each_other() {
    let scene = build(&furnace(0.5, 1.0), Vec::new()).unwrap();
    let all = trace(&scene, 3, Parametrisation::Bsdf, EmitterStrategy::Mis, 1000);
    let first = trace(&scene, 3, Parametrisation::Bsdf, EmitterStrategy::Mis, 10);
    assert_eq!(all[..10], first[..]);
}

#[test]
fn a_scene_without_light_is_black_and_no_error() {
    let mut d = furnace(0.5, 1.0);
    d["emitters"] = json!([]);
    d["shapes"][0]["emitter"] = Value::Null;
    let scene = build(&d, Vec::new()).unwrap();
    assert!(
        trace(&scene, 2, Parametrisation::Bsdf, EmitterStrategy::Mis, 100)
            .iter()
            .all(|&f| f == 0.0)
    );
}

fn triangle(positions: Vec<f32>, faces: Vec<u32>) -> (Value, Vec<Array>) {
    let mut d = furnace(0.5, 1.0);
    d["shapes"] = json!([{
        "type": "mesh", "id": "leaf", "positions": 0, "faces": 1, "normals": null, "texcoords": null,
        "flip_normals": false, "bsdf": 0, "emitter": null,
    }]);
    d["emitters"] = json!([]);
    let arrays = vec![
        Array::F32 {
            shape: vec![positions.len() / 3, 3],
            data: positions,
        },
        Array::U32 {
            shape: vec![faces.len() / 3, 3],
            data: faces,
        },
    ];
    (d, arrays)
}

#[test]
fn bad_scenes_are_refused_with_the_offender_and_the_rule() {
    let good = vec![0., 0., 1., 1., 0., 1., 0., 1., 1.];
    let mut nan = good.clone();
    nan[4] = f32::NAN;
    let edit = |f: &dyn Fn(&mut Value)| {
        let (mut d, a) = triangle(good.clone(), vec![0, 1, 2]);
        f(&mut d);
        (d, a)
    };
    let cases: Vec<((Value, Vec<Array>), &str)> = vec![
        (
            triangle(nan, vec![0, 1, 2]),
            "shape \"leaf\": `positions`[1, 1] = NaN, but it must be finite",
        ),
        (
            triangle(good.clone(), vec![0, 1, 3]),
            "shape \"leaf\": face 0 refers to vertex 3, but there are 3 vertices",
        ),
        (
            edit(&|d| d["shapes"] = json!([])),
            "the scene has no shape; add one, or render it with Mitsuba's `path`",
        ),
        (
            edit(&|d| d["shapes"][0]["bsdf"] = json!(7)),
            "shape \"leaf\": bsdf 7 does not exist (there are 1)",
        ),
        (
            edit(&|d| d["shapes"][0]["positions"] = json!(9)),
            "shape \"leaf\": array 9 does not exist (there are 2)",
        ),
        (
            edit(&|d| d["shapes"][0]["faces"] = json!(0)),
            "shape \"leaf\": array `faces` has array 0, which another part took before, expected one of its own",
        ),
        (
            edit(&|d| d["shapes"][0]["positions"] = json!(1)),
            "shape \"leaf\": array `positions` has type uint32, expected float32",
        ),
        (
            edit(&|d| d["schema"] = json!(2)),
            "scene description has schema 2, this version reads 1. Export the scene again",
        ),
        (
            edit(&|d| d["sensor"]["x_fov"] = json!(180.0)),
            "sensor: `x_fov` = 180, but it must be between 0 and 180 degrees",
        ),
        (
            edit(&|d| d["film"]["crop_size"] = json!([9, 8])),
            "film: `crop_size` = 9, but it must be positive and inside the film",
        ),
        (
            edit(&|d| {
                d["bsdfs"] = json!([{ "type": "twosided", "id": "a", "front": 0, "back": 0 }])
            }),
            "bsdf \"a\": nested bsdf 0 must come before the one that uses it, and does not",
        ),
        (
            edit(&|d| {
                d["schema"] = json!(2);
                d["lights"] = json!([]);
            }),
            "scene description has schema 2, this version reads 1. Export the scene again",
        ),
        (
            edit(&|d| {
                d["film"]["size"] = json!([65536, 65536]);
                d["film"]["crop_size"] = json!([65536, 65536]);
            }),
            "film: `crop_size` = 4294967296, but it must be at most 268435456 pixels in all; \
             render it in crops",
        ),
        (
            triangle(vec![0., 0., 1., 1e30, 0., 1., 0., 1., 1.], vec![0, 1, 2]),
            "shape \"leaf\": positions[1] = [1e30, 0.0, 1.0] must be finite and within ±1e18 (Embree drops \
             such triangles silently). Repair or rescale the mesh",
        ),
        (
            edit(&|d| d["bsdfs"][0]["reflectance"] = json!(5)),
            "bsdf \"wall\": texture 5 does not exist (there are 2)",
        ),
    ];
    for ((description, arrays), message) in cases {
        assert_eq!(
            build(&description, arrays).unwrap_err().to_string(),
            message
        );
    }
    let unknown = edit(&|d| d["bsdfs"][0]["type"] = json!("velvet"));
    let message = build(&unknown.0, unknown.1).unwrap_err().to_string();
    assert!(
        message.contains("unknown variant `velvet`") && message.contains("`diffuse`"),
        "{message}"
    );
}

#[test]
fn triangles_without_area_are_left_out_and_counted() {
    let positions = vec![0., 0., 1., 1., 0., 1., 0., 1., 1.];
    let (d, a) = triangle(positions, vec![0, 1, 1, 0, 1, 2, 2, 2, 2]);
    let summary = build(&d, a).unwrap().summary();
    assert_eq!((summary.triangles, summary.degenerate_triangles), (1, 2));
}

#[test]
fn numbers_from_outside_are_checked() {
    let scene = build(&furnace(0.5, 1.0), Vec::new()).unwrap();
    let tracer = Tracer::new(&scene, 2, Parametrisation::Bsdf, EmitterStrategy::Nee).unwrap();
    let mut paths = Paths::new(tracer.columns());
    let film = [[1.0, 1.0]];
    assert!(paths.set(&[0.5; 5], 5, &film).is_ok());
    let error = paths.set(&[0.5; 4], 4, &film).unwrap_err().to_string();
    assert_eq!(
        error,
        "u has 4 columns, but k = 2 with emitter strategy nee needs 5: \
         x1.direction.0, x1.direction.1, emitter, light.0, light.1"
    );
    for bad in [1.0, -0.1, f32::NAN] {
        let error = paths.set(&[0.5, 0.5, bad, 0.5, 0.5], 5, &film).unwrap_err();
        assert!(
            matches!(
                error,
                TraceError::Range {
                    row: 0,
                    column: 2,
                    ..
                }
            ),
            "{error}"
        );
    }
    assert!(matches!(
        Tracer::new(&scene, 0, Parametrisation::Bsdf, EmitterStrategy::Nee),
        Err(TraceError::Bounces(0))
    ));
}

#[test]
fn one_scene_has_one_hash_and_another_another() {
    let hash = |d: &Value| build(d, Vec::new()).unwrap().hash().to_owned();
    let mut llvm = furnace(0.5, 1.0);
    llvm["variant"] = json!("llvm_ad_rgb");
    assert_eq!(hash(&furnace(0.5, 1.0)), hash(&llvm));
    assert_ne!(hash(&furnace(0.5, 1.0)), hash(&furnace(0.5, 1.1)));
}

#[test]
fn a_shape_and_its_area_emitter_name_each_other() {
    let message = |edit: &dyn Fn(&mut Value)| {
        let mut d = furnace(0.5, 1.0);
        edit(&mut d);
        build(&d, Vec::new()).unwrap_err().to_string()
    };
    let expected = |shape: &str, emitter: &str| {
        format!(
            "shape {shape:?} and emitter {emitter:?}: only one of them names the other; \
             an area emitter and its shape must name each other. Export the scene again"
        )
    };
    assert_eq!(
        message(&|d| d["shapes"][0]["emitter"] = Value::Null),
        expected("furnace", "furnace.emitter")
    );
    assert_eq!(
        message(&|d| {
            d["emitters"] =
                json!([{ "type": "constant", "id": "sky", "radiance": [1.0, 1.0, 1.0] }]);
        }),
        expected("furnace", "sky")
    );
    assert_eq!(
        message(&|d| {
            let mut second = d["shapes"][0].clone();
            second["id"] = json!("copy");
            d["shapes"] = json!([d["shapes"][0], second]);
        }),
        expected("copy", "furnace.emitter")
    );
}

#[test]
fn shapes_of_arrays_are_checked_without_overflow() {
    let mut d = furnace(0.5, 1.0);
    d["textures"][0] = json!({
        "type": "bitmap", "id": "albedo", "data": 0, "to_uv": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "wrap": "repeat", "filter": "nearest", "mean": 0.5,
    });
    for shape in [
        vec![usize::MAX, 2, 3],
        vec![1 << 40, 1, 1],
        vec![0, 1, 1],
        vec![3],
    ] {
        let array = Array::F32 {
            shape: shape.clone(),
            data: vec![0.5; 3],
        };
        assert_eq!(
            build(&d, vec![array]).unwrap_err().to_string(),
            format!(
                "texture \"albedo\": array `data` has shape {shape:?}, expected (height, width, 1 or 3)"
            )
        );
    }
    let (d, mut arrays) = triangle(vec![0.0; 9], vec![0, 1, 2]);
    arrays[0] = Array::F32 {
        shape: vec![usize::MAX, 3],
        data: vec![0.0; 9],
    };
    let message = build(&d, arrays).unwrap_err().to_string();
    assert!(message.contains("expected (n, 3)"), "{message}");
}
