//! Guides that are learned while the image is rendered: unbiased, repeatable, and what they are given is what was drawn.

use std::sync::{Arc, Mutex};

use pss_guide::{Context, Decision, Fit, Guide, GuideError, Records};
use pssflow::{
    Budget, Chooser, Chosen, Combine, GuideChoice, Learner, Left, Options, Outcome, PassKind,
    Silent, render,
};
use serde_json::{Value, json};

use crate::common::furnace;

const BINS: usize = 3;

/// A histogram of f²/g over the two numbers at x₁, by the side of x = 0 that x₁ lies on. The first number of the
/// BSDF-sampled ray has the density 2u, whatever is learned: far from one, so that a wrong division shows.
#[derive(Debug)]
struct Halves([[f32; BINS * BINS]; 2]);

impl Halves {
    fn fit(records: &Records<'_>) -> Self {
        let mut bins = [[0.0f64; BINS * BINS]; 2];
        let k = records.bounces();
        for (row, &f) in records.f.iter().enumerate() {
            let context = &records.contexts[row * k];
            assert_eq!((context.bounce, context.pixel), (1, records.pixel[row]));
            assert_eq!(records.contexts[row * k + k - 1].bounce as usize, k);
            let bin = bin(&records.u[row * records.dims..]);
            bins[side(context)][bin] += f64::from(f * f / records.g[row]);
        }
        Self(bins.map(|side| {
            let roots = side.map(|x| x.sqrt() + 1e-3);
            let sum: f64 = roots.iter().sum();
            roots.map(|x| (x / sum * (BINS * BINS) as f64) as f32)
        }))
    }
}

fn side(context: &Context) -> usize {
    usize::from(context.position[0] > 0.0)
}

fn bin(u: &[f32]) -> usize {
    let at = |x: f32| ((x * BINS as f32) as usize).min(BINS - 1);
    at(u[0]) * BINS + at(u[1])
}

impl Guide for Halves {
    fn name(&self) -> &str {
        "halves"
    }

    fn models(&self) -> &[Decision] {
        &[Decision::Direction, Decision::Ray]
    }

    fn dims(&self) -> usize {
        5
    }

    fn sample(&self, decision: Decision, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        if decision == Decision::Ray {
            for u in u.chunks_exact_mut(2) {
                u[0] = u[0].sqrt().min(1.0 - f32::EPSILON / 2.0);
            }
            return self.density(decision, contexts, u, q);
        }
        let pairs = u.chunks_exact_mut(2).zip(contexts).zip(q);
        for ((u, context), q) in pairs {
            let table = &self.0[side(context)];
            let cells = (BINS * BINS) as f32;
            let (mut rest, mut at) = (u[0] * cells, 0);
            while at + 1 < table.len() && rest >= table[at] {
                rest -= table[at];
                at += 1;
            }
            let inside = (rest / table[at]).clamp(0.0, 0.999);
            u[0] = ((at / BINS) as f32 + inside) / BINS as f32;
            u[1] = ((at % BINS) as f32 + u[1] * 0.999) / BINS as f32;
            *q = table[bin(u)];
        }
    }

    fn density(&self, decision: Decision, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        if decision == Decision::Ray {
            assert!(contexts.iter().all(|c| c.bounce == 2));
            return q
                .iter_mut()
                .zip(u.chunks_exact(2))
                .for_each(|(q, u)| *q = 2.0 * u[0]);
        }
        for ((u, context), q) in u.chunks_exact(2).zip(contexts).zip(q) {
            *q = self.0[side(context)][bin(u)];
        }
    }

    fn mass_outside(&self) -> f64 {
        0.0
    }

    fn parameters(&self) -> usize {
        2 * BINS * BINS
    }

    fn describe(&self) -> Value {
        Value::Null
    }
}

/// Learns [`Halves`], and notes how many paths it was given and their mean, each term by the density of its own numbers and
/// both by that of all.
#[derive(Default)]
struct Learns {
    seen: Mutex<Vec<(u64, [f64; 2])>>,
    /// Calls that are answered with "too few paths" first.
    refusals: Mutex<u32>,
}

impl Learner for Learns {
    fn name(&self) -> &str {
        "halves"
    }

    fn looks_at_contexts(&self) -> bool {
        true
    }

    fn refines(&self) -> bool {
        true
    }

    fn uniform_fraction(&self) -> f32 {
        0.2
    }

    fn fit(
        &self,
        records: &Records<'_>,
        _seed: u64,
        _progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError> {
        let mut refusals = self.refusals.lock().unwrap();
        if *refusals > 0 {
            *refusals -= 1;
            return Err(GuideError::TooFewPaths {
                usable: 0,
                given: records.f.len(),
                nonfinite: 0,
                zeros: records.zeros,
            });
        }
        let drawn = records.f.len() as u64 + records.zeros;
        let mut means = [0.0; 2];
        for r in 0..records.f.len() {
            let (f, bsdf) = (f64::from(records.f[r]), f64::from(records.f_bsdf[r]));
            let (g, g_bsdf) = (f64::from(records.g[r]), f64::from(records.g_bsdf[r]));
            means[0] += ((f - bsdf) / g + bsdf / g_bsdf) / drawn as f64;
            means[1] += f / f64::from(records.g_both[r]) / drawn as f64;
        }
        self.seen.lock().unwrap().push((drawn, means));
        Ok(Fit {
            guide: Box::new(Halves::fit(records)),
            history: Vec::new(),
            seconds: 0.0,
            dropped_nonfinite: 0,
            outliers_removed: 0,
            trained_on: records.f.len(),
            samples: records.f.len(),
        })
    }
}

/// Picks nothing until it has seen `enough` paths, then [`Halves`].
struct Patient {
    learner: Arc<Learns>,
    enough: u64,
}

impl Chooser for Patient {
    fn choose(
        &self,
        records: &Records<'_>,
        left: &Left,
        _seed: u64,
        _progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Chosen, GuideError> {
        let ready = records.f.len() as u64 + records.zeros >= self.enough;
        Ok(Chosen {
            learner: ready.then(|| Arc::clone(&self.learner) as Arc<dyn Learner>),
            uniform_fraction: 0.3,
            fit: None,
            candidates: json!([{ "name": "halves", "chosen": ready, "left": left.paths }]),
        })
    }

    fn recall(&self, name: &str) -> Option<Arc<dyn Learner>> {
        (name == "halves").then(|| Arc::clone(&self.learner) as Arc<dyn Learner>)
    }
}

fn options(guide: GuideChoice, budget: Budget) -> Options {
    Options {
        guide,
        budget,
        threads: 1,
        ..Options::default()
    }
}

fn learn() -> GuideChoice {
    GuideChoice::Learn(Arc::new(Learns::default()))
}

fn patient(enough: u64) -> GuideChoice {
    GuideChoice::Auto(Arc::new(Patient {
        learner: Arc::default(),
        enough,
    }))
}

fn shape(outcome: &Outcome) -> Vec<(PassKind, u32, bool)> {
    let passes = outcome.passes.iter();
    passes.map(|p| (p.kind, p.spp, p.fit)).collect()
}

/// Mean over `renders` images of `size`² pixels relative to the truth, and its standard error.
fn mean_of_many(size: u32, renders: u64, spp: u32, combine: Combine) -> (f64, f64) {
    let scene = furnace(size);
    let (mut sum, mut squares) = (0.0, 0.0);
    for seed in 0..renders {
        let options = Options {
            seed,
            combine,
            pilot_spp: Some(1),
            ..options(learn(), Budget::Spp(spp))
        };
        let x = render(&scene, &options, &Silent).unwrap().mean()[0] / 0.25;
        sum += x;
        squares += x * x;
    }
    let n = renders as f64;
    let mean = sum / n;
    (mean, ((squares / n - mean * mean) / (n - 1.0)).sqrt())
}

#[test]
fn learning_while_rendering_is_unbiased() {
    let scene = furnace(8);
    let four = Options {
        pilot_spp: Some(1),
        ..options(learn(), Budget::Spp(8))
    };
    let passes = shape(&render(&scene, &four, &Silent).unwrap());
    let guided = |spp| (PassKind::Guided, spp, true);
    assert_eq!(
        passes,
        [(PassKind::Pilot, 1, false), guided(1), guided(2), guided(4)]
    );

    let (mean, se) = mean_of_many(8, 4096, 8, Combine::Samples);
    assert!(se < 0.005, "{se}");
    assert!((mean - 1.0).abs() < 4.0 * se, "{mean} ± {se}");
}

#[test]
fn weights_by_variance_have_little_bias() {
    let (mean, se) = mean_of_many(16, 512, 8, Combine::Variance);
    assert!(se < 0.005, "{se}");
    assert!((mean - 1.0).abs() < 0.002 + 4.0 * se, "{mean} ± {se}");
}

#[test]
fn records_of_all_passes_have_one_mean() {
    let scene = furnace(8);
    let learner = Arc::new(Learns::default());
    let choice = GuideChoice::Learn(Arc::clone(&learner) as Arc<dyn Learner>);
    // So few records that later passes are thinned, and those before them.
    let options = Options {
        max_records: 8000,
        ..options(choice, Budget::Spp(512))
    };
    let outcome = render(&scene, &options, &Silent).unwrap();
    assert!(outcome.passes.iter().any(|p| p.record < 1.0));
    let seen = learner.seen.lock().unwrap();
    let drawn: Vec<u64> = seen.iter().map(|s| s.0).collect();
    assert_eq!(drawn, [1024, 2048, 4096, 8192, 16384]);
    for (_, means) in &*seen {
        for mean in means {
            assert!((mean - 0.25).abs() < 0.03, "{means:?}");
        }
    }
}

/// What was too little to learn from at first need not stay so, and then nobody is told of it.
#[test]
fn a_reason_does_not_outlive_its_cause() {
    let scene = furnace(8);
    let rendered = |refusals| {
        let learner = Learns {
            refusals: Mutex::new(refusals),
            ..Learns::default()
        };
        let choice = GuideChoice::Learn(Arc::new(learner));
        render(&scene, &options(choice, Budget::Spp(64)), &Silent).unwrap()
    };
    let late = rendered(1);
    assert_eq!((late.chosen.as_str(), late.notes.len()), ("halves", 0));
    let never = rendered(u32::MAX);
    assert_eq!(never.chosen, "none");
    assert!(
        never.notes.iter().any(|n| n.ends_with("none is used")),
        "{:?}",
        never.notes
    );
}

#[test]
fn few_samples_make_sense() {
    let scene = furnace(2);
    for spp in 2..40 {
        let outcome = render(&scene, &options(learn(), Budget::Spp(spp)), &Silent).unwrap();
        let passes = shape(&outcome);
        assert_eq!(passes.iter().map(|p| p.1).sum::<u32>(), spp, "{passes:?}");
        assert!(
            passes.iter().skip(1).all(|p| p.0 == PassKind::Guided),
            "{passes:?}"
        );
        assert_eq!(outcome.uniform_fraction, 0.2);
    }
}

#[test]
fn a_record_is_replayed_bit_for_bit() {
    let scene = furnace(8);
    for (guide, budget) in [
        (learn(), Budget::Spp(32)),
        (patient(64 * 10), Budget::Spp(32)),
        (learn(), Budget::Time(0.2)),
        (patient(64 * 10), Budget::Time(0.2)),
    ] {
        let first = render(&scene, &options(guide.clone(), budget), &Silent).unwrap();
        let replay = Budget::Replay(first.passes.clone());
        for threads in [1, 3] {
            let options = Options {
                threads,
                ..options(guide.clone(), replay.clone())
            };
            let again = render(&scene, &options, &Silent).unwrap();
            assert_eq!(first.film.image, again.film.image);
            assert_eq!(first.passes, again.passes);
        }
    }
}

#[test]
fn a_chooser_may_change_its_mind_as_paths_grow() {
    let scene = furnace(8);
    let outcome = render(&scene, &options(patient(64 * 10), Budget::Spp(32)), &Silent).unwrap();
    let uniform = |spp| (PassKind::Uniform, spp, false);
    assert_eq!(
        shape(&outcome),
        [
            (PassKind::Pilot, 1, false),
            uniform(1),
            uniform(2),
            uniform(4),
            uniform(8),
            (PassKind::Guided, 16, true),
        ]
    );
    assert_eq!(
        (outcome.chosen.as_str(), outcome.uniform_fraction),
        ("halves", 0.3)
    );
    assert_eq!(outcome.candidates[0]["chosen"], true);

    // What ends in `none` is the image of uniform numbers, the pilot's at half their weight.
    let none = render(
        &scene,
        &options(patient(u64::MAX), Budget::Spp(32)),
        &Silent,
    )
    .unwrap();
    let plain = |spp| {
        render(
            &scene,
            &options(GuideChoice::None, Budget::Spp(spp)),
            &Silent,
        )
        .unwrap()
        .film
    };
    let (all, pilot) = (plain(32), plain(1));
    assert_eq!(none.chosen, "none");
    assert_eq!(none.film.found, all.found);
    let images = none
        .film
        .image
        .iter()
        .zip(all.image.iter().zip(&pilot.image));
    for (a, (all, pilot)) in images {
        let expected = (32.0 * all - 0.5 * pilot) / 31.5;
        assert!((a - expected).abs() < 1e-6, "{a} {expected}");
    }
}

/// Records at their bound, none, one, and so few that every pass gives way to the next: the render goes on, and a plan repeats
/// it bit for bit.
#[test]
fn few_records_or_none_are_enough_to_render() {
    let scene = furnace(8);
    for max_records in [0, 1, 2, 100] {
        let options = Options {
            max_records,
            ..options(learn(), Budget::Spp(64))
        };
        let first = render(&scene, &options, &Silent).unwrap();
        for threads in [1, 3] {
            let options = Options {
                threads,
                budget: Budget::Replay(first.passes.clone()),
                ..options.clone()
            };
            let again = render(&scene, &options, &Silent).unwrap();
            assert_eq!(first.film.image, again.film.image, "{max_records}");
        }
    }
}

#[test]
fn a_pilot_that_would_be_all_of_the_image_is_refused_where_it_is_discarded() {
    let discarded = Options {
        keep_pilot: false,
        ..options(patient(0), Budget::Spp(1))
    };
    let message = render(&furnace(2), &discarded, &Silent)
        .unwrap_err()
        .to_string();
    assert!(
        message.starts_with("spp = 1: must be more than the pilot"),
        "{message}"
    );
}
