//! Renders as lists of passes: what a plan says is what is rendered, and what goes wrong in one path stays there.

use std::path::Path;
use std::sync::Arc;

use pss_guide::{Context, Decision, Guide, GuideError, Header, Recipe};
use pssflow::pss_render::Scene;
use pssflow::{
    Budget, Combine, GuideChoice, Named, Options, Outcome, PassKind, PassPlan, Silent, render,
};
use serde_json::Value;

use crate::common::furnace;

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

fn rendered(scene: &Scene, guide: GuideChoice, budget: Budget, a: f32) -> Outcome {
    let options = Options {
        guide,
        budget,
        uniform_fraction: Some(a),
        threads: 1,
        ..Options::default()
    };
    render(scene, &options, &Silent).unwrap()
}

fn constant(q: f32) -> GuideChoice {
    GuideChoice::Ready(Arc::new(Constant { q }))
}

fn pass(kind: PassKind, spp: u32) -> PassPlan {
    let guided = kind == PassKind::Guided;
    PassPlan {
        kind,
        spp,
        record: 0.0,
        guide: guided.then(|| "constant".to_owned()),
        a: guided.then_some(0.5),
        fit: false,
    }
}

#[test]
fn a_plan_is_rendered_pass_by_pass_as_it_says() {
    let scene = furnace(1);
    let plan = vec![
        pass(PassKind::Pilot, 100),
        pass(PassKind::Uniform, 100),
        pass(PassKind::Guided, 200),
    ];
    let outcome = rendered(&scene, constant(3.0), Budget::Replay(plan.clone()), 0.5);
    assert_eq!(outcome.passes, plan);
    assert_eq!(outcome.pilot.counts.camera_rays, 100);
    assert_eq!(outcome.rendered.counts.camera_rays, 300);
    // m = ½ + ½·3 = 2 in the guided samples and 1 elsewhere; a sample of the pilot counts half.
    let (mean, expected) = (
        outcome.mean()[0],
        (50.0 / 4.0 + 100.0 / 4.0 + 200.0 / 8.0) / 350.0,
    );
    assert!((mean - expected).abs() < 0.005, "{mean} {expected}");
}

#[test]
fn a_plan_without_a_guide_keeps_its_pilot_at_half_its_weight() {
    let scene = furnace(1);
    let plan = vec![pass(PassKind::Pilot, 3), pass(PassKind::Uniform, 5)];
    let replayed = rendered(&scene, GuideChoice::None, Budget::Replay(plan), 0.5);
    let plain = |spp| rendered(&scene, GuideChoice::None, Budget::Spp(spp), 0.5).mean()[0];
    let expected = (8.0 * plain(8) - 1.5 * plain(3)) / 6.5;
    assert!((replayed.mean()[0] - expected).abs() < 1e-6);
    assert_eq!(replayed.film.found, [8]);
}

/// Claim: the variance that is told is the images' own, also where samples count half; as if all counted the same it would be
/// 10 % less.
#[test]
fn the_pilots_weight_is_in_the_variance() {
    let scene = furnace(4);
    let plan = vec![pass(PassKind::Pilot, 8), pass(PassKind::Uniform, 8)];
    let (renders, pixels) = (1000, 3 * 16);
    let (mut told, mut sum, mut squares) = (0.0, vec![0.0; pixels], vec![0.0; pixels]);
    for seed in 0..renders {
        let options = Options {
            seed,
            budget: Budget::Replay(plan.clone()),
            threads: 1,
            ..Options::default()
        };
        let film = render(&scene, &options, &Silent).unwrap().film;
        told += film.variance.iter().map(|&v| f64::from(v)).sum::<f64>();
        for (i, &x) in film.image.iter().enumerate() {
            sum[i] += f64::from(x);
            squares[i] += f64::from(x) * f64::from(x);
        }
    }
    let n = renders as f64;
    let each = sum.iter().zip(&squares);
    let between: f64 = each.map(|(s, q)| (q - s * s / n) / (n - 1.0)).sum();
    let ratio = told / n / between;
    assert!((ratio - 1.0).abs() < 0.05, "{ratio}");
}

#[test]
fn a_path_that_is_not_finite_carries_no_light_in_any_count() {
    let scene = furnace(1);
    let outcome = rendered(&scene, constant(1e-45), Budget::Spp(64), 0.0);
    let counts = outcome.rendered.counts;
    assert_eq!(counts.non_finite, 64);
    assert_eq!(counts.nonzero, 0);
    assert_eq!(outcome.film.nonzero, [0]);
    assert_eq!(outcome.rendered.max_weight, 0.0);
    assert_eq!(outcome.film.image, [0.0; 3]);
}

#[test]
fn a_snapshot_is_the_last_image_of_its_time_and_its_passes_replay_it() {
    let scene = furnace(16);
    for (combine, keep_pilot) in [
        (Combine::Samples, true),
        (Combine::Variance, true),
        (Combine::Samples, false),
    ] {
        let mut options = Options {
            guide: GuideChoice::Learn(Arc::new(Named::new(
                Recipe::parse("direction-table", &serde_json::Map::new()).unwrap(),
            ))),
            budget: Budget::Time(0.4),
            snapshots: vec![1e-9, 0.05, 0.2],
            combine,
            keep_pilot,
            threads: 2,
            ..Options::default()
        };
        let whole = render(&scene, &options, &Silent).unwrap();
        let times: Vec<f64> = whole.snapshots.iter().map(|s| s.time).collect();
        assert_eq!(times, options.snapshots);
        let mut before = 0;
        options.snapshots.clear();
        for snapshot in &whole.snapshots {
            let (n, told) = (snapshot.outcome.passes.len(), &snapshot.outcome);
            assert_eq!(told.passes[..], whole.passes[..n]);
            assert!(n >= before.max(1) && told.elapsed <= whole.elapsed);
            // Late only where there was no image before.
            let images = told
                .passes
                .iter()
                .filter(|p| keep_pilot || p.kind != PassKind::Pilot);
            assert!(told.elapsed <= snapshot.time || images.count() == 1);
            let phases = told.seconds.pilot + told.seconds.fit + told.seconds.render;
            assert!(phases <= told.elapsed * (1.0 + 1e-9));
            let spp: u32 = told.passes.iter().map(|p| p.spp).sum();
            let paths = told.pilot.counts.camera_rays + told.rendered.counts.camera_rays;
            assert_eq!(paths, 256 * u64::from(spp));
            options.budget = Budget::Replay(told.passes.clone());
            let again = render(&scene, &options, &Silent).unwrap();
            assert_eq!(again.film.image, told.film.image);
            assert_eq!(again.film.variance, told.film.variance);
            assert_eq!(again.film.nonzero, told.film.nonzero);
            assert!(again.snapshots.is_empty());
            before = n;
        }
        options.budget = Budget::Replay(whole.passes.clone());
        let again = render(&scene, &options, &Silent).unwrap();
        assert_eq!(again.film.image, whole.film.image);
    }
}

/// Claim: paths that roulette ends are black samples of the image and nothing else, all others count 1 ÷ survival; the mean
/// stays, and the variance that is told is that of the images.
#[test]
fn roulette_before_the_first_ray_loses_no_light() {
    let scene = furnace(4);
    let survive = |survival: f32, seed: u64| {
        let options = Options {
            survival,
            seed,
            budget: Budget::Spp(16),
            threads: 1,
            ..Options::default()
        };
        render(&scene, &options, &Silent).unwrap()
    };
    let renders = 400u32;
    let mean = |survival: f32| -> (f64, f64, f64) {
        let (mut sum, mut squares, mut told) = (0.0, 0.0, 0.0);
        for seed in 0..renders {
            let outcome = survive(survival, seed.into());
            let (x, v) = (outcome.film.image[0], outcome.film.variance[0]);
            sum += f64::from(x);
            squares += f64::from(x) * f64::from(x);
            told += f64::from(v);
        }
        let n = f64::from(renders);
        (sum / n, squares / n - (sum / n).powi(2), told / n)
    };
    let (all, variance_all, _) = mean(1.0);
    let (some, variance_some, told) = mean(0.25);
    let error = ((variance_all + variance_some) / f64::from(renders)).sqrt();
    assert!((all - some).abs() < 5.0 * error, "{all} {some} {error}");
    assert!(
        variance_some > 2.0 * variance_all,
        "{variance_some} {variance_all}"
    );
    assert!(
        (told / variance_some - 1.0).abs() < 0.4,
        "{told} {variance_some}"
    );
    let traced = survive(0.25, 0).rendered.counts.camera_rays;
    assert!((16..112).contains(&traced), "{traced} of 256");

    for survival in [0.0, -1.0, 1.5, f32::NAN] {
        let options = Options {
            survival,
            ..Options::default()
        };
        let error = render(&scene, &options, &Silent).unwrap_err().to_string();
        assert!(
            error.contains("survival") && error.contains("(0, 1]"),
            "{error}"
        );
    }
}
