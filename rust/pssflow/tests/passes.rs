//! Renders as lists of passes: what a plan says is what is rendered, and what goes wrong in one path stays there.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::sync::Arc;

use pss_guide::{Context, Decision, Guide, GuideError, Header};
use pssflow::pss_render::Scene;
use pssflow::{Budget, GuideChoice, Options, Outcome, PassKind, PassPlan, Silent, render};
use serde_json::{Value, json};

/// The density is `q`, whatever the numbers are: wrong unless q = 1, so that a test can see its weights.
#[derive(Debug)]
struct Constant {
    q: f32,
}

impl Guide for Constant {
    fn name(&self) -> &str {
        "constant"
    }

    fn models(&self) -> &[Decision] {
        &[Decision::Path]
    }

    fn dims(&self) -> usize {
        5
    }

    fn sample(&self, decision: Decision, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        self.density(decision, contexts, u, q);
    }

    fn density(&self, decision: Decision, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        assert_eq!(
            (decision, contexts.len(), u.len()),
            (Decision::Path, 0, 5 * q.len())
        );
        q.fill(self.q);
    }

    fn mass_outside(&self) -> f64 {
        0.0
    }

    fn parameters(&self) -> usize {
        0
    }

    fn describe(&self) -> Value {
        Value::Null
    }

    fn save(&self, _path: &Path, _header: &Header) -> Result<(), GuideError> {
        Ok(())
    }
}

/// The inside of an emitting sphere of albedo ½, radiance 1: two bounces carry ¼ everywhere.
fn furnace() -> Scene {
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
            "size": [1, 1], "crop_offset": [0, 0], "crop_size": [1, 1],
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

fn rendered(scene: &Scene, guide: GuideChoice, budget: Budget, a: f32) -> Outcome {
    let options = Options {
        guide,
        budget,
        uniform_fraction: a,
        threads: 1,
        ..Options::default()
    };
    render(scene, &options, &Silent).unwrap()
}

fn constant(q: f32) -> GuideChoice {
    GuideChoice::Ready(Arc::new(Constant { q }))
}

fn pass(kind: PassKind, spp: u32) -> PassPlan {
    PassPlan {
        kind,
        spp,
        record: 1.0,
    }
}

#[test]
fn a_plan_is_rendered_pass_by_pass_as_it_says() {
    let scene = furnace();
    let plan = vec![
        pass(PassKind::Pilot, 100),
        pass(PassKind::Uniform, 100),
        pass(PassKind::Guided, 200),
    ];
    let outcome = rendered(&scene, constant(3.0), Budget::Replay(plan.clone()), 0.5);
    assert_eq!(outcome.passes, plan);
    assert_eq!(outcome.pilot.counts.camera_rays, 100);
    assert_eq!(outcome.rendered.counts.camera_rays, 300);
    // m = ½ + ½·3 = 2 in the guided half of the samples and 1 elsewhere: (¼ + ⅛) ÷ 2.
    let mean = outcome.mean()[0];
    assert!((mean - 0.1875).abs() < 0.01, "{mean}");
}

#[test]
fn a_plan_without_a_guide_keeps_its_pilot() {
    let scene = furnace();
    let plan = vec![pass(PassKind::Pilot, 3), pass(PassKind::Uniform, 5)];
    let replayed = rendered(&scene, GuideChoice::None, Budget::Replay(plan), 0.5);
    let asked = rendered(&scene, GuideChoice::None, Budget::Spp(8), 0.5);
    assert_eq!(replayed.film.image, asked.film.image);
    assert_eq!(replayed.film.found, [8]);
}

#[test]
fn a_path_that_is_not_finite_carries_no_light_in_any_count() {
    let scene = furnace();
    let outcome = rendered(&scene, constant(1e-45), Budget::Spp(64), 0.0);
    let counts = outcome.rendered.counts;
    assert_eq!(counts.non_finite, 64);
    assert_eq!(counts.nonzero, 0);
    assert_eq!(outcome.film.nonzero, [0]);
    assert_eq!(outcome.rendered.max_weight, 0.0);
    assert_eq!(outcome.film.image, [0.0; 3]);
}
